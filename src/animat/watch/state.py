"""Whether a program is working in a folder, by looking up its lock, never by trying to lock."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from animat.execution.task import UNFINISHED
from animat.writing import LOCK

_LOCKS = Path("/proc/locks")
_SILENT_S = 60.0
"""If locks cannot be looked up, a folder without a change for this long counts as idle."""


def is_locked(folder: Path) -> bool | None:
    """Whether a run has locked a folder; None if the system does not report it."""
    try:
        numbers = {str(path.stat().st_ino) for path in (folder, folder / LOCK) if path.exists()}
        lines = [line.split() for line in _LOCKS.read_text().splitlines()]
    except OSError:
        return None
    # A process that waits for a lock has an arrow before it, and does not hold it.
    return any(words[1:2] == ["FLOCK"] and words[5].rpartition(":")[2] in numbers for words in lines if len(words) > 5)


def state_of(folder: Path, *, is_done: bool) -> dict[str, Any]:
    """The state of work in a folder, with a message."""
    if is_done:
        return {"state": "ended", "message": "everything is done"}
    locked = is_locked(folder)
    if locked or (locked is None and time.time() - _last_change_s(folder) < _SILENT_S):
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


def _last_change_s(folder: Path) -> float:
    """When work in a folder last changed it, or a subfolder."""
    paths = [folder, folder / "jobs", *folder.glob("*/jobs"), *(folder / UNFINISHED).rglob("*")]
    return max(changed_s(path) or 0.0 for path in paths)
