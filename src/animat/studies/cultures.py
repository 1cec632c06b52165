"""A study over many cultures: the same study of each in a folder of its own, and what holds over all of them."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from animat.errors import AnimatError
from animat.execution.cluster import Cluster
from animat.execution.gpu import find_gpu
from animat.execution.jobs import expect_workers
from animat.execution.pinned import PinnedProcesses, own_cores
from animat.folder_kinds import expect_no_other
from animat.progress import Progress, Silent
from animat.report.results import ComparedReturns, OverCultures, Results, Score
from animat.studies.places import results_file
from animat.studies.results import read_typed, write_named_records, write_parquet, write_records
from animat.studies.run import Ran, run_study
from animat.studies.source import read_seeds
from animat.studies.specification import Study
from animat.studies.tabulating import SECOND, TOO_FEW
from animat.writing import exclusive_lock, write_whole

RESAMPLES = 10_000
MOST_AT_ONCE = 64
"""Cultures: each has a thread here, which looks after its jobs."""
COMPARISONS, SUMMARY, SCORES = "comparisons.csv", "over-cultures.csv", "scores.csv"
MANIFEST = "cultures.json"
"""Names the folders of the cultures."""


@dataclass(frozen=True)
class RanCultures:
    """What a run over cultures did.

    Attributes:
        folder: with a folder for each culture.
        ran: the cultures that are finished, by the name of their folder.
        failed: why the others are not.
        comparisons: of each finished culture, by name.
        summary: over all of them.
        parquet: the scores as a Parquet table; None where fastparquet is missing.
    """

    folder: Path
    ran: dict[str, Ran]
    failed: dict[str, str]
    comparisons: dict[str, tuple[ComparedReturns, ...]]
    summary: tuple[OverCultures, ...]
    parquet: Path | None


def studies_of(study: Study) -> dict[str, Study]:
    """The study of each culture by the name of its folder; none if the study is of one culture alone.

    Raises:
        InvalidArgument: for two folders of recordings of the same name.
    """
    culture = study.culture
    if culture.seeds is not None:
        return {
            f"culture-{seed}": replace(study, culture=replace(culture, seed=seed, seeds=None))
            for seed in read_seeds(culture.seeds)
        }
    folders = culture.folders or ()
    return {
        f"culture-{Path(each).name}": replace(study, culture=replace(culture, files=(each,), folders=None))
        for each in folders
    }


def run_over_cultures(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RanCultures:
    """Run a study of many cultures, or go on with one: each culture as `run_study` does, one for each core at a time.

    A culture is recorded on one core, whatever there is. Beside it the jobs of other cultures are done.

    A culture whose study fails is told in the end, and the others go on. More cultures may be added later: what is done
    is not done again.

    Args:
        study: with `seeds` or `folders` in its culture.
        folder: where everything goes; made if it is missing.
        base, workers, executor, progress: as of `run_study`.

    Raises:
        AnimatError: if the study of every culture failed, with what each failed of.
        Mismatch: if the folder holds work of another kind, or another run is at work in it.
        InvalidArgument: for fewer workers than one, or any beside an executor.
    """
    expect_workers(workers, executor)
    folder = Path(folder).absolute()
    studies = studies_of(study)
    # Seen before it is touched: somebody else's folder stays as it is.
    expect_no_other(folder, "cultures")
    with exclusive_lock(folder):
        _name_cultures(folder, studies, {})
        with _room(workers, executor) as (room, at_once):
            here = workers if room is None else None
            runs = {
                name: partial(run_study, each, folder / name, base=base, workers=here, executor=room)
                for name, each in studies.items()
            }
            ran, failed = _side_by_side(runs, min(at_once, MOST_AT_ONCE), room, progress or Silent())
        _name_cultures(folder, studies, failed)
        return _over_those_that_ran(folder, ran, failed)


def _name_cultures(folder: Path, names: Iterable[str], failed: Mapping[str, str]) -> None:
    """Say which folders there are, and which of them failed of what."""
    write_whole(folder / MANIFEST, json.dumps({"cultures": list(names), "failed": failed}, indent=1) + "\n")


def _over_those_that_ran(folder: Path, ran: dict[str, Ran], failed: dict[str, str]) -> RanCultures:
    """Write the tables over the cultures that are finished."""
    if not ran:
        raise AnimatError("; ".join(f"{which}: {why}" for which, why in failed.items()))
    results = {name: read_typed(results_file(each.folder), Results) for name, each in ran.items()}
    comparisons = {name: each.comparisons for name, each in results.items()}
    summary = over_cultures(list(comparisons.values()))
    compared = [(name, row) for name, rows in comparisons.items() for row in rows]
    scores = [(name, score) for name, each in results.items() for score in each.scores]
    write_named_records(folder / COMPARISONS, compared, ComparedReturns, "culture")
    write_records(folder / SUMMARY, OverCultures, summary)
    write_named_records(folder / SCORES, scores, Score, "culture")
    parquet = (folder / SCORES).with_suffix(".parquet")
    is_written = write_parquet(parquet, scores, Score, "culture")
    return RanCultures(folder, ran, failed, comparisons, summary, parquet if is_written else None)


@contextmanager
def _room(workers: int | None, executor: Executor | None) -> Iterator[tuple[Executor | None, int]]:
    """Where the jobs of all cultures are run, and how many cultures at once keep that busy."""
    if executor is not None:
        yield executor, executor.cores() if isinstance(executor, Cluster) else MOST_AT_ONCE
    elif find_gpu() is not None:
        # It trains all policies of a culture at once.
        yield None, 1
    else:
        cores = own_cores(workers)
        with PinnedProcesses(cores) as ours:
            yield ours, len(cores)


def _side_by_side(
    runs: Mapping[str, Callable[..., Ran]], at_once: int, room: Executor | None, progress: Progress
) -> tuple[dict[str, Ran], dict[str, str]]:
    """Run studies, so many at a time: those that are finished, and why the others are not."""
    ran: dict[str, Ran] = {}
    failed: dict[str, str] = {}
    together = _Together(progress, len(runs))
    with ThreadPoolExecutor(min(at_once, len(runs)), "culture") as threads:
        futures = {threads.submit(run, progress=together.of(name)): name for name, run in runs.items()}
        try:
            for future in as_completed(futures):
                name = futures[future]
                try:
                    ran[name] = future.result()
                except AnimatError as error:
                    failed[name] = str(error)
                together.end(name)
        except BaseException:
            together.stop()
            threads.shutdown(wait=False, cancel_futures=True)
            if isinstance(room, PinnedProcesses):
                # Else the studies would wait for what runs.
                room.kill_workers()
            raise
    return {name: ran[name] for name in runs if name in ran}, {name: failed[name] for name in runs if name in failed}


class _Together:
    """The progress of many studies, each of which is told of its own; stopped, it stops them at their next report."""

    def __init__(self, whole: Progress, studies: int) -> None:
        self._whole, self._studies = whole, studies
        self._shares: dict[str, float] = {}
        self._ended = 0
        self._lock = threading.Lock()
        self._is_stopped = False

    def of(self, name: str) -> Progress:
        """That of one study."""
        return _OfOne(partial(self._see, name))

    def end(self, name: str) -> None:
        """It is finished, or has failed."""
        with self._lock:
            self._shares.pop(name, None)
            self._ended += 1
        self._tell()

    def stop(self) -> None:
        """Stop them all."""
        self._is_stopped = True

    def _see(self, name: str, share: float) -> None:
        if self._is_stopped:
            raise AnimatError("stopped")
        with self._lock:
            self._shares[name] = share
        self._tell()

    def _tell(self) -> None:
        with self._lock:
            running = "; ".join(f"{name} {100 * share:.0f} %" for name, share in self._shares.items())
            note = f"{self._ended} of {self._studies} cultures" + (f"; {running}" if running else "")
            self._whole.update(self._ended + sum(self._shares.values()), self._studies, note)


class _OfOne:
    def __init__(self, see: Callable[[float], None]) -> None:
        self._see = see

    def update(self, done: float, total: float, note: str = "") -> None:
        """Tell the others of it."""
        self._see(done / total)


def over_cultures(found: Sequence[Sequence[ComparedReturns]]) -> tuple[OverCultures, ...]:
    """Each comparison over cultures, of which all have the same ones in the same order."""
    return tuple(_over(rows) for rows in zip(*found, strict=True))


def _over(rows: tuple[ComparedReturns, ...]) -> OverCultures:
    first, second = np.array([row.mean_first for row in rows]), np.array([row.mean_second for row in rows])
    low, high = bootstrap_interval(second - first) if len(rows) > 1 else (None, None)
    return OverCultures(
        comparison=rows[0].comparison,
        robot=rows[0].robot,
        cultures=len(rows),
        mean_first=float(first.mean()),
        mean_second=float(second.mean()),
        difference=float((second - first).mean()),
        low_95=low,
        high_95=high,
        larger_in=int((second > first).sum()),
        holds_in=sum(row.outcome == SECOND for row in rows),
        tested=sum(row.outcome != TOO_FEW for row in rows),
    )


def bootstrap_interval(values: Float64[np.ndarray, " cultures"]) -> tuple[float, float]:
    """The 95 % percentile interval of the mean, by drawing as many values with replacement; the same always."""
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), (0.025, 0.975))
    return float(low), float(high)
