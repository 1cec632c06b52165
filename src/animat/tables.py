"""Tables of measurements: read-only columns of equal length, checks of times, and short representations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from animat.errors import UnusableData, shown

UNKNOWN = -1
"""Stands for an unknown electrode or pattern, and pads `Stimuli.electrodes`."""

CENTURY_S = 100 * 365.25 * 24 * 3600
FASTEST_HZ = 1e9
"""No time of a recording is farther from 0 than `CENTURY_S`, and no rate or frequency is above `FASTEST_HZ`."""


def freeze(table: object, name: str, **dtypes: Any) -> None:
    """Turn the named attributes into read-only arrays of these types and of equal length."""
    length = None
    for attribute, dtype in dtypes.items():
        array = freeze_one(table, attribute, dtype)
        # Only sets of electrodes have a second dimension, which their table checks.
        is_column = array.ndim == 1 or (attribute == "electrodes" and array.ndim > 0)
        if not is_column or length not in (None, len(array)):
            expected = "a column of" if length is None else length
            raise UnusableData(f"{attribute}: expected {expected} values in {name}, got shape {array.shape}")
        length = len(array)


def freeze_one(table: object, attribute: str, dtype: Any = None) -> np.ndarray[Any, Any]:
    """Turn an attribute of a frozen dataclass into a read-only array, and return it; refuse to truncate numbers."""
    value = getattr(table, attribute)
    try:
        given = np.asarray(value)
        with np.errstate(invalid="ignore"):
            array = read_only_copy(given, dtype)
    except (TypeError, ValueError):
        # Text, None, or rows of different lengths.
        raise UnusableData(f"{attribute}: expected an array of numbers, got {shown(value)}") from None
    if array.dtype.kind == "i" and given.dtype.kind in "fu" and np.any(differ := array != given):
        raise UnusableData(f"{attribute}: expected whole numbers, got {given[differ][0]:g}")
    object.__setattr__(table, attribute, array)
    return array


def read_only_copy(array: ArrayLike, dtype: Any = None) -> np.ndarray[Any, Any]:
    """A read-only copy of an array."""
    own = np.array(array, dtype=dtype)
    own.setflags(write=False)
    return own


MOST_PADDED = 50_000_000


def padded(lists: Sequence[Sequence[int]]) -> Int64[np.ndarray, "lists longest"]:
    """Lists of electrodes as one table, padded with `UNKNOWN`; refuses a long list among many: memory would fill."""
    width = max([1, *map(len, lists)])
    if width * len(lists) > MOST_PADDED:
        raise UnusableData(f"stimulus_electrodes: expected a few electrodes per stimulus, got {width} in one row")
    table = np.full((len(lists), width), UNKNOWN, dtype=np.int64)
    for row, electrodes in zip(table, lists, strict=True):
        row[: len(electrodes)] = electrodes
    return table


def evenly(n: int, most: int) -> Int64[np.ndarray, " some"]:
    """Indices of at most `most` of n items, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def expect_times(name: str, times_s: Float64[np.ndarray, " times"]) -> None:
    """Raise UnusableData, naming the column, for times that are not finite or not within a century."""
    if bad := np.count_nonzero(~np.isfinite(times_s)):
        raise UnusableData(f"{name}: expected finite times in seconds, got {bad:,} of {len(times_s):,} NaN or infinite")
    far = np.abs(times_s) > CENTURY_S
    if np.any(far):
        got = times_s[far][0]
        raise UnusableData(f"{name}: expected times in seconds, within a century, got {got:g}; are they in seconds?")


def expect_rising_times(name: str, times_s: Float64[np.ndarray, " times"]) -> None:
    """`expect_times`, also for times that fall."""
    expect_times(name, times_s)
    if np.any(np.diff(times_s) < 0):
        raise UnusableData(f"{name}: expected times that do not fall; sort them with their channels first")


def reduce_dataclass(record: Any) -> tuple[Any, ...]:
    """A `__reduce__` for dataclasses with read-only arrays, which keeps them read-only when unpickled."""
    values = {field.name: getattr(record, field.name) for field in fields(record) if field.init}
    plain = {name: dict(value) if isinstance(value, MappingProxyType) else value for name, value in values.items()}
    return _recreate, (type(record), plain)


def _recreate(kind: type[Any], values: dict[str, Any]) -> Any:
    return kind(**values)


def briefly(record: Any) -> str:
    """A short `__repr__` for dataclasses."""
    shown = (f"{field.name}={_brief(getattr(record, field.name))}" for field in fields(record) if field.repr)
    return f"{type(record).__name__}({', '.join(shown)})"


def _brief(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple | list | dict) and len(value) > 6:
        return f"<{len(value)} values>"
    text = repr(value)
    return text if len(text) <= 200 else f"<{type(value).__name__}>"
