"""Where everything lies in a study's folder."""

from __future__ import annotations

from pathlib import Path

from animat.execution.task import UNFINISHED
from animat.studies.specification import Body, StudyCondition

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
    "optima",
    "tables",
    "figures",
    RECEIPTS,
    UNFINISHED,
)
"""All that a study makes in its folder, beside the report, the specification and its description."""


def policies_folder(folder: Path, body: Body, condition: StudyCondition) -> Path:
    """Of the policies of a condition on a robot."""
    return folder / "policies" / body.name / condition.slug


def episodes_file(folder: Path, body: Body, condition: StudyCondition) -> Path:
    """The episodes of a condition's policies on a robot.

    Every condition has a folder of its own, so that no name of one can be a file of another's.
    """
    return folder / "episodes" / body.name / condition.slug / "episodes.npz"


def paths_file(folder: Path, body: Body, condition: StudyCondition) -> Path:
    """One whole episode of each of a condition's policies on a robot."""
    return folder / "episodes" / body.name / condition.slug / "paths.npz"


def controls_file(folder: Path, body: Body, condition: StudyCondition) -> Path:
    """The episodes of the controls of a condition's mapping on a robot."""
    return folder / "controls" / body.name / condition.thresholds / "episodes.npz"


def optima_file(folder: Path, robot: str, what: str = "optima") -> Path:
    """The optimal returns on a robot."""
    return folder / "optima" / f"{robot}-{what}.json"


def results_file(folder: Path) -> Path:
    """All results, typed."""
    return folder / "tables" / "results.json"


def table_file(folder: Path, name: str) -> Path:
    """A table of results, for people and other programs."""
    return folder / "tables" / f"{name}.csv"
