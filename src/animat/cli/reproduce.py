"""The command that runs the paper's study."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from animat.cli.study import run_and_report


@dataclass(frozen=True)
class Reproduce:
    """The paper's study on a virtual culture: record, train, evaluate, compare, report. Goes on where it stopped."""

    quick: bool = False
    """Every step with fewer policies, iterations and recordings: a first look, no results"""
    culture_seed: int = 1
    """Which virtual culture"""
    seed: int = 1
    """Decides every draw of training and evaluation"""
    workers: int | None = None
    """Processes, each on its own core; default: one a core"""
    out: Path = Path("study")
    """Folder for everything; the report is report.html in it"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Run it."""
        from animat.studies.paper import paper_study

        return run_and_report(
            paper_study(self.culture_seed, self.seed, quick=self.quick), Path(), self.out, self.workers
        )
