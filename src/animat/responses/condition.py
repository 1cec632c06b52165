"""One thing an agent can choose: its name, and the stimuli that it stands for."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from animat.errors import InvalidArgument, shown
from animat.stimulation.stimulus import NOTHING

_LONGEST_LABEL = 10_000
"""A condition may be a set of very many electrodes, and its label names all of them."""
_LARGEST_VALUE = 2.0**63
RESTING = ((NOTHING,),)
"""The electrodes of a condition that delivers nothing."""
_MOST_LISTED = 5
"""Electrodes of a set that its label lists: the paper's patterns have as many."""


@dataclass(frozen=True)
class Condition:
    """One thing an agent can choose to do to the culture, such as stimulating at 5 Hz.

    Conditions are equal by label, value and unit. The other attributes say what its stimuli were in the recording, so
    that a closed loop can deliver it again (`animat.coding.encoder`).

    Attributes:
        label: what figures and tables call it, with its unit: `"5 Hz"`, `"electrodes 909+23923"`.
        value: the frequency in Hz; the number of the pattern; else the position in the list; 0 for "all".
        unit: of `value`: `"Hz"`, or empty for a number that only counts.
        frequencies_hz: of its presentations, each at one of them; empty: not known. That of a condition in Hz is its
            value.
        electrodes: sets of electrodes, each pulse on one of them; empty: not known; None: any of the culture's
            patterns; `RESTING`: nothing is delivered.
        only_last: of a presentation only the last pulse is on these electrodes, and those before are on any pattern.

    Raises:
        InvalidArgument: for a label that is no line of text, a value that is no finite number, frequencies that are
            not positive, or electrodes that are no sets of numbers from 0 on.
    """

    label: str
    value: float
    unit: str = ""
    frequencies_hz: tuple[float, ...] = field(default=(), compare=False)
    electrodes: tuple[tuple[int, ...], ...] | None = field(default=None, compare=False)
    only_last: bool = field(default=False, compare=False)

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
        if self.unit == "Hz":
            object.__setattr__(self, "frequencies_hz", (float(value),))
        self._expect_stimulus()

    @property
    def interval_s(self) -> float:
        """Mean time between its pulses; NaN where it is not known."""
        periods_s = [1 / frequency_hz for frequency_hz in self.frequencies_hz]
        return sum(periods_s) / len(periods_s) if periods_s else math.nan

    def _expect_stimulus(self) -> None:
        """Take lists, as JSON has them, and refuse what no stimulus can be."""
        try:
            frequencies_hz = tuple(float(each) for each in self.frequencies_hz)
            electrodes = self.electrodes
            if electrodes is not None:
                electrodes = tuple(tuple(operator.index(each) for each in one) for one in electrodes)
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidArgument(
                f"condition {self.label}: expected frequencies and sets of electrodes, got "
                f"{shown((self.frequencies_hz, self.electrodes))}"
            ) from error
        if self.unit != "Hz" and not all(0 < each <= _LARGEST_VALUE for each in frequencies_hz):
            raise InvalidArgument(f"condition {self.label}: expected positive frequencies, got {shown(frequencies_hz)}")
        if electrodes != RESTING and not all(
            one and all(0 <= e < _LARGEST_VALUE for e in one) for one in electrodes or ()
        ):
            raise InvalidArgument(f"condition {self.label}: expected numbers of electrodes, got {shown(electrodes)}")
        if not isinstance(self.only_last, bool):
            raise InvalidArgument(f"condition.only_last: expected true or false, got {shown(self.only_last)}")
        object.__setattr__(self, "frequencies_hz", frequencies_hz)
        object.__setattr__(self, "electrodes", electrodes)


def listed(electrodes: Sequence[int]) -> str:
    """A set of electrodes in words: `"electrodes 909+23923"`; `"no electrode"` where nothing is delivered."""
    if (tuple(electrodes),) == RESTING:
        return "no electrode"
    return f"electrode{'s' if len(electrodes) > 1 else ''} {'+'.join(map(str, electrodes))}"


def abbreviated(conditions: Sequence[Condition]) -> tuple[Condition, ...]:
    """Conditions whose labels count the electrodes of large sets (`"16 electrodes from 909"`) in place of listing them.

    Where that would call two sets the same, all are listed. Files of before list them.
    """
    sets = {one.electrodes[0] for one in conditions if one.electrodes is not None and len(one.electrodes) == 1}
    large = [electrodes for electrodes in sets if len(electrodes) > _MOST_LISTED]
    brief = {electrodes: f"{len(electrodes)} electrodes from {electrodes[0]}" for electrodes in large}
    if len(set(brief.values())) < len(brief):
        return tuple(conditions)
    return tuple(
        replace(one, label=one.label.replace(listed(one.electrodes[0]), brief[one.electrodes[0]]))
        if one.electrodes and one.electrodes[0] in brief
        else one
        for one in conditions
    )


def other_stimulus(conditions: Sequence[Condition], others: Sequence[Condition]) -> str | None:
    """In words, the first of equal conditions whose stimuli are others, where both are known; None if none is.

    Args:
        conditions: that are expected.
        others: equal ones, in the same order, of other recordings.
    """
    for expected, got in zip(conditions, others, strict=True):
        if not (expected.electrodes and got.electrodes and expected.frequencies_hz and got.frequencies_hz):
            continue
        # Of a pattern at several frequencies a recording may have met some only, and a file rounds.
        in_common = np.isclose(np.array(expected.frequencies_hz)[:, None], np.array(got.frequencies_hz), rtol=1e-6)
        if (expected.electrodes, expected.only_last) != (got.electrodes, got.only_last) or not in_common.any():
            return f"expected {_told(expected)}, got {_told(got)}"
    return None


def _told(condition: Condition) -> str:
    sets = " or ".join("+".join(map(str, one)) for one in condition.electrodes or ())
    last = ", its last pulse alone," if condition.only_last else ""
    frequencies = ", ".join(f"{each:g}" for each in condition.frequencies_hz)
    return f"{condition.label}{last} at {frequencies} Hz on the electrodes {sets}"
