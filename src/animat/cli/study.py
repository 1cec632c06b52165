"""The command that runs a custom study from a TOML file."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from animat.cli.command import JobOptions, print_warnings
from animat.errors import AnimatError, counted
from animat.terminal_table import align_columns

if TYPE_CHECKING:
    from animat.studies.specification import Study


@dataclass(frozen=True, kw_only=True)
class StudyFile(JobOptions):
    """Run your own study from a TOML file: recordings, robots, arms. Resumes where it stopped."""

    specification: Positional[Path]
    """The TOML file; animat reproduce writes one to start from in its folder"""

    def run(self) -> dict[str, Any]:
        from animat.studies.toml import read_study

        return run_and_report(read_study(self.specification), self.specification.parent, self)


def run_and_report(study: Study, base: Path, command: JobOptions) -> dict[str, Any]:
    """Run a study, whose file names are relative to `base`, and print its comparisons."""
    from animat.studies.cultures import studies_of

    command.print_caveats(spec.robot() for spec in study.robots)
    return (_run_many if studies_of(study) else _run_one)(study, base, command)


def _run_one(study: Study, base: Path, command: JobOptions) -> dict[str, Any]:
    from animat.report.results import Results
    from animat.studies.folder import RESULTS
    from animat.studies.outperforming import not_outperforming
    from animat.studies.results import read_typed
    from animat.studies.run import run_study

    began = time.monotonic()
    with command.executing("study") as execution:
        ran = run_study(study, command.out, base=base, **execution)
    results = read_typed(ran.folder / RESULTS, Results)
    cells = []
    for row in results.comparisons:
        paper = "" if row.paper_p is None else f"; the paper's p {row.paper_p:.3g}, which implies U {row.paper_u:g}"
        numbers = f"{row.mean_first:.1f}", f"{row.mean_second:.1f}", f"{row.u:g}", f"{row.p_normal:.3g}"
        cells.append([f"{row.robot}, {row.comparison}", *numbers, row.outcome + paper])
    if cells:
        print("\n".join(align_columns(["", "first", "second", "U", "p", ""], cells)))
    messages = not_outperforming(results)
    for message in messages:
        print(message)
    print_warnings(results.findings)
    done, n = f"all {ran.jobs} jobs are done", len(ran.done_now)
    now = f"{done}, {n} of them now, in {time.monotonic() - began:.0f} s" if n else f"nothing to do: {done}"
    print(f"{now}; report: {ran.report}")
    return {
        "folder": str(ran.folder),
        "report": str(ran.report),
        "jobs": ran.jobs,
        "done_now_cpu_s": ran.done_now,
        "comparisons": [asdict(row) for row in results.comparisons],
        "not_outperforming_the_heuristic": messages,
        "findings": [each.to_dict() for each in results.findings],
    }


def _run_many(study: Study, base: Path, command: JobOptions) -> dict[str, Any]:
    from animat.studies.cultures import run_over_cultures, write_cultures_page
    from animat.studies.results import MISSING

    began = time.monotonic()
    with command.executing("study") as execution:
        results = run_over_cultures(study, command.out, base=base, **execution)
    report = write_cultures_page(study, results)
    cells = []
    for row in results.summary:
        interval = "" if row.low_95 is None else f"{row.low_95:+z.1f} to {row.high_95:+z.1f}"
        means = f"{row.mean_first:.1f}", f"{row.mean_second:.1f}", f"{row.difference:+z.1f}"
        counts = f"{row.larger_in} of {row.cultures}", row.found_better
        cells.append([f"{row.robot}, {row.comparison}", *means, interval, *counts])
    if cells:
        head = "", "first", "second", "difference", "95 % interval", "second mean larger in", "significantly better in"
        print("\n".join(align_columns(head, cells)))
    for message in results.not_outperforming:
        print(message)
    print_warnings(
        [replace(each, message=f"{name}: {each.message}") for name, of in results.warnings.items() for each in of]
    )
    jobs = sum(len(each.done_now) for each in results.finished.values())
    done = f"{counted(len(results.finished), 'culture')}, {counted(jobs, 'job')}"
    print(f"{done} in {time.monotonic() - began:.0f} s; report: {report}")
    if results.parquet is None:
        print(f"scores.csv only, no Parquet table: {MISSING}")
    for name, why in results.failed.items():
        print(f"failed: {name}: {why}", file=sys.stderr)
    if results.failed:
        total = len(results.finished) + len(results.failed)
        raise AnimatError(f"{len(results.failed)} of {total} cultures failed; the same command tries them again")
    return {
        "folder": str(results.folder),
        "report": str(report),
        "cultures": list(results.finished),
        "over_cultures": [asdict(row) for row in results.summary],
        "not_outperforming_the_heuristic": list(results.not_outperforming),
        "warnings": {name: [each.to_dict() for each in of] for name, of in results.warnings.items()},
    }
