"""One thing an agent can choose: its name, and the stimuli that it stands for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from animat.errors import InvalidArgument, shown
from animat.records import Flag, Number, Whole, record
from animat.stimulation.stimulus import NOTHING

_LONGEST_LABEL = 10_000
"""A condition may be a set of very many electrodes, and its label names all of them."""
_LARGEST_VALUE = 2.0**63
RESTING = ((NOTHING,),)
"""The electrodes of a condition that delivers nothing."""
_MOST_LISTED = 5
"""Electrodes of a set that its label lists: the paper's patterns have as many."""


@record
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

    label: Annotated[str, Field(strict=True, min_length=1, max_length=_LONGEST_LABEL)]
    value: Annotated[Number, Field(ge=-_LARGEST_VALUE, le=_LARGEST_VALUE)]
    unit: Annotated[str, Field(strict=True, max_length=_LONGEST_LABEL)] = ""
    frequencies_hz: tuple[Annotated[Number, Field(le=_LARGEST_VALUE)], ...] = field(default=(), compare=False)
    electrodes: tuple[tuple[Whole, ...], ...] | None = field(default=None, compare=False)
    only_last: Flag = field(default=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("label", "unit"):
            if not (text := getattr(self, name)).isprintable():
                raise InvalidArgument(f"{name}: expected a line of text, got {shown(text)}")
        if self.unit == "Hz":
            object.__setattr__(self, "frequencies_hz", (self.value,))
        elif not all(frequency_hz > 0 for frequency_hz in self.frequencies_hz):
            raise InvalidArgument(f"frequencies_hz: expected more than 0, got {shown(self.frequencies_hz)}")
        if self.electrodes != RESTING and not all(
            one and all(0 <= e < _LARGEST_VALUE for e in one) for one in self.electrodes or ()
        ):
            raise InvalidArgument(
                f"electrodes: expected the numbers of one or more in each set, got {shown(self.electrodes)}"
            )

    @property
    def interval_s(self) -> float:
        """Mean time between its pulses; NaN where it is not known."""
        periods_s = [1 / frequency_hz for frequency_hz in self.frequencies_hz]
        return sum(periods_s) / len(periods_s) if periods_s else math.nan


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


def stimulus_mismatch(conditions: Sequence[Condition], others: Sequence[Condition]) -> str | None:
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
