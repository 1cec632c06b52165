"""A study over many cultures: the same study of each in a folder of its own, and what holds over all of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from animat.errors import AnimatError
from animat.progress import Part, Progress, Silent
from animat.studies.parquet import write_parquet
from animat.studies.places import results_file
from animat.studies.results import ComparedReturns, Results, Score, read_typed, write_records, write_table
from animat.studies.run import Ran, run_study
from animat.studies.source import read_seeds
from animat.studies.specification import Study
from animat.studies.tabulating import SECOND

RESAMPLES = 10_000
COMPARISONS, SUMMARY, SCORES = "comparisons.csv", "over-cultures.csv", "scores.csv"


@dataclass(frozen=True)
class OverCultures:
    """A comparison on a robot, over cultures.

    Attributes:
        cultures: how many.
        mean_first, mean_second: mean returns of the arms, each culture counting the same.
        difference: mean of the cultures' differences, second less first.
        low_95, high_95: of its percentile bootstrap over cultures; None of fewer than two. Of few cultures it is too
            narrow.
        holds_in: cultures in which the second arm was found to be better.
    """

    comparison: str
    robot: str
    cultures: int
    mean_first: float
    mean_second: float
    difference: float
    low_95: float | None
    high_95: float | None
    holds_in: int


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
    """Run a study of many cultures, or go on with one: culture after culture, each as `run_study` does.

    A culture whose study fails is told in the end, and the others go on. More cultures may be added later: what is done
    is not done again.

    Args:
        study: with `seeds` or `folders` in its culture.
        folder: where everything goes; made if it is missing.
        base, workers, executor, progress: as of `run_study`.

    Raises:
        AnimatError: if the study of every culture failed, with what each failed of.
    """
    folder, progress = Path(folder).absolute(), progress or Silent()
    studies = studies_of(study)
    ran: dict[str, Ran] = {}
    failed: dict[str, str] = {}
    for i, (name, each) in enumerate(studies.items()):
        try:
            part = Part(progress, i, 1, len(studies), name)
            ran[name] = run_study(each, folder / name, base=base, workers=workers, executor=executor, progress=part)
        except AnimatError as error:
            failed[name] = str(error)
            if len(failed) == len(studies):
                raise AnimatError("; ".join(f"{which}: {why}" for which, why in failed.items())) from error
    results = {name: read_typed(results_file(each.folder), Results) for name, each in ran.items()}
    comparisons = {name: each.comparisons for name, each in results.items()}
    summary = over_cultures(list(comparisons.values()))
    head = ["culture", *ComparedReturns.__dataclass_fields__]
    rows = [(name, *asdict(row).values()) for name, compared in comparisons.items() for row in compared]
    write_table(folder / COMPARISONS, head, rows)
    write_records(folder / SUMMARY, OverCultures, summary)
    scores = [(name, score) for name, each in results.items() for score in each.scores]
    rows = [(name, *asdict(score).values()) for name, score in scores]
    write_table(folder / SCORES, ["culture", *Score.__dataclass_fields__], rows)
    parquet = (folder / SCORES).with_suffix(".parquet")
    is_written = write_parquet(parquet, scores, Score, "culture")
    return RanCultures(folder, ran, failed, comparisons, summary, parquet if is_written else None)


def over_cultures(found: Sequence[Sequence[ComparedReturns]]) -> tuple[OverCultures, ...]:
    """Each comparison over cultures.

    Args:
        found: the comparisons of each culture, the same ones in the same order.
    """
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
        holds_in=sum(row.outcome == SECOND for row in rows),
    )


def bootstrap_interval(values: Float64[np.ndarray, " cultures"]) -> tuple[float, float]:
    """The 95 % percentile interval of the mean, by drawing as many values with replacement; the same always."""
    drawn = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), (0.025, 0.975))
    return float(low), float(high)
