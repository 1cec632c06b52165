"""Numbers as Python's own, copied once: nothing can change what was checked."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

from animat.errors import InvalidArgument


def number(name: str, value: Any) -> float:
    """A number of any type as a float, NaN and infinity included.

    Raises:
        InvalidArgument: naming the argument, for anything else, True and False among it.
    """
    if type(value) is float:
        return value
    if getattr(value, "ndim", None) == 0:
        value = value.item()
    if type(value) is bool or not isinstance(value, Real):
        raise InvalidArgument(f"{name}: expected a number, got {_kind(value)}")
    try:
        return float(value)
    except OverflowError as error:
        raise InvalidArgument(f"{name}: expected a finite number, got one beyond 1e308") from error


def whole_number(name: str, value: Any) -> int:
    """A whole number of any type as an int.

    Raises:
        InvalidArgument: naming the argument, for anything else, True and False among it.
    """
    if type(value) is int:
        return value
    if getattr(value, "ndim", None) == 0:
        value = value.item()
    if type(value) is not bool and isinstance(value, Integral):
        return int(value)
    if isinstance(value, float) and value.is_integer():
        return int(value)
    told = f"{value}" if isinstance(value, Real) else _kind(value)
    raise InvalidArgument(f"{name}: expected a whole number, got {told}")


def seconds(name: str, value: Any) -> float:
    """A time in seconds as a float, from a float64 or a whole number; NaN and infinity included.

    Raises:
        InvalidArgument: naming the argument, for what is less precise: float32 is 1 ms off after 10,000 s.
    """
    if type(value) is float:
        return value
    if isinstance(value, float) or (type(value) is not bool and isinstance(value, Integral)):
        return number(name, value)
    raise InvalidArgument(
        f"{name}: expected seconds as float64, which is Python's float, got {_kind(value)}: less precise times are "
        "milliseconds off after some hours; compute them in float64"
    )


def _kind(value: Any) -> str:
    return f"{value}" if isinstance(value, bool) or value is None else type(value).__name__
