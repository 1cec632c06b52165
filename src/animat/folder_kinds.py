"""By which files it is known what a folder holds, so that the work of one command is not put among another's."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from animat.errors import Mismatch
from animat.plain_file import is_folder

Kind = Literal["session", "training", "tuning", "study", "cultures", "recording", "live"]

MARKERS: dict[Kind, tuple[str, ...]] = {
    "session": ("session.log",),
    "training": ("training.json", "[!.]*.safetensors"),
    "tuning": ("tune.json",),
    "study": ("study.json",),
    "cultures": ("cultures.json",),
    "recording": ("recording_*_min.nwb", "culture.state"),
    "live": ("live.log",),
}
"""Names or patterns, one of which is enough; the modules that write the files import JAX, which others do without."""
_TOLD: dict[Kind, str] = {
    "session": "a session",
    "training": "policies",
    "tuning": "a tuning",
    "study": "a study",
    "cultures": "a study of many cultures",
    "recording": "recordings",
    "live": "a live run",
}


def expect_no_other(folder: Path, kind: Kind) -> None:
    """Raise Mismatch if a folder holds work of other kinds and none of this one; a missing one holds nothing."""
    if not is_folder(folder):
        return
    found = {each: [file.name for name in names for file in folder.glob(name)] for each, names in MARKERS.items()}
    others = [f"{_TOLD[each]} ({min(names)})" for each, names in found.items() if names]
    # Where some of it is there already it goes on, whatever came beside.
    if others and not found[kind]:
        there = ", ".join(others)
        raise Mismatch(f"{folder}: expected a folder for {_TOLD[kind]}, got one of {there}; choose another folder")
