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
    from concurrent.futures import Executor

    from animat.studies.specification import Study


@dataclass(frozen=True)
class StudyFile:
    """A study of one's own from a TOML file: recordings, robots, arms. Goes on where it stopped."""

    specification: Positional[Path]
    """The TOML file; animat reproduce leaves one to start from in its folder"""
    workers: int | None = None
    """Processes, each on its own core; default: one a core"""
    cluster: str | None = None
    """On other machines instead: a Dask scheduler's address, tcp://HOST:8786, or its scheduler file"""
    shared_folder: bool = True
    """Whether its workers see --out at the same place; if not, files go through this process"""
    out: Path = Path("study")
    """Folder for everything; the report is report.html in it"""
    watch: bool = False
    """Serve a page of it beside, for a browser on this machine; needs animat[watch]"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Run it."""
        from animat.studies.toml import read_study

        study = read_study(self.specification)
        return run_and_report(
            study, self.specification.parent, self.out, self.workers, self.cluster, self.shared_folder
        )


def run_and_report(
    study: Study, base: Path, out: Path, workers: int | None, cluster: str | None, shared_folder: bool
) -> dict[str, Any]:
    """Run a study, whose files are named as seen from `base`, and print its comparisons."""
    from animat.execution.cluster import on_cluster
    from animat.studies.cultures import studies_of

    for spec in study.robots:
        for caveat in spec.robot().caveats():
            print(f"warning: {caveat}", file=sys.stderr)
    cores = len(os.sched_getaffinity(0))
    if workers is not None and workers > cores:
        print(f"warning: --workers: {workers} were asked for; there is one a core, {cores}", file=sys.stderr)
    run = _run_many if studies_of(study) else _run_one
    with on_cluster(cluster, shared_folder) as executor:
        return run(study, base, out, workers, executor)


def _run_one(study: Study, base: Path, out: Path, workers: int | None, executor: Executor | None) -> dict[str, Any]:
    from animat.lined_up import lined_up
    from animat.progress import Bar
    from animat.studies.heuristic import not_outperforming
    from animat.studies.places import results_file
    from animat.studies.results import Results, read_typed
    from animat.studies.run import run_study

    began = time.monotonic()
    with Bar("study") as progress:
        ran = run_study(study, out, base=base, workers=workers, executor=executor, progress=progress)
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


def _run_many(study: Study, base: Path, out: Path, workers: int | None, executor: Executor | None) -> dict[str, Any]:
    from animat.errors import AnimatError
    from animat.lined_up import lined_up
    from animat.progress import Bar
    from animat.studies.cultures import run_over_cultures
    from animat.studies.cultures_page import write_cultures_page
    from animat.studies.parquet import MISSING

    began = time.monotonic()
    with Bar("study") as progress:
        found = run_over_cultures(study, out, base=base, workers=workers, executor=executor, progress=progress)
    report = write_cultures_page(study, found)
    cells = []
    for row in found.summary:
        interval = "" if row.low_95 is None else f"{row.low_95:+.1f} to {row.high_95:+.1f}"
        means = f"{row.mean_first:.1f}", f"{row.mean_second:.1f}", f"{row.difference:+.1f}"
        counts = f"{row.larger_in} of {row.cultures}", row.found_better
        cells.append([f"{row.robot}, {row.comparison}", *means, interval, *counts])
    if cells:
        head = ["", "first", "second", "difference", "95 % interval", "second larger in", "found better in"]
        print("\n".join(lined_up(head, cells)))
    jobs = sum(len(each.done_now) for each in found.ran.values())
    print(f"{len(found.ran)} cultures, {jobs} jobs in {time.monotonic() - began:.0f} s; report: {report}")
    if found.parquet is None:
        print(f"scores.csv only, no Parquet table: {MISSING}")
    for name, why in found.failed.items():
        print(f"failed: {name}: {why}", file=sys.stderr)
    if found.failed:
        total = len(found.ran) + len(found.failed)
        raise AnimatError(f"{len(found.failed)} of {total} cultures failed; the same command tries them again")
    return {
        "folder": str(found.folder),
        "report": str(report),
        "cultures": list(found.ran),
        "over_cultures": [asdict(row) for row in found.summary],
    }
