"""Whether a program works in a folder: by the lock that it has on it, which is looked up and never tried."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from animat.writing import LOCK

_LOCKS = Path("/proc/locks")
_SILENT_S = 60.0
"""Where locks cannot be looked up: without a change for so long, nobody works there."""


def is_held(folder: Path) -> bool | None:
    """Whether a run has locked a folder; None where the system does not say."""
    try:
        numbers = {str(each.stat().st_ino) for each in (folder, folder / LOCK) if each.exists()}
        lines = [line.split() for line in _LOCKS.read_text().splitlines()]
    except OSError:
        return None
    # Whoever waits for a lock has an arrow before it, and does not hold it.
    return any(words[1:2] == ["FLOCK"] and words[5].rpartition(":")[2] in numbers for words in lines if len(words) > 5)


def state_of(folder: Path, changed_s: float, *, is_done: bool) -> dict[str, Any]:
    """How work in a folder stands, in words, by when something of it changed last and whether nothing is left to do."""
    if is_done:
        return {"state": "ended", "message": "everything is done"}
    held = is_held(folder)
    silent_s = max(0.0, time.time() - changed_s)
    if held or (held is None and silent_s < _SILENT_S):
        return {"state": "running", "message": ""}
    message = (
        "no program works in the folder: it was stopped, was killed or failed, in which case its command said why; "
        "start it again and it continues"
    )
    return {"state": "silent", "message": message}
