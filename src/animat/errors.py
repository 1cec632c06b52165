"""The errors of animat: each names the argument or file, what was expected, what came, and what to do."""

from __future__ import annotations

import copyreg
import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


class AnimatError(Exception):
    """Base of every error that a user can cause and mend; the command line prints it in one line.

    The message names the argument or file, what was expected, what came, and what to do.

    Attributes:
        is_admitted: of an error of `Culture.deliver`: its guard had admitted stimuli, which may have been delivered.
    """

    is_admitted = False

    def __reduce__(self) -> tuple[Any, ...]:
        # Not made again by its arguments, which are others than its message: it goes from process to process.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class InvalidArgument(AnimatError, ValueError):
    """An argument, option or configuration value is outside what it may be."""


class InvalidFile(AnimatError):
    """A file is missing, damaged, of another kind, or does not hold what it should."""


class UnusableData(AnimatError):
    """Data were read, but what was asked of them cannot be done (a dead window, no stimuli, an empty condition)."""


class Mismatch(AnimatError):
    """Two things that must belong together do not (a policy for another robot, conditions of another recording)."""


class UnsafeStimulus(AnimatError):
    """A stimulus is outside what the culture's safety limits allow; nothing of the request was delivered.

    Attributes:
        limit: the name of the limit, a field of `animat.cultures.safety.Limits` or `"sites"`, `"overlap"`, `"stopped"`.
    """

    def __init__(self, limit: str, message: str) -> None:
        super().__init__(f"{limit}: {message}; nothing was delivered")
        self.limit = limit


class BudgetSpent(AnimatError):
    """A stimulation budget does not hold what was asked for; nothing of the request was delivered."""


class LoopEnded(AnimatError):
    """A closed loop ended before its time, by a fault or a person; all of its ticks are in its folder."""


class DeviceFailed(AnimatError):
    """A device cannot be used or failed while it was (no driver, no connection, a pulse that did not come)."""


class BodyFailed(AnimatError):
    """A body of somebody else (`gymnasium:...`) raised, hung, or gave no finite numbers; what was finished stays."""


def in_min(minutes: float) -> str:
    """A time on the culture's clock as messages and tables have it: with two decimals at most."""
    return f"{round(minutes, 2):.10g} min"


def shown(value: object) -> str:
    """A value as a message shows it: in one line, and cut where it is longer than anyone reads."""
    try:
        text = re.sub(r"\s*\n\s*", " ", repr(value))
    except (ValueError, RecursionError):
        # Python writes no whole number of more than 4,300 digits, and nothing that is nested without end.
        text = f"a number of {value.bit_length():,} bits" if isinstance(value, int) else f"a {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:80]}... ({len(text):,} characters)"


def some_of(names: Sequence[object], most: int = 8) -> str:
    """The first of some names, and dots where there are more."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def expect_kind(what: str, given: object, kind: Any, words: str) -> None:
    """Refuse what is of another kind than an argument should be, such as a path in the place of what is read from it.

    Raises:
        InvalidArgument: naming the argument, what was expected, in `words`, and what came.
    """
    if not isinstance(given, kind):
        raise InvalidArgument(f"{what}: expected {words}, got {shown(given)}")


def expect_several(what: str, given: Any, kind: Any, words: str) -> tuple[Any, ...]:
    """The same of several, all of one kind, which are returned; a text and a table of names are none."""
    expect_kind(what, given, Iterable, words)
    several = (given,) if isinstance(given, str | bytes | Mapping) else tuple(given)
    for each in several:
        expect_kind(what, each, kind, words)
    return several


def did_you_mean(word: str, among: Iterable[str]) -> str:
    """The end of a message on a word that is none of those expected: the nearest of them, if any is near."""
    near = difflib.get_close_matches(word, list(among), n=1, cutoff=0.7)
    return f"; did you mean {near[0]}?" if near else ""


def first_line(error: BaseException) -> str:
    """What somebody else's code raised: its type, and the first line of what it says."""
    lines = str(error).strip().splitlines() or ["no more is known"]
    return f"{type(error).__name__}: {lines[0]}"


def out_of_memory(error: BaseException) -> str | None:
    """That memory was too little, with how much was asked for at the last where that is told; None for another error.

    JAX has an error of its own for it (RESOURCE_EXHAUSTED), which is known by its words: it is not imported for this.
    """
    if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
        return None
    asked = re.search(r"llocat\w+ ([\d.]+ ?\w*)", str(error))
    return f"out of memory ({asked[1]} more were asked for)" if asked else "out of memory"
