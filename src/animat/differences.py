"""Where two descriptions differ, said to somebody whose folder holds another thing than was asked for."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile, Mismatch

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
    elif isinstance(found, list) and isinstance(wanted, list) and _are_entered(found, wanted):
        # What both have; of different lengths they differ at the latest where one ends.
        pairs = [(one, other, f"{name}[{i}]") for i, (one, other) in enumerate(zip(found, wanted, strict=False))]
        pairs += [(len(found), len(wanted), f"{name}, how many")]
    else:
        return "" if found == wanted else f"{name}: {_short(found)} there, {_short(wanted)} now"
    told = (first_difference(one, other, place, ignoring=ignoring) for one, other, place in pairs)
    return next((difference for difference in told if difference), "")


def _are_entered(found: list[Any], wanted: list[Any]) -> bool:
    """Whether lists are compared entry by entry: not where they are told as a whole, of different lengths but short."""
    return len(found) == len(wanted) or max(len(repr(found)), len(repr(wanted))) > _LONGEST


def fingerprint_of(description: dict[str, Any], *more: bytes) -> str:
    """SHA-256 over plain data, and bytes beside."""
    digest = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
    for part in more:
        digest.update(part)
    return digest.hexdigest()


def with_fingerprint(description: dict[str, Any]) -> dict[str, Any]:
    """Plain data by way of JSON, in which a tuple and a list are the same, with a fingerprint over all of it."""
    told: dict[str, Any] = json.loads(json.dumps(description))
    return told | {"fingerprint": fingerprint_of(told)}


def read_description(path: Path, what: str) -> dict[str, Any] | None:
    """What a file of JSON says of the folder that it lies in, with its fingerprint; None if there is none.

    What the folder holds, such as a `study`, is for the message of an InvalidFile, if it cannot be read.
    """
    if not path.exists():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        _ = found["fingerprint"]
    except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        raise InvalidFile(f"{path}: expected a {what}'s description, got a file that cannot be read") from error
    return found


def folder_mismatch(folder: Path, what: str, difference: str) -> Mismatch:
    """The error of a folder that holds another study or training than was asked for."""
    return Mismatch(
        f"{folder}: expected a folder of this {what}, got one of another ({difference}); give another folder, or "
        "remove this one"
    )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
