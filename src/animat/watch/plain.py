"""Values from files in a form safe for a page: finite numbers, texts of limited length, packed spikes."""

from __future__ import annotations

import base64
import json
import sys
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_MOST_SPIKES = 60_000
"""Most spikes sent at once."""


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
    # Halves of surrogate pairs cannot be sent.
    string = string[: most + 1].encode("utf-8", "replace").decode("utf-8")
    return string if len(string) <= most else string[: most - 1] + "…"


def short(value: Any) -> str:
    """A setting in a few characters."""
    known = number(value)
    if known is None:
        return text(value, 60)
    return f"{known:,}" if isinstance(known, int) else f"{known:.4g}"


def settings(values: dict[str, Any]) -> str:
    """Settings by name, in a few characters each."""
    return ", ".join(f"{text(name, 40)} {short(value)}" for name, value in values.items())


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
