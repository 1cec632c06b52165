"""A condition: one thing that an agent can choose, with its name and its stimuli."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from animat.errors import InvalidArgument, shown
from animat.records import Flag, Number, Whole, record
from animat.stimulation.frequency import is_same
from animat.stimulation.stimulus import NOTHING

_LARGEST_VALUE = 2.0**63
RESTING = ((NOTHING,),)
"""The electrodes of a condition that delivers nothing."""
Line = Annotated[str, Field(strict=True, max_length=10_000)]
"""A condition may be a very large set of electrodes, all named in its label."""
_MOST_LISTED = 5
"""The most electrodes of a set that a label lists: as many as the paper's patterns have."""


@record
class Condition:
    """One thing an agent can choose to do to the culture, such as stimulating at 5 Hz.

    Conditions are equal by label, value and unit. The other attributes describe its stimuli in the recording, so that a
    closed loop can deliver it again (`animat.coding.encoder`).

    Attributes:
        label: its name in figures and tables, with its unit: `"5 Hz"`, `"electrodes 909+23923"`.
        value: the frequency in Hz; the number of the pattern; else the position in the list; 0 for "all".
        unit: of `value`: `"Hz"`, or empty if the value is only a number.
        frequencies_hz: each trial is at one of them; empty: not known. For a condition in Hz this is its value.
        electrodes: sets, each pulse on one of them; empty: not known; None: any of the patterns; `RESTING`: no pulse.
        only_last: only the last pulse of a trial is on these electrodes, and those before are on any pattern.

    Raises:
        InvalidArgument: for a label that is not a line of text, a value that is not a finite number, frequencies that
            are not positive, or electrodes that are not sets of numbers from 0 on.
    """

    label: Annotated[Line, Field(min_length=1)]
    value: Annotated[Number, Field(ge=-_LARGEST_VALUE, le=_LARGEST_VALUE)]
    unit: Line = ""
    frequencies_hz: tuple[Annotated[Number, Field(le=_LARGEST_VALUE)], ...] = field(default=(), compare=False)
    electrodes: tuple[tuple[Whole, ...], ...] | None = field(default=None, compare=False)
    only_last: Flag = field(default=False, compare=False)

    def __post_init__(self) -> None:
        for name, text in (("label", self.label), ("unit", self.unit)):
            if not text.isprintable():
                raise InvalidArgument(f"{name}: expected a line of text, got {shown(text)}")
        if self.unit == "Hz":
            object.__setattr__(self, "frequencies_hz", (self.value,))
        elif not all(frequency_hz > 0 for frequency_hz in self.frequencies_hz):
            raise InvalidArgument(f"frequencies_hz: expected numbers above 0, got {shown(self.frequencies_hz)}")
        sets = () if self.electrodes == RESTING else self.electrodes or ()
        if not all(one and all(0 <= electrode < _LARGEST_VALUE for electrode in one) for one in sets):
            raise InvalidArgument(f"electrodes: expected sets of one or more electrode numbers, got {shown(sets)}")

    @property
    def interval_s(self) -> float:
        """Mean time between its pulses; NaN if it is not known."""
        periods_s = [1 / frequency_hz for frequency_hz in self.frequencies_hz]
        return sum(periods_s) / len(periods_s) if periods_s else math.nan


def electrodes_label(electrodes: Sequence[int]) -> str:
    """The label of a set of electrodes: `"electrodes 909+23923"`; `"no electrode"` if nothing is delivered."""
    if (tuple(electrodes),) == RESTING:
        return "no electrode"
    return f"electrode{'s' if len(electrodes) > 1 else ''} {'+'.join(map(str, electrodes))}"


def brief_labels(sets: Collection[Sequence[int]]) -> list[str]:
    """The labels of several sets; large ones are counted (`"16 electrodes from 909"`) instead of listed.

    If that would give two sets the same label, all are listed.
    """
    counted = {tuple(one): f"{len(one)} electrodes from {one[0]}" for one in sets if len(one) > _MOST_LISTED}
    if len(set(counted.values())) < len(counted):
        counted = {}
    return [counted.get(tuple(one)) or electrodes_label(one) for one in sets]


def abbreviated(conditions: Sequence[Condition]) -> tuple[Condition, ...]:
    """Conditions with the `brief_labels` of their sets of electrodes. Older files list them."""
    sets = {one.electrodes[0] for one in conditions if one.electrodes is not None and len(one.electrodes) == 1}
    brief = dict(zip(sets, brief_labels(sets), strict=True))
    return tuple(
        replace(one, label=one.label.replace(electrodes_label(one.electrodes[0]), brief[one.electrodes[0]]))
        if one.electrodes and one.electrodes[0] in brief
        else one
        for one in conditions
    )


def stimulus_mismatch(conditions: Sequence[Condition], others: Sequence[Condition]) -> str | None:
    """A message on the first of equal conditions (the expected ones, and others) whose stimuli differ, where known."""
    for expected, got in zip(conditions, others, strict=True):
        if not (expected.electrodes and got.electrodes and expected.frequencies_hz and got.frequencies_hz):
            continue
        # A recording may hold a pattern at only some of several frequencies, and a file rounds them.
        in_common = is_same(np.array(expected.frequencies_hz)[:, None], np.array(got.frequencies_hz))
        if (expected.electrodes, expected.only_last) != (got.electrodes, got.only_last) or not in_common.any():
            return f"expected {_describe(expected)}, got {_describe(got)}"
    return None


def _describe(condition: Condition) -> str:
    sets = " or ".join("+".join(map(str, one)) for one in condition.electrodes or ())
    last = ", its last pulse alone," if condition.only_last else ""
    frequencies = ", ".join(f"{each:g}" for each in condition.frequencies_hz)
    return f"{condition.label}{last} at {frequencies} Hz on the electrodes {sets}"
