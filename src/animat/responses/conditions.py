"""Rules that sort stimuli into conditions, whose index is what an agent picks."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64

from animat.errors import InvalidArgument, expect_kind, within
from animat.responses.condition import RESTING, Condition, brief_labels
from animat.stimulation.frequency import distinct, is_same
from animat.stimulation.protocol import Protocol
from animat.stimulation.stimulus import NOTHING, Stimuli
from animat.tables import UNKNOWN

NO_CONDITION = -1
"""The index of a stimulus without a condition."""


@dataclass(frozen=True, eq=False)
class Assignment:
    """The index into `conditions` of each stimulus; `NO_CONDITION` if it has none."""

    condition: Int64[np.ndarray, " stimuli"]
    conditions: tuple[Condition, ...]


class Conditions(abc.ABC):
    """A rule that sorts stimuli into conditions; `str()` gives the text that `conditions_named` reads."""

    @abc.abstractmethod
    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort every pulse of the table into a condition, or into none."""


@dataclass(frozen=True)
class All(Conditions):
    """All stimuli in one condition, to inspect a recording as a whole."""

    def __str__(self) -> str:
        return "all"

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Put every pulse into condition 0."""
        return _with_stimuli(stimuli, np.zeros(len(stimuli), dtype=np.int64), [Condition("all", 0.0)])


@dataclass(frozen=True)
class ByFrequency(Conditions):
    """By the stimulation frequency of the protocol (the paper): those given, or all that occur, rising."""

    values_hz: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_frequencies("frequency", self.values_hz)

    def __str__(self) -> str:
        return "frequency" + _listed(self.values_hz)

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort pulses by frequency; unknown frequencies (NaN), and those not listed, have no condition."""
        values_hz = self.values_hz or distinct(stimuli.frequency_hz)
        index = np.full(len(stimuli), NO_CONDITION)
        for i, value_hz in enumerate(values_hz):
            index[is_same(stimuli.frequency_hz, value_hz)] = i
        return Assignment(index, tuple(map(_frequency, values_hz)))


@dataclass(frozen=True)
class ByInterval(Conditions):
    """By the inverse of the time since the *previous* pulse, for stimulation without fixed frequencies.

    A stimulus with the interval d before it belongs to the frequency f if |ln(d f)| <= ln(1 + tolerance), that is, if
    1/d lies between f/(1 + tolerance) and f (1 + tolerance). As a ratio, the rule is the same for intervals and
    frequencies. If two frequencies match, the nearer one in ratio wins.

    The previous interval counts, not the next, as a response can depend only on what came before it. The first pulse of
    a recording has no previous pulse, hence no condition. Pulses of the same trial count as previous ones, too.

    Attributes:
        values_hz: the frequencies, in the order of their index.
        tolerance: relative, 0.25 for 25 %.
    """

    values_hz: tuple[float, ...]
    tolerance: float = 0.25

    def __post_init__(self) -> None:
        if not self.values_hz:
            raise InvalidArgument("interval: expected at least one frequency in Hz, got none; write interval:5,10")
        _check_frequencies("interval", self.values_hz)
        if not 0 < self.tolerance < math.inf:
            raise InvalidArgument(f"interval: expected a tolerance above 0 %, got {100 * self.tolerance:g} %")

    def __str__(self) -> str:
        return f"interval{_listed(self.values_hz)}+-{100 * self.tolerance:.10g}%"

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort pulses by the nearest frequency within the tolerance; others have no condition."""
        index = np.full(len(stimuli), NO_CONDITION)
        interval_s = np.diff(stimuli.time_s)
        if len(interval_s):
            with np.errstate(divide="ignore"):
                distance = np.abs(np.log(interval_s[:, None] * np.array(self.values_hz)))
            nearest = np.argmin(distance, axis=1)
            # 1e-9: times are rounded, so chance would decide about an interval on the edge.
            within = distance.min(axis=1) <= math.log1p(self.tolerance) + 1e-9
            index[1:][within] = nearest[within]
        return Assignment(index, tuple(map(_frequency, self.values_hz)))


@dataclass(frozen=True)
class ByElectrode(Conditions):
    """By the set of electrodes that were pulsed together: those given, or all that occur, in order of size and number.

    The order within a set does not matter.
    """

    sets: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "sets", tuple(tuple(sorted(set(electrodes))) for electrodes in self.sets))
        if wrong := [electrodes for electrodes in self.sets if not electrodes or electrodes[0] < 0]:
            got = wrong[0][0] if wrong[0] else "an empty set"
            raise InvalidArgument(f"electrode: expected numbers of electrodes from 0 on, joined by +; got {got}")
        if len(set(self.sets)) < len(self.sets):
            raise InvalidArgument(f"electrode: expected each set of electrodes once, got {self}")

    def __str__(self) -> str:
        return "electrode" + (":" + ",".join("+".join(map(str, s)) for s in self.sets) if self.sets else "")

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort pulses by electrodes, and rests as `RESTING`; a pulse on unknown or other ones has no condition."""
        # Sorted rows represent sets; a repeated electrode is one electrode.
        rows, row_of = np.unique(np.sort(stimuli.electrodes, axis=1), axis=0, return_inverse=True)
        set_of_row = [tuple(sorted(set(row.tolist()) - {UNKNOWN})) for row in rows]
        resting = RESTING if np.any(stimuli.is_rest) else ()
        sets = self.sets or (*resting, *sorted({s for s in set_of_row if s}, key=lambda s: (len(s), s)))
        index_of = {electrodes: i for i, electrodes in enumerate(sets)}
        index_of_row = np.array([index_of.get(s, NO_CONDITION) for s in set_of_row], dtype=np.int64)
        index = index_of_row[row_of.reshape(-1)]
        index[stimuli.is_rest] = index_of.get(RESTING[0], NO_CONDITION)
        labels = brief_labels(sets)
        conditions = [Condition(labels[i], float(i), electrodes=(one,)) for i, one in enumerate(sets)]
        return _with_stimuli(stimuli, index, conditions)


@dataclass(frozen=True)
class ByPattern(Conditions):
    """By the number of the stimulation pattern: those given, or all that occur, rising."""

    patterns: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if any(pattern < 0 for pattern in self.patterns) or len(set(self.patterns)) < len(self.patterns):
            raise InvalidArgument(f"pattern: expected numbers from 0 on, each once, got {self}")

    def __str__(self) -> str:
        return "pattern" + (":" + ",".join(map(str, self.patterns)) if self.patterns else "")

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort pulses by pattern; unknown patterns, and those not listed, have no condition."""
        is_known = (stimuli.pattern != UNKNOWN) & ~stimuli.is_rest
        patterns = self.patterns or np.unique(stimuli.pattern[is_known]).tolist()
        index = np.full(len(stimuli), NO_CONDITION)
        for i, pattern in enumerate(patterns):
            index[stimuli.pattern == pattern] = i
        conditions = [Condition(f"pattern {pattern}", float(pattern), electrodes=()) for pattern in patterns]
        return _with_stimuli(stimuli, index, conditions)


@dataclass(frozen=True)
class ByBoth(Conditions):
    """By when and where pulses come: the combinations that occur, in the order of `when`, then of `where`."""

    when: ByFrequency | ByInterval
    where: ByElectrode | ByPattern

    def __str__(self) -> str:
        return f"{self.when} x {self.where}"

    def assign(self, stimuli: Stimuli) -> Assignment:
        """Sort pulses by combination; a pulse that lacks either has no condition."""
        when, where = self.when.assign(stimuli), self.where.assign(stimuli)
        both = np.stack([when.condition, where.condition], axis=1)
        has_both = (both != NO_CONDITION).all(axis=1)
        index = np.full(len(stimuli), NO_CONDITION)
        conditions = []
        for i, pair in enumerate(np.unique(both[has_both & stimuli.is_last_of_presentation], axis=0)):
            index[(both == pair).all(axis=1)] = i
            at, on = when.conditions[pair[0]], where.conditions[pair[1]]
            conditions.append(Condition(f"{at.label}, {on.label}", float(i), "", at.frequencies_hz, on.electrodes))
        return _with_stimuli(stimuli, index, conditions)


def default_conditions(stimuli: Stimuli, protocol: Protocol | None = None) -> Conditions:
    """By place if the protocol has places, with the frequency if it has several; else by frequency, if any is known."""
    if protocol is not None and protocol.places:
        return ByElectrode() if len(protocol.frequencies_hz) == 1 else ByBoth(ByFrequency(), ByElectrode())
    return ByFrequency() if np.any(~np.isnan(stimuli.frequency_hz)) else All()


def conditions_named(text: str) -> Conditions:
    """Read conditions, by which responses are sorted, from their text form; InvalidArgument for anything else.

    - `all`: one condition;
    - `frequency`: by the stated frequency of the stimulus; `frequency:5,10`: only 5 and 10 Hz;
    - `interval:5,10`: by the time since the pulse before, if it is 1/5 or 1/10 s within a factor of 1.25;
      `interval:5,10+-10%`: of 1.1;
    - `electrode`: by the set of stimulated electrodes; `electrode:23275,909+23923`: electrode 23275, or 909 and 23923;
    - `pattern`: by the number of the pattern; `pattern:0,3`: only 0 and 3;
    - `frequency:5,80 x pattern:0,3`: products of frequency or interval with electrode or pattern.
    """
    expect_kind("conditions", text, str, "text such as 'frequency:5,10'")
    with within("conditions"):
        match [_parse(part) for part in text.split(" x ")]:
            case [one]:
                return one
            case [ByFrequency() | ByInterval() as when, ByElectrode() | ByPattern() as where]:
                return ByBoth(when, where)
        raise _invalid(text, "frequency or interval before x, and electrode or pattern after it")


def _parse(text: str) -> Conditions:
    name, _, rest = (part.strip() for part in text.partition(":"))
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
            raise _invalid(text, "one tolerance in per cent after +-, as in interval:5,10+-25%")
        return ByInterval(_floats(text, values), percent[0] / 100)
    if name == "electrode":
        return ByElectrode(tuple(_integers(text, part, "+") for part in rest.split(",") if rest))
    if name == "pattern":
        return ByPattern(_integers(text, rest, ","))
    raise _invalid(
        text, "one of all, frequency, frequency:5,10, interval:5,10+-25%, electrode, pattern, frequency x pattern"
    )


def _with_stimuli(stimuli: Stimuli, index: Int64[np.ndarray, " stimuli"], conditions: list[Condition]) -> Assignment:
    """An assignment whose conditions also describe their stimuli, unless they already do."""
    last = np.flatnonzero(stimuli.is_last_of_presentation)
    of = index[last]
    presented = np.repeat(of, np.diff(last, prepend=-1))
    described = []
    for i, condition in enumerate(conditions):
        rows = last[of == i]
        known_hz, electrodes = condition.frequencies_hz, condition.electrodes
        if not known_hz and len(rows) and not np.any(np.isnan(stimuli.frequency_hz[rows])):
            known_hz = tuple(distinct(stimuli.frequency_hz[rows]))
        if electrodes == ():
            sets = {frozenset(row) - {UNKNOWN} for row in stimuli.electrodes[rows].tolist()}
            electrodes = () if frozenset() in sets else tuple(sorted(tuple(sorted(one)) for one in sets))
        delivered = np.unique(stimuli.electrodes[presented == i], axis=0).tolist() if electrodes else []
        ours = {frozenset(one) - {NOTHING} for one in electrodes or ()}
        only_last = any(frozenset(row) - {UNKNOWN} not in ours for row in delivered)
        described.append(replace(condition, frequencies_hz=known_hz, electrodes=electrodes, only_last=only_last))
    return Assignment(index, tuple(described))


def _frequency(value_hz: float) -> Condition:
    return Condition(f"{float(value_hz):g} Hz", float(value_hz), "Hz")


def _check_frequencies(name: str, values_hz: tuple[float, ...]) -> None:
    for value_hz in values_hz:
        if not 0 < value_hz < math.inf:
            raise InvalidArgument(f"{name}: expected positive frequencies in Hz, got {value_hz:g}")
    # Those that differ by rounding only are the same condition.
    if len(distinct(np.array(values_hz, np.float64))) < len(values_hz):
        raise InvalidArgument(f"{name}: expected each frequency once, got {_listed(values_hz)[1:]}")


def _listed(values: tuple[float, ...]) -> str:
    # The shortest text that reads back as the same number, without .0.
    return ":" + ",".join(repr(float(value)).removesuffix(".0") for value in values) if values else ""


def _floats(text: str, listed: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in listed.split(",")) if listed else ()
    except ValueError:
        raise _invalid(text, "numbers separated by commas, as in interval:5,10") from None


def _integers(text: str, listed: str, separator: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in listed.split(separator)) if listed else ()
    except ValueError:
        raise _invalid(text, f"whole numbers separated by {separator!r}") from None
    if any(abs(number) >= 2**63 for number in numbers):
        raise _invalid(text, "whole numbers of electrodes or patterns")
    return numbers


def _invalid(text: str, expected: str) -> InvalidArgument:
    return InvalidArgument(f"expected {expected}; got {text!r}")
