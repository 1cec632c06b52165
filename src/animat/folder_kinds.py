"""The files that identify what a folder holds, so that two commands do not mix their work in one folder."""

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
"""Names or patterns, any one of which is enough. The modules that write these files import JAX; this one does not."""
_DESCRIPTIONS: dict[Kind, str] = {
    "session": "a session",
    "training": "policies",
    "tuning": "a tuning",
    "study": "a study",
    "cultures": "a study of many cultures",
    "recording": "recordings",
    "live": "a live run",
}


def expect_no_other(folder: Path, kind: Kind) -> None:
    """Raise Mismatch if a folder holds work of other kinds and none of this kind; a missing folder holds nothing."""
    if not is_folder(folder):
        return
    found = {each: [file.name for name in names for file in folder.glob(name)] for each, names in MARKERS.items()}
    others = ", ".join(f"{_DESCRIPTIONS[each]} ({min(names)})" for each, names in found.items() if names)
    # Work of this kind continues, whatever else is in the folder.
    if others and not found[kind]:
        wanted = _DESCRIPTIONS[kind]
        raise Mismatch(f"{folder}: expected a folder for {wanted}, got one with {others}; choose another folder")
