"""Where everything lies in a study's folder, and its tables as CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.execution.task import UNFINISHED
from animat.studies.specification import Body, StudyCondition
from animat.writing import written_whole

RECORDINGS = "recordings"
TIMELINE = "simulators/timeline.safetensors"
RESPONSES = "simulators/responses.csv"
REPORT = "report.html"
RECEIPTS = "jobs"
OWN_FOLDERS = (
    RECORDINGS,
    "simulators",
    "policies",
    "episodes",
    "controls",
    "limits",
    "tables",
    "figures",
    RECEIPTS,
    UNFINISHED,
)
"""All that a study makes in its folder, beside the report, the specification and its description."""


def policies_folder(folder: Path, body: Body, condition: StudyCondition) -> Path:
    """Of the policies of a condition on a robot."""
    return folder / "policies" / body.name / condition.slug


def episodes_file(folder: Path, body: Body, condition: StudyCondition, what: str = "episodes") -> Path:
    """A table of a condition's policies on a robot: their episodes, their paths, or their means over time.

    Every condition has a folder of its own, so that no name of one can be a file of another's.
    """
    return folder / "episodes" / body.name / condition.slug / f"{what}.csv"


def controls_file(folder: Path, body: Body, condition: StudyCondition, what: str = "episodes") -> Path:
    """A table of the controls of a condition's mapping on a robot: their episodes, or random over time."""
    return folder / "controls" / body.name / condition.thresholds / f"{what}.csv"


def limits_file(folder: Path, robot: str, what: str = "limits") -> Path:
    """The best possible returns on a robot."""
    return folder / "limits" / f"{robot}-{what}.csv"


def table_file(folder: Path, name: str) -> Path:
    """A table of results."""
    return folder / "tables" / f"{name}.csv"


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a CSV file, complete or absent; numbers with all their digits, None as nothing."""
    with written_whole(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)
    return path


def read_table(path: Path) -> list[dict[str, Any]]:
    """Read what `write_table` wrote: numbers as float where they are some, nothing as None, else text.

    Raises:
        InvalidFile: if it cannot be read.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [{name: _cell(cell) for name, cell in row.items()} for row in csv.DictReader(file)]
    except (OSError, ValueError, csv.Error) as error:
        raise InvalidFile(f"{path}: expected a table of the study, got a file that cannot be read: {error}") from error


def _cell(cell: str) -> Any:
    if not cell:
        return None
    try:
        return float(cell)
    except ValueError:
        return cell
