"""The command that runs the studies that come with animat: the paper's, and the context study."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from animat.cli.command import JobOptions
from animat.cli.study import run_and_report


@dataclass(frozen=True)
class Reproduce(JobOptions):
    """The paper's study on a virtual culture: record, train, evaluate, compare, report. Resumes where it stopped."""

    study: Literal["paper", "context"] = "paper"
    """paper: the paper's comparisons; context: which tasks need more than a reflex, what the policies do beyond one,
    and whose work it is; for your own study: animat study FILE"""
    quick: bool = False
    """Every step with fewer policies, iterations and recordings: a first look, not results"""
    culture_seed: str = "1"
    """Which virtual culture; several: 1-5, or 1,3,8"""
    seed: int = 1
    """Decides every draw of training and evaluation"""

    def run(self) -> dict[str, Any]:
        from animat.studies.paper import paper_study
        from animat.studies.source import read_seeds

        seeds = read_seeds(self.culture_seed)
        if self.study == "context":
            return self._context(seeds)
        study = paper_study(seeds[0] if len(seeds) == 1 else 1, self.seed, quick=self.quick)
        if len(seeds) > 1:
            study = replace(study, culture=replace(study.culture, seeds=self.culture_seed))
        return run_and_report(study, Path(), self)

    def _context(self, cultures: list[int]) -> dict[str, Any]:
        from animat.studies.context import ContextStudy, quick_context_study, run_context_study
        from animat.studies.context_page import summarise_robot, write_context_page

        study = (quick_context_study if self.quick else ContextStudy)(cultures=tuple(cultures), seed=self.seed)
        with self.executing("study") as execution:
            results = run_context_study(study, self.out, **execution)
        report = write_context_page(study, results)
        for robot in study.robots:
            print(f"{robot}: {summarise_robot([row for row in results.rows if row.robot == robot])}")
        print(f"report: {report}")
        return {
            "folder": str(results.folder),
            "report": str(report),
            "done_now_cpu_s": results.done_now,
            "rows": [asdict(row) for row in results.rows],
            "lost": [asdict(row) for row in results.lost],
        }
