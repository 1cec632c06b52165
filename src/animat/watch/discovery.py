"""What is in a folder to watch, such as sessions, trainings and recordings, and whether a program is working there."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from animat.closed_loop.session import LOG_FILE
from animat.errors import InvalidArgument
from animat.execution.task import UNFINISHED
from animat.folders import MARKERS, FolderKind
from animat.recordings.formats.npz import UNDER_WAY
from animat.writing import LOCK

_MARKS = {kind: names[0] for kind, names in MARKERS.items() if kind != "recording"}
"""The file that identifies each kind."""
_DEPTH, _MOST_FOLDERS, _MOST_ITEMS = 6, 4000, 2000
MOST_RECORDINGS = 500
_SKIPPED = ("jobs", "figures", "tables", "checkpoints")
"""Folders in an item's own, in which there is nothing to watch."""
_LOCKS = Path("/proc/locks")
_SILENT_S = 60.0
"""If locks cannot be looked up, a folder without a change for this long counts as idle."""


@dataclass(frozen=True)
class Item:
    """An item to watch: its place in the watched folder ("": the folder itself), and when it last changed."""

    kind: FolderKind
    place: str
    changed_s: float


def find(folder: Path) -> list[Item]:
    """The items in a folder, which need not exist yet, and its subfolders, newest first, without links."""
    items = [item for subfolder in _folders(folder) for item in _in_folder(folder, subfolder)]
    items.sort(key=lambda item: (-item.changed_s, item.place))
    # An item that contains the others is kept, however many are newer.
    containers = [item for item in items[_MOST_ITEMS:] if item.kind == "cultures" or not item.place]
    return items[:_MOST_ITEMS] + containers


def place_within(folder: Path, place: str) -> Path:
    """A folder inside the watched one, by its place there; raises InvalidArgument for one outside."""
    try:
        inside = (folder / place).resolve()
    except (OSError, ValueError) as error:
        raise InvalidArgument("in: expected a folder inside the watched one, got an invalid name") from error
    if not inside.is_relative_to(folder.resolve()):
        raise InvalidArgument("in: expected a folder inside the watched one, got one outside")
    return inside


def _folders(folder: Path) -> Iterator[Path]:
    """The folder and its subfolders, level by level."""
    folders = [(folder, 1)]
    # The list grows while it is read.
    for parent, depth in islice(folders, _MOST_FOLDERS):
        yield parent
        if depth < _DEPTH:
            _, names, _ = next(os.walk(parent), ("", [], []))
            # Unlike `Path.is_file`, this is false in a folder that cannot be read.
            skipped = _SKIPPED if any(os.path.isfile(parent / mark) for mark in _MARKS.values()) else ()  # noqa: PTH113
            below = [parent / name for name in sorted(names) if name[0] != "." and name not in skipped]
            folders += [(each, depth + 1) for each in below if not each.is_symlink()]


def _in_folder(root: Path, folder: Path) -> Iterator[Item]:
    place = "" if folder == root else folder.relative_to(root).as_posix()
    for kind, name in _MARKS.items():
        file = folder / name
        try:
            if file.is_file() and not file.is_symlink():
                yield Item(kind, place, max(file.stat().st_mtime, folder.stat().st_mtime))
        except OSError:
            continue
    if times_s := recordings_in(folder):
        yield Item("recording", place, max(times_s.values()))


def recordings_in(folder: Path) -> dict[Path, float]:
    """The NWB recordings in a folder, and the one in progress, with when each last changed; none of a session.

    At most `MOST_RECORDINGS`, the newest.
    """
    try:
        if (folder / LOG_FILE).exists():
            return {}
        files = [*sorted(folder.glob("[!.]*.nwb")), folder / UNDER_WAY]
        found = [(file, changed_s(file)) for file in files if file.is_file() and not file.is_symlink()]
        times_s = {file: time_s for file, time_s in found if time_s is not None}
        newest = set(sorted(times_s, key=times_s.__getitem__, reverse=True)[:MOST_RECORDINGS])
        return {file: time_s for file, time_s in times_s.items() if file in newest}
    except OSError:
        return {}


def is_locked(folder: Path) -> bool | None:
    """Whether a run has locked a folder, without trying to lock it; None if the system does not report it."""
    try:
        numbers = {str(path.stat().st_ino) for path in (folder, folder / LOCK) if path.exists()}
        lines = [line.split() for line in _LOCKS.read_text().splitlines()]
    except OSError:
        return None
    # By inode alone: on btrfs and some overlays a file's device is not the one listed. If a folder on another disk has
    # the same inode, work that ended may look alive, but never the other way round.
    # A process that waits for a lock has an arrow before it, and does not hold it.
    return any(words[1:2] == ["FLOCK"] and words[5].rpartition(":")[2] in numbers for words in lines if len(words) > 5)


def state_of(folder: Path, *, is_done: bool) -> dict[str, Any]:
    """The state of work in a folder, with a message."""
    if is_done:
        return {"state": "ended", "message": "everything is done"}
    if (locked := is_locked(folder)) is None:
        paths = [folder, *folder.glob("*"), *folder.glob("*/jobs"), *(folder / UNFINISHED).rglob("*")]
        locked = time.time() - max(changed_s(path) or 0.0 for path in paths) < _SILENT_S
    if locked:
        return {"state": "running", "message": ""}
    message = (
        "no program is working in the folder: the run was stopped, was killed or failed (its command then reported "
        "why); run its command again to continue"
    )
    return {"state": "silent", "message": message}


def changed_s(path: Path) -> float | None:
    """When a file or folder last changed; None if there is none."""
    try:
        return path.stat().st_mtime
    except OSError:
        return None
