"""Values of files as a page can take them: finite numbers, texts of bounded length."""

from __future__ import annotations

import json
import math
from typing import Any

_MOST_LETTERS = 300


def number(value: Any) -> float | None:
    """A finite number, None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return value if math.isfinite(value) else None
    except OverflowError:
        return None


def whole(value: Any) -> int | None:
    """A whole number that a page can hold, None for anything else."""
    is_one = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**53
    return value if is_one else None


def numbers(value: Any) -> list[float | None]:
    """Of a list each as a number; of a number, a list of it; of anything else, none."""
    if isinstance(value, list | tuple):
        return [number(each) for each in value[:64]]
    return [] if number(value) is None else [number(value)]


def text(value: Any, most: int = _MOST_LETTERS) -> str:
    """As text that a page can show, cut off where it is long."""
    words = value if isinstance(value, str) else json.dumps(value, default=str)
    # Halves of surrogate pairs cannot be sent.
    words = words[: most + 1].encode("utf-8", "replace").decode("utf-8")
    return words if len(words) <= most else words[: most - 1] + "…"


def short(value: Any) -> str:
    """A setting in a few letters."""
    known = number(value)
    if known is None:
        return text(value, 60)
    return f"{known:,}" if isinstance(known, int) else f"{known:.4g}"


def listed(value: Any) -> list[Any]:
    """A list, empty where it is something else."""
    return value if isinstance(value, list) else []


def mapped(value: Any) -> dict[str, Any]:
    """Names and values, none where it is something else."""
    return value if isinstance(value, dict) else {}
