"""What a folder holds that can be watched: sessions, trainings, studies, tunings and recordings, and where."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from animat.closed_loop.gathering import LOG_FILE
from animat.cultures.under_way import UNDER_WAY
from animat.errors import InvalidArgument
from animat.folder_kinds import MARKERS

Kind = Literal["session", "training", "study", "cultures", "tuning", "recording"]

_MARKED: tuple[Kind, ...] = ("session", "training", "tuning", "study", "cultures")
_MARKS = tuple((kind, MARKERS[kind][0]) for kind in _MARKED)
"""By which file each is known."""
_DEPTH, _MOST_FOLDERS, _MOST_FOUND = 4, 4000, 2000
_PASSED_OVER = ("jobs", "figures", "tables", "checkpoints")


@dataclass(frozen=True)
class Found:
    """Something that can be watched: where in the folder that is watched ("": itself), and when it changed last."""

    kind: Kind
    place: str
    changed_s: float


def find(folder: Path) -> list[Found]:
    """What is in a folder and in those below it, what changed last first; links that lead out of it are left out.

    A folder that is not there yet holds nothing.
    """
    found = [each for place in _folders(folder) for each in _in_folder(folder, place)]
    found.sort(key=lambda each: (-each.changed_s, each.place))
    # What all the others are part of is among them, however many came after it.
    is_whole = [each for each in found[_MOST_FOUND:] if each.kind == "cultures" or not each.place]
    return found[:_MOST_FOUND] + is_whole


def place_within(folder: Path, place: str) -> Path:
    """A folder below the one that is watched, by its place there; raises InvalidArgument for one outside of it."""
    try:
        inside = (folder / place).resolve()
    except (OSError, ValueError) as error:
        raise InvalidArgument("in: expected a folder below the one that is watched, got no name of one") from error
    if not inside.is_relative_to(folder.resolve()):
        raise InvalidArgument("in: expected a folder below the one that is watched, got one outside")
    return inside


def _folders(folder: Path) -> Iterator[Path]:
    """The folder and those below it, nearest first."""
    level, seen = [folder], 0
    for _ in range(_DEPTH):
        below: list[Path] = []
        for each in level:
            seen += 1
            if seen > _MOST_FOLDERS:
                return
            yield each
            try:
                with os.scandir(each) as entries:
                    below += [
                        each / entry.name
                        for entry in entries
                        if entry.is_dir(follow_symlinks=False)
                        and entry.name[0] != "."
                        and entry.name not in _PASSED_OVER
                    ]
            except OSError:
                continue
        level = sorted(below)


def _in_folder(root: Path, folder: Path) -> Iterator[Found]:
    place = "" if folder == root else folder.relative_to(root).as_posix()
    for kind, name in _MARKS:
        file = folder / name
        try:
            if file.is_file() and file.resolve().is_relative_to(root.resolve()):
                newest_s = max(file.stat().st_mtime, folder.stat().st_mtime)
                yield Found(kind, place, newest_s)
        except OSError:
            continue
    changed_s = [when for when in map(changed, (*recordings_in(folder), folder / UNDER_WAY)) if when is not None]
    if changed_s:
        yield Found("recording", place, max(changed_s))


def changed(file: Path) -> float | None:
    """When a file changed last; None where none is there, or a link."""
    try:
        return None if file.is_symlink() else file.stat().st_mtime
    except OSError:
        return None


def recordings_in(folder: Path) -> list[Path]:
    """The recordings of a folder in NWB, but for that of a session, by their names."""
    try:
        named = sorted(folder.glob("[!.]*.nwb"))
        return [
            file for file in named if file.is_file() and not file.is_symlink() and not (folder / LOG_FILE).exists()
        ][:500]
    except OSError:
        return []
