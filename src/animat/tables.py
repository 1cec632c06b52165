"""Tables of what was measured: read-only columns of one length, times that can be times, and objects told in short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import UnusableData

UNKNOWN = -1
"""Stands for an unknown electrode or pattern, and pads `Stimuli.electrodes`."""

CENTURY_S = 100 * 365.25 * 24 * 3600
FASTEST_HZ = 1e9
"""No time of a recording is farther from 0 than the one, and no rate or frequency above the other."""


def freeze(table: object, name: str, **dtypes: Any) -> None:
    """Turn the named attributes into read-only arrays of these types and of one length."""
    length = None
    for attribute, dtype in dtypes.items():
        array = read_only(table, attribute, dtype)
        if array.ndim == 0 or (length is not None and len(array) != length):
            raise UnusableData(
                f"{attribute}: expected {length if length is not None else 'a column of'} values in {name}, "
                f"got shape {array.shape}"
            )
        length = len(array)


def read_only(table: object, attribute: str, dtype: Any = None) -> np.ndarray[Any, Any]:
    """Turn an attribute of a frozen dataclass into an array that nobody changes; returns it."""
    array = np.array(getattr(table, attribute), dtype=dtype)
    array.setflags(write=False)
    object.__setattr__(table, attribute, array)
    return array


MOST_PADDED = 50_000_000


def fits_padded(lists: Sequence[Sequence[int]]) -> bool:
    """Whether lists of whole numbers can be padded: one long row must not fill memory, nor a number lose digits."""
    most = max([1, *map(len, lists)]) * len(lists)
    return most <= MOST_PADDED and all(abs(number) < 2**53 for row in lists for number in row)


def padded(lists: Sequence[Sequence[int]]) -> Int64[np.ndarray, "lists longest"]:
    """Lists of electrodes as one table, padded with `UNKNOWN`."""
    table = np.full((len(lists), max([1, *map(len, lists)])), UNKNOWN, dtype=np.int64)
    for row, electrodes in zip(table, lists, strict=True):
        row[: len(electrodes)] = electrodes
    return table


def evenly(n: int, most: int) -> Int64[np.ndarray, " some"]:
    """Of n things in a row at most so many, evenly spread, by their numbers."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def expect_times(name: str, times_s: Float64[np.ndarray, " times"]) -> None:
    """Refuse times that are not finite, or not within a century (UnusableData, by the name of the column)."""
    if bad := np.count_nonzero(~np.isfinite(times_s)):
        raise UnusableData(f"{name}: expected finite times in seconds, got {bad} of {len(times_s)} NaN or infinite")
    far = np.abs(times_s) > CENTURY_S
    if np.any(far):
        raise UnusableData(
            f"{name}: expected times in seconds, within a century, got {times_s[far][0]:g}; are they in seconds?"
        )


def expect_rising_times(name: str, times_s: Float64[np.ndarray, " times"]) -> None:
    """Refuse also times that fall."""
    expect_times(name, times_s)
    if np.any(np.diff(times_s) < 0):
        raise UnusableData(f"{name}: expected times that do not fall; sort them with their channels first")


def reduce_dataclass(record: Any) -> tuple[Any, ...]:
    """A dataclass whose arrays are read-only, to be its `__reduce__`: they are so too where it is unpickled."""
    values = (getattr(record, field.name) for field in fields(record))
    return type(record), tuple(dict(value) if isinstance(value, MappingProxyType) else value for value in values)


def briefly(record: Any) -> str:
    """A dataclass in a line or a few, to be its `__repr__`."""
    shown = (f"{field.name}={_brief(getattr(record, field.name))}" for field in fields(record) if field.repr)
    return f"{type(record).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple | list | dict) and len(value) > 6:
        return f"<{len(value)} values>"
    text = repr(value)
    return text if len(text) <= 200 else f"<{type(value).__name__}>"
