"""What a policy's provenance may say, where anything reads it: how it was trained, and on which simulators.

The rest of it is for people and is kept as it is. JAX is not imported here: policies are loaded without it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

from animat.errors import InvalidArgument, shown

Expected = tuple[str, Callable[[Any], bool]]


def is_number(value: Any) -> bool:
    """Whether it is a finite number, as JSON has them."""
    # For a whole number beyond all floats math.isfinite raises an error.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 10**9


def _one_of(*words: str) -> Expected:
    return f"one of {', '.join(words)}", lambda value: isinstance(value, str) and value in words


_POSITIVE: Expected = "a positive number", lambda value: is_number(value) and value > 0

READ: Mapping[str, Mapping[str, Expected]] = {
    "training": {
        "shadowing": ("true or false", lambda value: isinstance(value, bool)),
        "duration_min": ("a positive number, or none", lambda value: value is None or _POSITIVE[1](value)),
        "chunks": ("a whole number from 1 on", _whole),
        "percentiles": _one_of("moving", "first"),
        "delivery": _one_of("chosen", "shuffled"),
    },
    "simulators": {
        "kind": _one_of("histogram", "empirical", "memory"),
        "bins": ("a whole number from 1 on, or none", lambda value: value is None or _whole(value)),
        "range_hz": ("a positive number, or none", lambda value: value is None or _POSITIVE[1](value)),
        "by": ("text, or none", lambda value: value is None or isinstance(value, str)),
        "burst_threshold": (
            "a share of channels from 0 to 1, or none",
            lambda value: value is None or (is_number(value) and 0 <= value <= 1),
        ),
        "recorded_at_min": (
            "minutes",
            lambda value: isinstance(value, list) and all(is_number(minute) for minute in value),
        ),
    },
}
"""All that is read of a provenance: what each may be, in words and as a check; what is left out is not known."""


def expect_provenance(provenance: Any) -> None:
    """Refuse a provenance in which something that is read cannot be.

    Raises:
        InvalidArgument: naming it, what was expected and what came.
    """
    if not isinstance(provenance, Mapping):
        raise InvalidArgument(f"provenance: expected named data, got {shown(provenance)}")
    for part, entries in READ.items():
        told = provenance.get(part)
        if told is None:
            continue
        if not isinstance(told, Mapping):
            raise InvalidArgument(f"provenance.{part}: expected named data, got {shown(told)}")
        for name, (expected, is_good) in entries.items():
            if name in told and not is_good(told[name]):
                raise InvalidArgument(f"provenance.{part}.{name}: expected {expected}, got {shown(told[name])}")
        # From when on a simulator was the last one in training takes both.
        if told.get("duration_min") is not None and "chunks" not in told:
            raise InvalidArgument(f"provenance.{part}: expected chunks beside duration_min, got none")
