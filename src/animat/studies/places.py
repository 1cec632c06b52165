"""Paths of everything in a study's folder."""

from __future__ import annotations

from pathlib import Path

from animat.execution.task import UNFINISHED
from animat.studies.specification import Arm, RobotSpec

RECORDINGS = "recordings"
TIMELINE = "simulators/timeline.safetensors"
RESPONSES = "simulators/responses.csv"
RESULTS = "tables/results.json"
REPORT = "report.html"
RECEIPTS = "jobs"
OWN_FOLDERS = (
    RECORDINGS, "simulators", "policies", "episodes", "controls", "optima", "tables", "figures", RECEIPTS, UNFINISHED,
)  # fmt: skip
"""All folders that a study makes in its folder; its other files are the report, the specification and its manifest."""


def policies_folder(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    """The policies of an arm on a robot."""
    return folder / "policies" / spec.name / arm.slug


def episodes_file(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    """The episodes of an arm's policies on a robot; each arm has its own folder, so that names cannot collide."""
    return folder / "episodes" / spec.name / arm.slug / "episodes.npz"


def paths_file(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    """One complete episode of each of an arm's policies on a robot."""
    return folder / "episodes" / spec.name / arm.slug / "paths.npz"


def controls_file(folder: Path, spec: RobotSpec, arm: Arm) -> Path:
    """The episodes of the controls of an arm's mapping on a robot."""
    return folder / "controls" / spec.name / arm.thresholds / "episodes.npz"


def optima_file(folder: Path, robot: str, what: str = "optima") -> Path:
    """The optimal returns on a robot."""
    return folder / "optima" / f"{robot}-{what}.json"


def table_file(folder: Path, name: str) -> Path:
    """A table of results as CSV."""
    return folder / "tables" / f"{name}.csv"
