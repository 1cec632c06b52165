"""Values from files in a form safe for a page: finite numbers, texts of limited length."""

from __future__ import annotations

import json
import math
from typing import Any

_MOST_LETTERS = 300


def number(value: Any) -> float | None:
    """A finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return value if math.isfinite(value) else None
    except OverflowError:
        return None


def whole(value: Any) -> int | None:
    """A whole number that JavaScript can hold; None for anything else."""
    is_whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
    return value if is_whole else None


def numbers(value: Any) -> list[float | None]:
    """The items of a list as numbers; a number as a list of one; an empty list for anything else."""
    if isinstance(value, list | tuple):
        return [number(item) for item in value[:64]]
    return [] if number(value) is None else [number(value)]


def text(value: Any, most: int = _MOST_LETTERS) -> str:
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


def listed(value: Any) -> list[Any]:
    """A list; empty for anything else."""
    return value if isinstance(value, list) else []


def mapped(value: Any) -> dict[str, Any]:
    """A dictionary; empty for anything else."""
    return value if isinstance(value, dict) else {}
