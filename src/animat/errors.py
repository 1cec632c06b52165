"""The errors of animat: each names the argument or file, what was expected, what came, and what to do about it."""

from __future__ import annotations

import copyreg
import difflib
import os
import re
import sysconfig
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_OURS_AND_PYTHONS = str(Path(__file__).parent), sysconfig.get_path("stdlib")
"""The folders of animat and of Python's own modules."""


class AnimatError(Exception):
    """Base of every error that a user can cause and fix; the command line prints it in one line.

    Attributes:
        is_admitted: for errors of `Culture.deliver`: its guard had admitted stimuli, which may have been delivered.
    """

    is_admitted = False

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors are pickled between processes, and the constructors of some take more than the message.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class InvalidArgument(AnimatError, ValueError):
    """An argument, option or configuration value is not allowed."""


class InvalidFile(AnimatError):
    """A file is missing, damaged, of the wrong kind, or lacks what it should hold."""


class UnusableData(AnimatError):
    """Data were read but cannot be used as requested (a dead window, no stimuli, an empty condition)."""


class Mismatch(AnimatError):
    """Two things that must belong together do not (a policy for another robot, conditions of another recording)."""


class UnsafeStimulus(AnimatError):
    """A stimulus exceeds the culture's safety limits; nothing of the request was delivered.

    Attributes:
        limit: the name of the limit, a field of `animat.cultures.safety.Limits` or `"sites"`, `"overlap"`, `"stopped"`.
            The message begins with it, or with another `argument`.
    """

    def __init__(self, limit: str, message: str, argument: str | None = None) -> None:
        super().__init__(f"{argument or limit}: {message}; nothing was delivered")
        self.limit = limit


class BudgetSpent(AnimatError):
    """A request exceeds what is left of a stimulation budget; nothing of it was delivered."""


class LoopEnded(AnimatError):
    """A closed loop ended early, through a fault or a person; all of its ticks are in its folder."""


class DeviceFailed(AnimatError):
    """A device cannot be used, or failed during use (no driver, no connection, a missing pulse)."""


class BodyFailed(AnimatError):
    """A third-party body (`gymnasium:...`) raised, hung, or returned non-finite numbers; finished work is kept."""


@contextmanager
def within(name: object, kinds: tuple[type[AnimatError], ...] = (InvalidArgument,)) -> Iterator[None]:
    """Put a name in front of an InvalidArgument, or of errors of these kinds, that is raised in this context."""
    try:
        yield
    except kinds as error:
        raise type(error)(f"{name}: {error}") from error


@contextmanager
def in_file(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what is wrong with the contents of a file, raised in this context, into an InvalidFile that names it."""
    try:
        yield
    except (InvalidArgument, UnusableData) as error:
        raise InvalidFile(f"{path}: {error}") from error


@contextmanager
def as_invalid_file(path: str | os.PathLike[str], failure: str = "cannot be read", ending: str = "") -> Iterator[None]:
    """Turn an OSError raised in this context into an InvalidFile: path, failure, the system's reason, `ending`."""
    try:
        yield
    except OSError as error:
        raise InvalidFile(f"{path}: {failure}: {error.strerror or error}{ending}") from error


def in_min(minutes: float) -> str:
    """A time on the culture's clock for messages and tables, with at most two decimals."""
    return f"{round(minutes, 2):.10g} min"


def shown(value: object) -> str:
    """A value for a message: on one line, and cut if it is long."""
    try:
        text = re.sub(r"\s*\n\s*", " ", repr(value))
    except (ValueError, RecursionError):
        # Python cannot write whole numbers of more than 4,300 digits, nor endlessly nested values.
        text = f"a number of {value.bit_length():,} bits" if isinstance(value, int) else f"a {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:80]}... ({len(text):,} characters)"


def some_of(names: Sequence[object], most: int = 8) -> str:
    """The first names of a list, and dots if there are more."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def counted(n: int, noun: str, plural: str = "") -> str:
    """A number of things for messages and tables; the usual plural ends with `s`."""
    return f"{n:,} {noun if n == 1 else plural or f'{noun}s'}"


def expect_at_least(what: str, given: float | None, least: int) -> None:
    """Raise InvalidArgument for an argument below a limit; None passes."""
    if given is not None and given < least:
        raise InvalidArgument(f"{what}: expected {f'at least {least}' if least else '0 or more'}, got {given}")


def expect_kind(what: str, given: object, kind: Any, words: str) -> None:
    """Raise InvalidArgument for an argument of the wrong type, such as a path in place of the recording it holds."""
    if not isinstance(given, kind):
        raise InvalidArgument(f"{what}: expected {words}, got {shown(given)}")


def expect_several(what: str, given: Any, kind: Any, words: str) -> tuple[Any, ...]:
    """The same for several values, all of one type, which are returned; a string or a mapping is not several."""
    expect_kind(what, given, Iterable, words)
    values = (given,) if isinstance(given, str | bytes | Mapping) else tuple(given)
    for value in values:
        expect_kind(what, value, kind, words)
    return values


def did_you_mean(word: str, among: Iterable[str]) -> str:
    """The end of a message about an unknown word: the most similar of those expected, if any is similar."""
    near = difflib.get_close_matches(word, list(among), n=1, cutoff=0.7)
    return f"; did you mean {near[0]}?" if near else ""


def first_line(error: BaseException, *, with_place: bool = True) -> str:
    """An error of third-party code: its type, the first line of its message, which may quote a damaged file, and where.

    The place is the last line that ran in a user's own file, such as a robot's; none for code that is installed.
    """
    first, *others = str(error).strip().split("\n")
    message = f"{type(error).__name__}: {first[:300] or 'no more is known'}"
    if others and first.endswith("Traceback (most recent call last):"):
        # JAX quotes the whole traceback of a callback's error, which is its last line.
        message = others[-1][:300]
    return "".join(filter(str.isprintable, message)) + (_place_in_own_file(error) if with_place else "")


def _place_in_own_file(error: BaseException) -> str:
    if isinstance(error, SyntaxError):
        # The message of a SyntaxError already names the place.
        return ""
    frames = traceback.walk_tb(error.__traceback__)
    places = [(Path(frame.f_code.co_filename), line) for frame, line in frames]
    own = [f" ({file.name}, line {line})" for file, line in places if file.is_absolute() and not _is_installed(file)]
    return own[-1] if own else ""


def _is_installed(file: Path) -> bool:
    """Whether no user wrote this code."""
    return str(file).startswith(_OURS_AND_PYTHONS) or not {"site-packages", "dist-packages"}.isdisjoint(file.parts)


def out_of_memory(error: BaseException) -> str | None:
    """A message if memory ran out, with the size of the failed request if it is known; None for any other error.

    JAX has its own error for this (RESOURCE_EXHAUSTED), recognised by its text so that JAX need not be imported.
    """
    if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
        return None
    request = re.search(r"llocat\w+ ([\d.]+ ?\w*)", str(error))
    return f"out of memory ({request[1]} more were requested)" if request else "out of memory"
