"""Where two descriptions differ, said to somebody whose folder holds another thing than was asked for."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

_LONGEST = 60


class _Nothing:
    """What stands where a key is missing."""

    def __repr__(self) -> str:
        return "nothing"


_NOTHING = _Nothing()


def first_difference(found: Any, wanted: Any, name: str = "", *, ignoring: Collection[str] = ()) -> str:
    """The first place where two pieces of plain data differ, such as `training.seed: 1 there, 2 now`.

    Args:
        found: what is there: numbers, texts, lists and dictionaries of such.
        wanted: what was asked for.
        name: of both, for the front of the sentence.
        ignoring: keys that do not matter, at any depth.

    Returns:
        The place and both values, cut short where they are long; nothing (an empty text) where they are the same.
    """
    if isinstance(found, dict) and isinstance(wanted, dict):
        pairs = [
            (found.get(key, _NOTHING), wanted.get(key, _NOTHING), f"{name}.{key}" if name else str(key))
            for key in sorted(set(found) | set(wanted))
            if key not in ignoring
        ]
    elif isinstance(found, list) and isinstance(wanted, list) and len(found) == len(wanted):
        pairs = [(one, other, f"{name}[{i}]") for i, (one, other) in enumerate(zip(found, wanted, strict=True))]
    else:
        return "" if found == wanted else f"{name}: {_short(found)} there, {_short(wanted)} now"
    told = (first_difference(one, other, place, ignoring=ignoring) for one, other, place in pairs)
    return next((difference for difference in told if difference), "")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
