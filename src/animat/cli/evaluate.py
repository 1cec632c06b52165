"""The command that evaluates policies on the simulator of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.responses import Fitting, policies_for, say_findings
from animat.errors import AnimatError, InvalidArgument
from animat.plain_file import read_plain_text
from animat.records import json_data, write_json
from animat.writing import expect_writable

_MOST_BYTES = 256 * 1024 * 1024


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
    robot: str | None = None
    """The robot that is expected, and imported: my_package.robots:Rover; default: the one they were trained on"""
    mapping: str | None = None
    """The mapping that is expected, and imported: my_package.mappings:Steep; default: the one they were trained with"""
    drawn: bool = False
    """Draw actions from the policy, as in training, instead of taking the most probable one"""
    optimum: bool = False
    """Also compute the best return that any controller could get there, and that of a mere reflex, and scores; a
    minute, with memory some"""
    interventions: bool = False
    """Also say whose work it is: what the policies lose without the culture, with the stimuli of another episode,
    with the mapping turned round; and, of a robot with several goals, what a switch of the goal does, and goal
    information in bits"""
    seed: int = 1
    """Decides every random draw"""
    out: Path | None = None
    """File for all of it as JSON; the live page of a training shows evaluation.json of the policies' folder"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Evaluate."""
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
                optimum_resolution=1.0 if self.optimum else None,
                interventions=self.interventions,
                progress=progress,
            )
        say_findings(evaluation.findings)
        print(evaluation.to_text())
        if self.out is not None:
            write_json(self.out, evaluation.to_dict())
        return evaluation.to_dict()


def _expect_no_other(out: Path) -> None:
    """Raise for a file that is no earlier evaluation: a recording or a policy would be gone."""
    if not out.exists():
        return
    try:
        found = json_data(read_plain_text(out, _MOST_BYTES), "--out")
    except AnimatError:
        found = None
    if not isinstance(found, dict) or "recorded_at_min" not in found:
        raise InvalidArgument(
            f"--out: expected a new file or one of an earlier evaluation, got {out}, which is neither"
        )
