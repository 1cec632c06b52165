"""What a stimulus is an instance of: the index that an agent picks, and how stimuli are sorted into it."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64

from animat.errors import InvalidArgument, shown
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN

NO_CONDITION = -1
"""The index of a stimulus that belongs to no condition."""
_LONGEST_LABEL = 10_000
"""A condition may be a set of very many electrodes, and its label names all of them."""
_LARGEST_VALUE = 2.0**63


@dataclass(frozen=True)
class Condition:
    """One thing an agent can choose to do to the culture, such as stimulating at 5 Hz.

    Attributes:
        label: what figures and tables call it, with its unit: `"5 Hz"`, `"electrodes 909+23923"`.
        value: the frequency in Hz; the number of the pattern; the position in the list for electrodes; 0 for "all".
        unit: of `value`: `"Hz"`, or empty for a number that only counts.

    Raises:
        InvalidArgument: for a label that is no line of text, or a value that is no finite number.
    """

    label: str
    value: float
    unit: str = ""

    def __post_init__(self) -> None:
        told: Any
        for name, told in (("label", self.label), ("unit", self.unit)):
            if not isinstance(told, str) or not told.isprintable() or len(told) > _LONGEST_LABEL:
                raise InvalidArgument(f"condition.{name}: expected a line of text, got {shown(told)}")
        if not self.label:
            raise InvalidArgument("condition.label: expected some text, got none")
        value: Any = self.value
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= _LARGEST_VALUE:
            raise InvalidArgument(f"condition.value: expected a finite number, got {shown(value)}")


@dataclass(frozen=True, eq=False)
class Assignment:
    """Which condition each stimulus belongs to.

    Attributes:
        condition: index into `conditions` of each stimulus, `NO_CONDITION` where it has none, shape (stimuli,).
        conditions: the conditions, in the order of their index.
    """

    condition: Int64[np.ndarray, " stimuli"]
    conditions: tuple[Condition, ...]


class Conditions(abc.ABC):
    """A rule that sorts stimuli into conditions; `str()` gives the text that `conditions_named` reads."""

    @abc.abstractmethod
    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort every pulse of the table into a condition, or into none."""


@dataclass(frozen=True)
class All(Conditions):
    """Every stimulus in one condition: to look at a recording as a whole."""

    def __str__(self) -> str:
        return "all"

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put every pulse into condition 0."""
        return Assignment(np.zeros(len(stimuli), dtype=np.int64), (Condition("all", 0.0),))


@dataclass(frozen=True)
class ByFrequency(Conditions):
    """By the frequency that the protocol presented (the paper).

    Attributes:
        values_hz: the frequencies to take, in the order of their index; empty for all that occur, rising.

    Raises:
        InvalidArgument: for a frequency that is not positive, or is given twice.
    """

    values_hz: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_frequencies("frequency", self.values_hz)

    def __str__(self) -> str:
        return "frequency" + _listed(self.values_hz)

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put each pulse to its frequency; unknown frequencies (NaN), and ones not asked for, have no condition."""
        known = stimuli.frequency_hz[~np.isnan(stimuli.frequency_hz)]
        values_hz = np.array(self.values_hz) if self.values_hz else np.unique(known)
        index = np.full(len(stimuli), NO_CONDITION)
        for i, value_hz in enumerate(values_hz):
            # 1e-6: a frequency that went through single precision in a file is still the same frequency.
            index[np.isclose(stimuli.frequency_hz, value_hz, rtol=1e-6, atol=0.0)] = i
        return Assignment(index, tuple(_frequency(value_hz) for value_hz in values_hz))


@dataclass(frozen=True)
class ByInterval(Conditions):
    """By the inverse of the time since the *previous* pulse: for stimulation that follows no fixed frequency.

    A stimulus with the interval d before it belongs to the frequency f if |ln(d f)| <= ln(1 + tolerance), that is, if
    1/d lies between f/(1 + tolerance) and f (1 + tolerance). The ratio makes it the same rule for intervals as for
    frequencies. Where two reach, the nearer one in ratio has it.

    The previous interval, not the next: a response can depend only on what came before it. The first pulse of a
    recording has no previous one, hence no condition. All pulses count as previous ones, also those of the same
    presentation.

    Attributes:
        values_hz: the frequencies, in the order of their index.
        tolerance: relative, 0.25 for 25 %.

    Raises:
        InvalidArgument: for no frequency, one that is not positive or given twice, or a tolerance that is not positive.
    """

    values_hz: tuple[float, ...]
    tolerance: float = 0.25

    def __post_init__(self) -> None:
        if not self.values_hz:
            raise InvalidArgument("interval: expected at least one frequency in Hz, got none; write interval:5,10")
        _check_frequencies("interval", self.values_hz)
        if not (math.isfinite(self.tolerance) and self.tolerance > 0):
            raise InvalidArgument(f"interval: expected a tolerance above 0 %, got {100 * self.tolerance:g} %")

    def __str__(self) -> str:
        return f"interval{_listed(self.values_hz)}+-{100 * self.tolerance:.10g}%"

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put each pulse to the nearest frequency within the tolerance; others have no condition."""
        index = np.full(len(stimuli), NO_CONDITION)
        interval_s = np.diff(stimuli.time_s)
        if len(interval_s):
            with np.errstate(divide="ignore"):
                distance = np.abs(np.log(interval_s[:, None] * np.array(self.values_hz)))
            nearest = np.argmin(distance, axis=1)
            # 1e-9: times are rounded, so an interval on the edge would be in or out by chance.
            within = distance.min(axis=1) <= math.log1p(self.tolerance) + 1e-9
            index[1:][within] = nearest[within]
        return Assignment(index, tuple(_frequency(value_hz) for value_hz in self.values_hz))


@dataclass(frozen=True)
class ByElectrode(Conditions):
    """By the set of electrodes that were pulsed together; the order within a set does not matter.

    Attributes:
        sets: the sets to take, in the order of their index; empty for all that occur, in the order of their numbers.

    Raises:
        InvalidArgument: for a set that is empty or given twice.
    """

    sets: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "sets", tuple(tuple(sorted(set(electrodes))) for electrodes in self.sets))
        if any(not electrodes or electrodes[0] < 0 for electrodes in self.sets):
            raise InvalidArgument("electrode: expected numbers of electrodes from 0 on, joined by +; got an empty set")
        if len(set(self.sets)) < len(self.sets):
            raise InvalidArgument(f"electrode: expected each set of electrodes once, got {self}")

    def __str__(self) -> str:
        return "electrode" + (":" + ",".join("+".join(map(str, s)) for s in self.sets) if self.sets else "")

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put each pulse to its set of electrodes; a pulse on no known electrode has no condition."""
        # Sorted rows make a set out of a list; a repeated electrode is one electrode.
        rows, row_of = np.unique(np.sort(stimuli.electrodes, axis=1), axis=0, return_inverse=True)
        set_of_row = [tuple(sorted(set(row.tolist()) - {UNKNOWN})) for row in rows]
        sets = self.sets or tuple(sorted({s for s in set_of_row if s}, key=lambda s: (len(s), s)))
        index_of = {electrodes: i for i, electrodes in enumerate(sets)}
        index_of_row = np.array([index_of.get(s, NO_CONDITION) for s in set_of_row], dtype=np.int64)
        labels = (f"electrode{'s' if len(s) > 1 else ''} {'+'.join(map(str, s))}" for s in sets)
        return Assignment(
            index_of_row[row_of.reshape(-1)], tuple(Condition(label, float(i)) for i, label in enumerate(labels))
        )


@dataclass(frozen=True)
class ByPattern(Conditions):
    """By the number of the stimulation pattern.

    Attributes:
        patterns: the patterns to take, in the order of their index; empty for all that occur, rising.

    Raises:
        InvalidArgument: for a pattern that is negative or given twice.
    """

    patterns: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if any(pattern < 0 for pattern in self.patterns) or len(set(self.patterns)) < len(self.patterns):
            raise InvalidArgument(f"pattern: expected numbers from 0 on, each once, got {self}")

    def __str__(self) -> str:
        return "pattern" + (":" + ",".join(map(str, self.patterns)) if self.patterns else "")

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put each pulse to its pattern; unknown patterns, and ones not asked for, have no condition."""
        patterns = np.array(self.patterns or np.unique(stimuli.pattern[stimuli.pattern != UNKNOWN]), dtype=np.int64)
        index = np.full(len(stimuli), NO_CONDITION)
        for i, pattern in enumerate(patterns):
            index[stimuli.pattern == pattern] = i
        return Assignment(index, tuple(Condition(f"pattern {pattern}", float(pattern)) for pattern in patterns))


def default_conditions(stimuli: Stimuli) -> Conditions:
    """The conditions of a recording for which none were asked: by frequency where it is known, else all in one."""
    return ByFrequency() if np.any(~np.isnan(stimuli.frequency_hz)) else All()


def conditions_named(text: str) -> Conditions:
    """Read conditions from their text form.

    `all`, `frequency`, `frequency:5,10`, `interval:5,10`, `interval:5,10+-25%`, `electrode`,
    `electrode:23275,909+23923`, `pattern`, `pattern:0,3`.

    Raises:
        InvalidArgument: for anything else, saying what was expected.
    """
    name, _, rest = text.strip().partition(":")
    name, rest = name.strip(), rest.strip()
    if name == "all" and not rest:
        return All()
    if name == "frequency":
        return ByFrequency(_floats(text, rest))
    if name == "interval":
        values, sign, tolerance = rest.replace("±", "+-").partition("+-")
        if not sign:
            return ByInterval(_floats(text, values))
        percent = _floats(text, tolerance.strip().removesuffix("%"))
        if len(percent) != 1 or not tolerance.strip().endswith("%"):
            raise _unread(text, "one tolerance in per cent after +-, as in interval:5,10+-25%")
        return ByInterval(_floats(text, values), percent[0] / 100)
    if name == "electrode":
        return ByElectrode(tuple(_integers(text, part, "+") for part in rest.split(",") if rest))
    if name == "pattern":
        return ByPattern(_integers(text, rest, ","))
    raise _unread(text, "one of all, frequency, frequency:5,10, interval:5,10+-25%, electrode, pattern")


def _frequency(value_hz: float) -> Condition:
    return Condition(f"{float(value_hz):g} Hz", float(value_hz), "Hz")


def _check_frequencies(name: str, values_hz: tuple[float, ...]) -> None:
    for value_hz in values_hz:
        if not (math.isfinite(value_hz) and value_hz > 0):
            raise InvalidArgument(f"{name}: expected positive frequencies in Hz, got {value_hz:g}")
    if len(set(values_hz)) < len(values_hz):
        raise InvalidArgument(f"{name}: expected each frequency once, got {_listed(values_hz)[1:]}")


def _number(value: float) -> str:
    """The shortest text that reads back as the same number, without a needless .0."""
    return repr(float(value)).removesuffix(".0")


def _listed(values: tuple[float, ...]) -> str:
    return ":" + ",".join(map(_number, values)) if values else ""


def _floats(text: str, listed: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in listed.split(",")) if listed else ()
    except ValueError:
        raise _unread(text, "numbers with commas between them, as in interval:5,10") from None


def _integers(text: str, listed: str, separator: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in listed.split(separator)) if listed else ()
    except ValueError:
        raise _unread(text, f"whole numbers with {separator!r} between them") from None
    if any(abs(number) >= 2**63 for number in numbers):
        raise _unread(text, "whole numbers of an electrode or a pattern")
    return numbers


def _unread(text: str, expected: str) -> InvalidArgument:
    return InvalidArgument(f"conditions: expected {expected}; got {text!r}")
