"""The command that evaluates policies on the simulator of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from animat.cli.responses import Fitting, say_findings
from animat.errors import Mismatch


@dataclass(frozen=True)
class Evaluate(Fitting):
    """Run trained policies, and controls beside them, on the simulator of a recording, made as in their training."""

    policies: Positional[Path] = Path("policies")
    """A policy file or a folder of them"""
    recordings: tuple[Path, ...] = ()
    """Files or folders of recordings of one culture"""
    at_min: float | None = None
    """Minute on the culture's clock whose newest recording answers; default: the last recording"""
    episodes: int = 100
    """Episodes of each policy and control"""
    robot: Literal["cartpole", "navigation"] | None = None
    """The robot that is expected; default: the one the policies were trained on"""
    drawn: bool = False
    """Draw actions from the policy, as in training, instead of taking the most probable one"""
    limit: bool = False
    """Also compute the best return that any controller could get there, and scores; seconds, with memory minutes"""
    seed: int = 1
    """Decides every random draw"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Evaluate."""
        from animat.compilation import keep_compilations
        from animat.evaluation.rollouts import check_at_once
        from animat.progress import Bar
        from animat.training.policy import load_policies

        policies = load_policies(self.policies)
        check_at_once("--episodes", self.episodes, len(policies))
        for name, policy in policies.items():
            if self.robot is not None and policy.robot.name != self.robot:
                raise Mismatch(f"{name}: expected a policy for {self.robot}, got one for {policy.robot.name}")
        through_neurons = any(policy.mapping is not None for policy in policies.values())
        # On what they were trained on, unless asked otherwise.
        trained = next((policy for policy in policies.values() if policy.mapping is not None), None)
        timeline = self.timeline(self.recordings, trained) if through_neurons else None

        from animat.evaluation.table import evaluate

        keep_compilations()
        with Bar("evaluating") as progress:
            evaluation = evaluate(
                policies,
                timeline,
                at_min=self.at_min,
                episodes=self.episodes,
                seed=self.seed,
                greedy=not self.drawn,
                limit_resolution=1.0 if self.limit else None,
                progress=progress,
            )
        say_findings(evaluation.findings)
        print(evaluation.to_text())
        return evaluation.to_dict()
