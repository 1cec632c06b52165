"""The command that evaluates policies on the simulator of a recording."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import SimulatorOptions, policies_for, print_warnings, warnings_of
from animat.errors import AnimatError, InvalidArgument
from animat.plain_file import read_plain_text
from animat.records import json_data, write_json
from animat.writing import expect_writable

_MOST_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True)
class Evaluate(SimulatorOptions):
    """Run trained policies, and controls, on the simulator of a recording, made as in their training."""

    policies: Positional[Path] = Path("policies")
    """A policy file or a folder of them"""
    recordings: tuple[Path, ...] = ()
    """Files or folders of recordings of one culture"""
    at_min: float | None = None
    """Use the newest recording made by this minute of the culture's clock; default: the last recording"""
    episodes: int = 100
    """Episodes of each policy and control"""
    robot: str | None = None
    """The expected robot, with its import path: my_package.robots:Rover; default: the one they were trained on"""
    mapping: str | None = None
    """The expected mapping, with its import path: my_package.mappings:Steep; default: the one they were trained with"""
    agents: tuple[str, ...] = ()
    """Your own agents, which get rows too: my_rule:Rule (docs/agents.md)"""
    drawn: bool = False
    """Draw actions from the policy, as in training, instead of taking the most probable one"""
    optimum: bool = False
    """Also compute the best return that any controller could get there, that of the best reflex, and scores; takes a
    minute, or several with a memory simulator"""
    interventions: bool = False
    """Also measure whose work it is: what the policies lose without the culture, with the stimuli of another episode,
    and with the mapping turned round; and, for a robot with several goals, the effect of a switched goal, and goal
    information in bits"""
    seed: int = 1
    """Decides every random draw"""
    out: Path | None = None
    """JSON file for all results; the live page of a training shows evaluation.json of the policies' folder"""

    def run(self) -> dict[str, Any]:
        from animat.compilation import keep_compilations
        from animat.evaluation.rollouts import check_at_once
        from animat.progress import Bar

        if self.out is not None:
            if self.out.is_dir():
                raise InvalidArgument(f"--out: expected a file, got the folder {self.out}")
            _expect_no_other(self.out)
            expect_writable(self.out.parent)
        policies = policies_for(self.robot, self.mapping, self.policies)
        check_at_once("--episodes", self.episodes, len(policies))
        timeline = self.timeline_for(policies, self.recordings)

        from animat.evaluation.own_agents import agents_at
        from animat.evaluation.table import evaluate

        agents = agents_at(self.agents, next(iter(policies.values())).conditions)
        keep_compilations()
        with Bar("evaluating") as progress:
            evaluation = evaluate(
                policies,
                timeline,
                at_min=self.at_min,
                episodes=self.episodes,
                seed=self.seed,
                greedy=not self.drawn,
                agents=agents,
                optimum_resolution=1.0 if self.optimum else None,
                interventions=self.interventions,
                progress=progress,
            )
        print_warnings(evaluation.findings)
        print(evaluation.to_text())
        findings = (*warnings_of(timeline), *evaluation.findings)
        result = evaluation.to_dict() | {"findings": [finding.to_dict() for finding in findings]}
        if self.out is not None:
            write_json(self.out, result)
        return result


def _expect_no_other(out: Path) -> None:
    """Raise for a file that is not an earlier evaluation: a recording or a policy would be lost."""
    if not out.exists():
        return
    with suppress(AnimatError):
        data = json_data(read_plain_text(out, _MOST_BYTES), "--out")
        if isinstance(data, dict) and "recorded_at_min" in data:
            return
    raise InvalidArgument(f"--out: expected a new file or one of an earlier evaluation, got {out}, which is neither")
