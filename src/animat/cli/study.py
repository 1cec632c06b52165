"""The command that runs a study of one's own from a TOML file."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

if TYPE_CHECKING:
    from animat.studies.specification import Study


@dataclass(frozen=True)
class StudyFile:
    """A study of one's own from a TOML file: recordings, robots, arms. Goes on where it stopped."""

    specification: Positional[Path]
    """The TOML file; animat reproduce leaves one to start from in its folder"""
    workers: int | None = None
    """Processes, each on its own core; default: one a core"""
    out: Path = Path("study")
    """Folder for everything; the report is report.html in it"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Run it."""
        from animat.studies.toml import read_study

        return run_and_report(read_study(self.specification), self.specification.parent, self.out, self.workers)


def run_and_report(study: Study, base: Path, out: Path, workers: int | None) -> dict[str, Any]:
    """Run a study, whose files are named as seen from `base`, and print its comparisons."""
    from animat.lined_up import lined_up
    from animat.progress import Bar
    from animat.studies.heuristic import not_outperforming
    from animat.studies.places import results_file
    from animat.studies.results import Results, read_typed
    from animat.studies.run import run_study

    for spec in study.robots:
        for caveat in spec.robot().caveats():
            print(f"warning: {caveat}", file=sys.stderr)
    cores = len(os.sched_getaffinity(0))
    if workers is not None and workers > cores:
        print(f"warning: --workers: {workers} were asked for; there is one a core, {cores}", file=sys.stderr)
    began = time.monotonic()
    with Bar("study") as progress:
        ran = run_study(study, out, base=base, workers=workers, progress=progress)
    results = read_typed(results_file(ran.folder), Results)
    cells = []
    for row in results.comparisons:
        paper = "" if row.paper_p is None else f"; the paper's p {row.paper_p:.3g}, which implies U {row.paper_u:g}"
        means = f"{row.mean_first:.1f}", f"{row.mean_second:.1f}"
        cells.append(
            [f"{row.robot}, {row.comparison}", *means, f"{row.u:g}", f"{row.p_normal:.3g}", row.outcome + paper]
        )
    if cells:
        print("\n".join(lined_up(["", "first", "second", "U", "p", ""], cells)))
    beside = not_outperforming(results)
    for message in beside:
        print(message)
    if ran.done_now:
        print(f"{len(ran.done_now)} of {ran.jobs} jobs in {time.monotonic() - began:.0f} s; report: {ran.report}")
    else:
        print(f"nothing to do: all {ran.jobs} jobs are done; report: {ran.report}")
    return {
        "folder": str(ran.folder),
        "report": str(ran.report),
        "jobs": ran.jobs,
        "done_now_cpu_s": ran.done_now,
        "comparisons": [asdict(row) for row in results.comparisons],
        "not_outperforming_the_heuristic": beside,
    }
