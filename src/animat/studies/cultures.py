"""A study over many cultures: the same study of each in its own folder, results over all of them, and their page."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from animat.errors import AnimatError, InvalidArgument, counted
from animat.evaluation.statistics import interval_of_mean
from animat.execution.cluster import Cluster
from animat.execution.gpu import find_gpu
from animat.execution.jobs import expect_workers
from animat.execution.pinned import PinnedProcesses
from animat.folders import expect_no_other
from animat.process import own_cores
from animat.progress import Progress, Silent
from animat.recordings.findings import Finding, without_notes
from animat.report.html import Columns, Section, cell, columns_of, picture_of, table_of, write_page
from animat.report.results import ComparedReturns, OverCultures, Results, Score
from animat.report.returns import draw_over_cultures
from animat.report.style import save_formats
from animat.studies.arms import arm_differences, arms_table, capitalised, summarise_arms
from animat.studies.folder import MANIFEST as STUDY
from animat.studies.folder import REPORT, RESULTS, expect_same_specification
from animat.studies.outperforming import not_outperforming_over
from animat.studies.results import read_typed, write_of_cultures, write_parquet, write_records
from animat.studies.run import StudyRun, run_study
from animat.studies.source import read_seeds
from animat.studies.specification import Compared, Study
from animat.studies.tabulating import LEVEL, SECOND, TOO_FEW
from animat.writing import exclusive_lock, write_whole

MOST_AT_ONCE = 64
"""Cultures: each has a thread here, which manages its jobs."""
COMPARISONS, SUMMARY, SCORES = "comparisons.csv", "over-cultures.csv", "scores.csv"
MANIFEST = "cultures.json"
"""Lists the folders of the cultures."""


@dataclass(frozen=True)
class CulturesRun:
    """Results of each finished culture, errors of the others, and a summary; `parquet`: None without fastparquet.

    `warnings` are those of each finished culture. `not_outperforming` has a sentence for each arm whose policies do not
    outperform the heuristic policy in some of them.
    """

    folder: Path
    finished: dict[str, StudyRun]
    failed: dict[str, str]
    comparisons: dict[str, tuple[ComparedReturns, ...]]
    summary: tuple[OverCultures, ...]
    parquet: Path | None
    warnings: Mapping[str, tuple[Finding, ...]] = field(default_factory=dict)
    not_outperforming: tuple[str, ...] = ()


def studies_of(study: Study) -> dict[str, Study]:
    """The study of each culture by the name of its folder; empty for a study of a single culture."""
    culture = study.culture
    if culture.seeds is not None:
        cultures = [replace(culture, seed=seed, seeds=None) for seed in read_seeds(culture.seeds)]
    else:
        cultures = [replace(culture, files=(each,), folders=None) for each in culture.folders or ()]
    return {f"culture-{each.name}": replace(study, culture=each) for each in cultures}


def run_over_cultures(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> CulturesRun:
    """Run or resume a study of many cultures: each culture as in `run_study`, one per core at a time.

    Recording a culture uses one core only; meanwhile the others do jobs of other cultures. If the study of a culture
    fails, the others continue, and the failure is reported at the end. More cultures may be added later.

    Arguments and errors are those of `run_study`, for a study with `seeds` or `folders` in its culture; AnimatError
    also if the study of every culture failed.
    """
    expect_workers(workers, executor)
    folder = Path(folder).absolute()
    studies = studies_of(study)
    if not studies:
        raise InvalidArgument("culture: expected many, by seeds or folders, got a single one; run_study runs its study")
    # Checked first, so that a folder with other work is not touched.
    expect_no_other(folder, "cultures")
    for name, each in studies.items():
        expect_same_specification(each, folder / name)
    for path in sorted(folder.glob(f"culture-*/{STUDY}")):
        if path.parent.name not in studies:
            expect_same_specification(study, path.parent, of_culture=False)
    with exclusive_lock(folder):
        _write_manifest(folder, studies, {})
        with _choose_executor(workers, executor) as (shared, at_once):
            own_workers = workers if shared is None else None
            runs = {
                name: partial(run_study, each, folder / name, base=base, workers=own_workers, executor=shared)
                for name, each in studies.items()
            }
            finished, failed = _run_side_by_side(runs, min(at_once, MOST_AT_ONCE), shared, progress or Silent())
        _write_manifest(folder, studies, failed)
        if not finished:
            raise AnimatError("; ".join(f"{name}: {error}" for name, error in failed.items()))
        results = {name: read_typed(each.folder / RESULTS, Results) for name, each in finished.items()}
        comparisons = {name: each.comparisons for name, each in results.items()}
        summary = tuple(over_cultures(list(comparisons.values())))
        scores = {name: each.scores for name, each in results.items()}
        write_of_cultures(folder / COMPARISONS, ComparedReturns, comparisons)
        write_records(folder / SUMMARY, OverCultures, summary)
        write_of_cultures(folder / SCORES, Score, scores)
        parquet = write_parquet((folder / SCORES).with_suffix(".parquet"), Score, scores)
    warnings = {name: without_notes(each.findings) for name, each in results.items()}
    heuristic = tuple(not_outperforming_over(results.values()))
    return CulturesRun(folder, finished, failed, comparisons, summary, parquet, warnings, heuristic)


def _write_manifest(folder: Path, names: Iterable[str], failed: Mapping[str, str]) -> None:
    write_whole(folder / MANIFEST, json.dumps({"cultures": list(names), "failed": failed}, indent=1) + "\n")


@contextmanager
def _choose_executor(workers: int | None, executor: Executor | None) -> Iterator[tuple[Executor | None, int]]:
    """The executor that all cultures share, and how many cultures at a time keep it busy."""
    if executor is not None:
        yield executor, executor.cores() if isinstance(executor, Cluster) else MOST_AT_ONCE
    elif find_gpu() is not None:
        # The GPU trains all policies of a culture at once.
        yield None, 1
    else:
        cores = own_cores(workers)
        with PinnedProcesses(cores) as processes:
            yield processes, len(cores)


def _run_side_by_side(
    runs: Mapping[str, Callable[..., StudyRun]], at_once: int, shared: Executor | None, progress: Progress
) -> tuple[dict[str, StudyRun], dict[str, str]]:
    """Run studies, `at_once` at a time; returns the finished ones and the errors of the others, in their order."""
    ended, shares = set[str](), dict.fromkeys(runs, 0.0)
    reporting, stopped = threading.Lock(), threading.Event()

    def report(name: str, done: float, total: float = 1.0, note: str = "") -> None:
        if stopped.is_set():
            # Raised in the study that reports, which then ends.
            raise AnimatError("stopped")
        with reporting:
            shares[name] = done / total
            running = {each: share for each, share in shares.items() if share and each not in ended}
            parts = [f"{len(ended)} of {len(runs)} cultures"]
            parts += [f"{each} {100 * share:.0f} %" for each, share in running.items()]
            progress.update(len(ended) + sum(running.values()), len(runs), "; ".join(parts))

    with ThreadPoolExecutor(min(at_once, len(runs)), "culture") as threads:
        of_each = {name: SimpleNamespace(update=partial(report, name)) for name in runs}
        futures = {threads.submit(run, progress=of_each[name]): name for name, run in runs.items()}
        try:
            for future in as_completed(futures):
                if not isinstance(future.exception(), AnimatError):
                    future.result()
                with reporting:
                    ended.add(futures[future])
                report(futures[future], 1.0)
        except BaseException:
            stopped.set()
            threads.shutdown(wait=False, cancel_futures=True)
            if isinstance(shared, PinnedProcesses):
                # Otherwise the studies would wait for their running jobs.
                shared.kill_workers()
            raise
    errors = {name: future.exception() for future, name in futures.items()}
    finished = {name: future.result() for future, name in futures.items() if errors[name] is None}
    return finished, {name: str(error) for name, error in errors.items() if error is not None}


def over_cultures(comparisons: Sequence[Sequence[ComparedReturns]]) -> Iterator[OverCultures]:
    """Each comparison over cultures, all of which have the same comparisons in the same order."""
    for rows in zip(*comparisons, strict=True):
        first, second = np.array([row.mean_first for row in rows]), np.array([row.mean_second for row in rows])
        difference = interval_of_mean(second - first)
        yield OverCultures(
            comparison=rows[0].comparison,
            robot=rows[0].robot,
            cultures=len(rows),
            mean_first=float(first.mean()),
            mean_second=float(second.mean()),
            difference=difference.value,
            low_95=difference.low if len(rows) > 1 else None,
            high_95=difference.high if len(rows) > 1 else None,
            larger_in=int((second > first).sum()),
            holds_in=sum(row.outcome == SECOND for row in rows),
            tested=sum(row.outcome != TOO_FEW for row in rows),
        )


def write_cultures_page(study: Study, found: CulturesRun) -> Path:
    """Write the page and its figure."""
    sections = []
    if found.summary:
        # Every culture has the same comparisons in the same order.
        of_each = zip(*found.comparisons.values(), strict=True)
        differences = ([row.mean_second - row.mean_first for row in rows] for rows in of_each)
        figure = draw_over_cultures([*zip(found.summary, differences, strict=True)])
        save_formats(figure, found.folder, "over-cultures")
        sections.append(_summary(study, found))
    if found.not_outperforming:
        sentences = tuple(f"{capitalised(sentence)}." for sentence in found.not_outperforming)
        sections.append(Section("Against the heuristic policy", sentences))
    pages = {name: f"{name}/{REPORT}" for name in found.finished}
    warned = {name: f", {counted(len(each), 'warning')}" if each else "" for name, each in found.warnings.items()}
    points = [(name, f"finished: {page}{warned.get(name, '')}") for name, page in pages.items()]
    points += [(name, f"failed: {why}") for name, why in found.failed.items()]
    sections.append(Section("Each culture", points=tuple(points), links=tuple(pages.values())))
    cultures = counted(len(found.finished), "culture") + (f", {len(found.failed)} more failed" if found.failed else "")
    lead = f"{cultures}. {summarise_arms(study)} on every culture."
    return write_page(found.folder / REPORT, f"{study.title}: many cultures", lead, sections, [f"Seed {study.seed}."])


def _summary(study: Study, found: CulturesRun) -> Section:
    points, explained = [], set[str]()
    for row in found.summary:
        compared = next(each for each in study.comparisons if each.name == row.comparison)
        differences = list(arm_differences(study.arm(compared.first), study.arm(compared.second)))
        # Each difference is explained only once.
        text = " ".join([_describe(compared, row), *(each for each in differences if each not in explained)])
        points.append((f"{row.robot}, {row.comparison}", text))
        explained |= set(differences)
    columns: Columns = [
        *columns_of("comparison", "robot", "mean_first", "mean_second", "difference"),
        ("95 % interval", lambda row: "–" if row.low_95 is None else f"{cell(row.low_95)} to {cell(row.high_95)}"),
        ("second mean larger in", lambda row: f"{row.larger_in} of {row.cultures}"),
        ("significantly better in", "found_better"),
    ]
    note = (
        "Mean returns; each culture counts the same. Intervals are by Student's t over cultures. Second mean larger "
        "in: cultures in which the second arm's mean return is larger. Significantly better in: those in which it is "
        f"better at p < {LEVEL:g}, as in their own reports."
    )
    table = table_of("Over cultures", found.summary, columns, note=note, beside=SUMMARY)
    caption = (
        "Each point is a culture: the mean return of the second arm's policies minus that of the first's; to the right "
        "of 0 the second arm is better. Above each row of points: their mean with its 95 % interval, of "
        f"{counted(len(found.comparisons), 'culture')}."
    )
    picture = picture_of(found.folder, "over-cultures", "Differences on each culture", caption, COMPARISONS)
    return Section("Results in short", (), tuple(points), (arms_table(study), table), (picture,))


def _describe(compared: Compared, row: OverCultures) -> str:
    larger = (
        f"“{compared.second}” has a larger mean return than “{compared.first}” in {row.larger_in} of "
        f"{counted(row.cultures, 'culture')}"
    )
    if not row.tested:
        return f"{larger}; with so few policies no test finds a difference in one culture."
    return f"{larger}; it is found to be better (p < {LEVEL:g}) in {row.found_better}."
