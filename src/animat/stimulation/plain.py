"""Numbers copied as Python's own types, so that nothing can change them after they are checked."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

from animat.errors import InvalidArgument


def number(name: str, value: Any) -> float:
    """A number of any type as a float, including NaN and infinity; InvalidArgument for anything else, such as True."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    if type(value) is bool or not isinstance(value, Real):
        raise InvalidArgument(f"{name}: expected a number, got {_kind(value)}")
    try:
        return float(value)
    except OverflowError as error:
        raise InvalidArgument(f"{name}: expected a finite number, got one beyond 1e308") from error


def whole_number(name: str, value: Any) -> int:
    """A whole number of any type as an int; InvalidArgument for anything else, including True and False."""
    value = value.item() if getattr(value, "ndim", None) == 0 else value
    is_whole = isinstance(value, Integral) or (isinstance(value, float) and value.is_integer())
    if type(value) is not bool and is_whole:
        return int(value)
    raise InvalidArgument(f"{name}: expected a whole number, got {value if isinstance(value, Real) else _kind(value)}")


def seconds(name: str, value: Any) -> float:
    """A time in seconds as a float, from a float64 or a whole number; including NaN and infinity.

    Raises InvalidArgument for less precise types: float32 is 1 ms off after 10,000 s.
    """
    if type(value) is float:
        return value
    if isinstance(value, float) or (type(value) is not bool and isinstance(value, Integral)):
        return number(name, value)
    why = "less precise times are milliseconds off after some hours; compute them in float64"
    raise InvalidArgument(f"{name}: expected seconds as float64, which is Python's float, got {_kind(value)}: {why}")


def _kind(value: Any) -> str:
    return f"{value}" if isinstance(value, bool) or value is None else type(value).__name__
