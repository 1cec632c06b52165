"""Options that take named numbers, `NAME=VALUE ...`: parameters of robots and settings of the algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

from animat.errors import InvalidArgument, did_you_mean, within

if TYPE_CHECKING:
    from animat.training.settings import SAC


def read_numbers(option: str, pairs: Sequence[str]) -> dict[str, float]:
    """Read `NAME=NUMBER` pairs, each name once (else InvalidArgument); whole numbers stay whole."""
    numbers: dict[str, float] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name in numbers:
            raise InvalidArgument(f"{option}: expected {name} once, got it twice")
        try:
            numbers[name] = int(value) if value.lstrip("-").isdecimal() else float(value)
        except ValueError:
            raise InvalidArgument(f"{option}: expected NAME=NUMBER, got {pair!r}") from None
    return numbers


def read_sac(pairs: Sequence[str]) -> SAC:
    """The algorithm's settings, with `pairs` in place of its defaults; InvalidArgument for an impossible one."""
    from animat.training.settings import SAC

    numbers, known = read_numbers("--sac", pairs), [field.name for field in fields(SAC)]
    for name in numbers:
        if name not in known:
            near = did_you_mean(name, known)
            raise InvalidArgument(f"--sac: {name}: no such setting; expected some of {', '.join(known)}{near}")
    with within("--sac"):
        return SAC(**numbers)  # type: ignore[arg-type]
