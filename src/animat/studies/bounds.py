"""What the settings of a study may be: their bounds, which `docs/studies.md` states, and how each is checked."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Literal, get_args, get_origin, get_type_hints

from animat.errors import InvalidArgument, shown
from animat.robots.base import MOST_AT_ONCE

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,60}")

MOST_SESSIONS, MOST_PRESENTATIONS = 10_000, 1_000_000
MOST_TRAINED = 20_000
"""Policies of all conditions on all robots: each is a file, and five are a job."""
FINEST_RESOLUTION = 2.0
"""Of the best possible return's grid: the cartpole's tables are of 2 GiB there, and grow with its fourth power."""


def check_algorithm(settings: dict[str, float]) -> None:
    from animat.training.sac import SAC

    known = get_type_hints(SAC)
    for name, value in settings.items():
        if name not in known:
            raise InvalidArgument(f"algorithm: expected settings among {', '.join(known)}, got {shown(name)}")
        # 64.0 is as large as 64, but no shape of an array.
        if known[name] is int and not isinstance(value, int):
            raise InvalidArgument(f"algorithm.{name}: expected a whole number, got {shown(value)}")
    try:
        SAC(**settings)  # type: ignore[arg-type]
    except InvalidArgument as error:
        raise InvalidArgument(f"algorithm.{error}") from error


def check_name(what: str, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise InvalidArgument(f"{what}: expected letters, digits, spaces, dots and dashes, got {shown(name)}")
    try:
        float(name)
    except ValueError:
        return
    raise InvalidArgument(f"{what}: expected a name, got {name!r}, which in a table would be a number")


def expect_unlike(what: str, names: Sequence[str]) -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise InvalidArgument(f"{what}: expected each name once, got {name!r} {times} times")


def expect_counts(where: str, owner: object, **bounds: tuple[int, int]) -> None:
    """Every count is a whole number within what is stated in `docs/studies.md`."""
    for name, (least, most) in bounds.items():
        value = getattr(owner, name)
        expected = ""
        if not isinstance(value, int) or isinstance(value, bool):
            expected = "a whole number"
        elif value < least:
            expected = f"at least {least}"
        elif value > most:
            expected = f"at most {most:,}"
        if expected:
            prefix = f"{where}." if where else ""
            raise InvalidArgument(f"{prefix}{name}: expected {expected}, got {shown(value)}")


def expect_at_once(name: str, episodes: int, policies: int) -> None:
    """All policies are evaluated side by side."""
    if episodes * policies > MOST_AT_ONCE:
        raise InvalidArgument(
            f"{name}: expected at most {MOST_AT_ONCE:,} of all policies together, got {episodes:,} of each of "
            f"{policies}"
        )


def expect_trained(policies: int) -> None:
    if policies > MOST_TRAINED:
        raise InvalidArgument(
            f"policies: expected at most {MOST_TRAINED:,} in a study, got {policies:,} (robots x conditions x policies)"
        )


def expect_choices(where: str, owner: object) -> None:
    """Every choice is one of those that its type names."""
    for name, hint in get_type_hints(type(owner)).items():
        if get_origin(hint) is Literal and getattr(owner, name) not in get_args(hint):
            prefix = f"{where}." if where else ""
            expected = ", ".join(get_args(hint))
            raise InvalidArgument(f"{prefix}{name}: expected one of {expected}, got {getattr(owner, name)!r}")


def expect_seed(name: str, value: int) -> None:
    # JAX takes 32 bits of a seed: beyond them two seeds would give the same draws.
    if not 0 <= value < 2**32:
        raise InvalidArgument(f"{name}: expected a whole number from 0 to 4294967295, got {shown(value)}")


def expect_resolution(name: str, value: float) -> None:
    if not 0.1 <= value <= FINEST_RESOLUTION:
        raise InvalidArgument(f"{name}: expected a number from 0.1 to {FINEST_RESOLUTION:g}, got {value:g}")


def expect_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InvalidArgument(f"{name}: expected a positive number, got {value:g}")
