"""What a study comes to, as typed records: read by the tasks that show it, and exported as CSV and Parquet tables."""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints
from zipfile import BadZipFile

import numpy as np

from animat.errors import InvalidArgument, InvalidFile
from animat.evaluation.optimum import bracket_findings
from animat.recordings.findings import Finding
from animat.records import read_record
from animat.writing import atomic_write, write_whole

T = TypeVar("T")


@dataclass(frozen=True)
class StudyOptimum:
    """The optimal return on a robot, as in `animat.evaluation.optimum.Optimum`; None for what is not known.

    Attributes:
        at_min: the recording that answers.
        low_95, high_95: of the interval that few responses leave.
        left_out: the conditions that have too few responses to count, with their number.
    """

    robot: str
    mapping: str
    percentiles: str
    at_min: float
    best_return: float | None
    low_95: float | None
    high_95: float | None
    grid_error: float | None
    monte_carlo: float | None
    standard_error: float | None
    without_clock: float | None
    without_clock_standard_error: float | None
    nodes: int | None
    left_out: str | None

    def findings(self) -> tuple[Finding, ...]:
        """Where the value and its controller's return part."""
        known = (self.best_return, self.grid_error, self.monte_carlo, self.standard_error)
        told = [value for value in known if value is not None]
        return bracket_findings(*told) if len(told) == len(known) else ()


@dataclass(frozen=True)
class Score:
    """An arm at a minute: means over policies, beside random actions and the optimum."""

    robot: str
    arm: str
    mapping: str
    at_min: float
    policies: int
    episodes: int
    mean_return: float
    standard_deviation: float | None
    interquartile_mean: float
    low_95: float | None
    high_95: float | None
    random: float | None
    optimum: float | None
    optimum_grid_error: float | None
    optimum_run: float | None
    optimum_run_standard_error: float | None
    optimum_without_clock: float | None
    normalised_score: float | None
    score_without_clock: float | None


@dataclass(frozen=True)
class ComparedReturns:
    """Two arms on a robot: the test, its outcome, and the paper's where it printed one."""

    comparison: str
    robot: str
    first: str
    second: str
    at_min: float
    episodes: int
    n: int
    mean_first: float
    mean_second: float
    score_first: float | None
    score_second: float | None
    random_second: float | None
    optimum_first: float | None
    optimum_second: float | None
    optimum_error_first: float | None
    optimum_error_second: float | None
    u: float
    p_normal: float
    p_exact: float
    p_holm: float
    effect: float
    effect_low_95: float
    effect_high_95: float
    outcome: str
    paper_u: float | None
    paper_p: float | None
    as_in_paper: str | None


@dataclass(frozen=True)
class ControlReturns:
    """A control, or trained policies beside it, at a minute."""

    robot: str
    mapping: str
    percentiles: str
    at_min: float
    control: str
    actors: int
    mean_return: float
    standard_error: float | None
    random: float | None
    optimum: float | None
    normalised_score: float | None


@dataclass(frozen=True)
class BesideHeuristic:
    """Trained policies beside the heuristic policy: mean returns, Mann-Whitney over episodes, share of pairs won."""

    robot: str
    arm: str
    at_min: float
    mean_return: float
    heuristic: float
    p: float
    wins: float
    outcome: str


@dataclass(frozen=True)
class BesideReflex:
    """Trained policies beside the best coupling, as in `animat.evaluation.coupling`; None for what is not known.

    Attributes:
        coupling: its mean return.
        gap: the context gap of the task, with the ends of its 95 % interval.
        needs_context: whether the task surely needs more than a reflex.
        score: the context score of the policies, with the ends of its 95 % interval.
    """

    robot: str
    arm: str
    at_min: float
    coupling: float
    coupling_standard_error: float | None
    optimum: float
    gap: float | None
    gap_low_95: float | None
    gap_high_95: float | None
    needs_context: bool
    score: float | None
    score_low_95: float | None
    score_high_95: float | None


@dataclass(frozen=True)
class ObjectiveMet:
    """How far episodes of an arm's policies or of a control met an objective of a robot's goal, and all of the goal.

    Attributes:
        success_share, margin: of the goal, the same for all of its objectives.
        objective: as a text.
        satisfaction: of the objective, %.
    """

    robot: str
    arm: str
    agent: str
    at_min: float
    episodes: int
    success_share: float
    margin: float
    objective: str
    satisfaction: float


@dataclass(frozen=True)
class Results:
    """All that was found."""

    scores: tuple[Score, ...]
    comparisons: tuple[ComparedReturns, ...]
    controls: tuple[ControlReturns, ...]
    heuristic: tuple[BesideHeuristic, ...]
    optima: tuple[StudyOptimum, ...]
    findings: tuple[Finding, ...]
    goals: tuple[ObjectiveMet, ...] = ()
    reflexes: tuple[BesideReflex, ...] = ()


def write_typed(path: Path, value: Any) -> Path:
    """Write records, complete or absent: `read_typed` reads them."""
    plain = [asdict(each) for each in value] if isinstance(value, Sequence) else asdict(value)
    return write_whole(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_typed(path: Path, kind: type[T]) -> T:
    """Read what `write_typed` wrote; raises InvalidFile if it cannot be read, or is of another version."""
    try:
        return read_record(kind, json.loads(path.read_text()))
    except (OSError, ValueError, InvalidArgument) as error:
        raise InvalidFile(f"{path}: expected results of this study, got a file that cannot be read: {error}") from error


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays by name as NumPy's npz, complete or absent; the same bytes always."""
    with atomic_write(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return path


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what `write_arrays` wrote; raises InvalidFile if it cannot be read."""
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, BadZipFile, zlib.error) as error:
        raise InvalidFile(f"{path}: expected arrays of this study, got a file that cannot be read: {error}") from error


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a CSV file, complete or absent; numbers with all their digits, None as nothing."""
    with atomic_write(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
    return path


def write_records(path: Path, kind: type, rows: Iterable[Any]) -> Path:
    """Write records as a CSV file, a column a field."""
    return write_table(path, [field.name for field in fields(kind)], (astuple(row) for row in rows))


def write_named_records(path: Path, named: Iterable[tuple[str, Any]], kind: type, name: str) -> Path:
    """The same with a first column of this name, which comes with each record."""
    head = [name, *(field.name for field in fields(kind))]
    return write_table(path, head, ((first, *astuple(row)) for first, row in named))


MISSING = "fastparquet is not installed: pip install 'animat[parquet]'"


def write_parquet(path: Path, named: Sequence[tuple[str, Any]], kind: type, name: str) -> bool:
    """Write records, as `write_named_records` takes them, complete or absent; numbers that may be None are NaN there.

    Returns whether it was written: not where fastparquet is missing.
    """
    try:
        import fastparquet
    except ImportError:
        return False
    import pandas as pd

    hints = get_type_hints(kind)
    dtypes = {int: "int64", str: object, str | None: object}
    columns = {name: pd.Series([first for first, _ in named], dtype=object)}
    for each in fields(kind):
        values = [getattr(row, each.name) for _, row in named]
        columns[each.name] = pd.Series(values, dtype=dtypes.get(hints[each.name], "float64"))
    strings = [column for column, values in columns.items() if values.dtype == object]
    encodings = {column: "utf8" if column in strings else "infer" for column in columns}
    with atomic_write(path) as beside:
        fastparquet.write(str(beside), pd.DataFrame(columns), object_encoding=encodings, write_index=False)
    return True
