"""What a page may show of a run in progress: small files, read whole or treated as missing, and values made safe.

Numbers are finite, texts of limited length, and spikes packed.
"""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from animat.errors import InvalidFile
from animat.execution.task import NOTICES, UNFINISHED
from animat.plain_file import expect_plain_file, read_plain_text

_MOST_BYTES = 2**24
_MOST_SPIKES = 60_000

JobProgress = dict[str, tuple[float, str]]
"""The share done of each job, and a message."""


def number(value: Any) -> float | None:
    """A finite number; None for anything else."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # A whole number in a file can be larger than any float.
    return value if is_number and abs(value) <= sys.float_info.max else None


def numbers(values: Any) -> list[float | None]:
    """The items of a list as numbers; a number as a list of one; an empty list for None."""
    if isinstance(values, list):
        return [number(item) for item in values[:64]]
    return [] if number(values) is None else [number(values)]


def text(value: Any, most: int = 300) -> str:
    """A value as text that a page can show, truncated if it is long."""
    string = value if isinstance(value, str) else json.dumps(value, default=str)
    # Unpaired surrogates cannot be encoded as UTF-8.
    string = string[: most + 1].encode("utf-8", "replace").decode("utf-8")
    return string if len(string) <= most else string[: most - 1] + "…"


def listed(value: Any) -> list[Any]:
    """A list; empty for anything else."""
    return value if isinstance(value, list) else []


def mapped(value: Any) -> dict[str, Any]:
    """A dictionary; empty for anything else."""
    return value if isinstance(value, dict) else {}


def packed(
    times_s: Float[np.ndarray, " spikes"], channels: Int[np.ndarray, " spikes"], from_s: float, to_s: float, n: int
) -> tuple[dict[str, Any], list[int]]:
    """The spikes of a span on n channels, and their number on each.

    Times, from 0 (the span's start) to 65,535 (its end), and channels, of which larger ones are not drawn, are uint16.
    """
    with np.errstate(invalid="ignore"):
        within = (times_s >= from_s) & (times_s <= to_s) & (channels >= 0) & (channels < n)
    times_s, channels = times_s[within], channels[within]
    every = max(1, -(-len(times_s) // _MOST_SPIKES))
    drawn = np.flatnonzero(channels < 2**16)[::every]
    ticks = np.rint((times_s[drawn] - from_s) / max(to_s - from_s, 1e-9) * 65535).astype("<u2")
    spikes = {
        "n": len(times_s),
        "every": every,
        "times": base64.b64encode(ticks.tobytes()).decode(),
        "channels": base64.b64encode(channels[drawn].astype("<u2").tobytes()).decode(),
    }
    return spikes, np.bincount(channels, minlength=n).tolist()


def json_of(path: Path) -> dict[str, Any]:
    """The contents of a JSON file with names and values; empty if there is none or it cannot be read."""
    return mapped(_json_of(path))


def _json_of(path: Path) -> Any:
    try:
        return json.loads(text_of(path, _MOST_BYTES))
    except (InvalidFile, ValueError, RecursionError):
        return None


def text_of(path: Path, most_bytes: int) -> str:
    """The text of a file; raises InvalidFile as `expect_own` and `read_plain_text` do."""
    return read_plain_text(expect_own(path), most_bytes)


def expect_own(path: Path) -> Path:
    """Refuse a link, which may lead anywhere, and what would block its reader for ever, such as a pipe."""
    if path.is_symlink():
        raise InvalidFile(f"{path}: expected a file, got a link")
    return expect_plain_file(path)


def job_progress(folder: Path) -> JobProgress:
    """The last progress reported by the jobs of an unfinished run."""
    progress = {}
    for path in sorted((folder / UNFINISHED / NOTICES).glob("*.json"))[:1000]:
        report = listed(_json_of(path))
        if len(report) == 2 and number(report[0]) is not None:
            # Of policies that are trained together, only one reports a message.
            progress[path.stem.replace("+", "/")] = float(report[0]), text(report[1] or "")
    return progress


def arrays_in(path: Path, names: tuple[str, ...], most_bytes: int) -> list[np.ndarray] | None:
    """Arrays of a numpy archive; None if it cannot be read or they are too large."""
    try:
        with np.load(expect_own(path), allow_pickle=False) as file:
            sizes = [file.zip.getinfo(f"{name}.npy").file_size for name in names]
            return [file[name] for name in names] if sum(sizes) <= most_bytes else None
    except Exception:  # zipfile, zlib and numpy have a dozen kinds of errors for a damaged archive
        return None
