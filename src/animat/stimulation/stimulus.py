"""A stimulus, which is one pulse on some electrodes at a time, and the table of a recording's stimuli."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, UnusableData
from animat.stimulation.plain import number, seconds, whole_number
from animat.stimulation.pulse import Pulse
from animat.tables import FASTEST_HZ, UNKNOWN, briefly, expect_rising_times, freeze, reduce_dataclass

_ONLY_INT = frozenset({int})
NOTHING = -2
"""The pattern of a stimulus without electrodes, at the place `animat.stimulation.places.NONE`."""


@dataclass(frozen=True)
class Stimulus:
    """One pulse on one or several electrodes at once.

    Arguments are copied as Python's own numbers: electrodes may be a list or an array of whole numbers.

    Attributes:
        time_s: its start, relative to the start of its delivery; float64 or a whole number.
        pulse: what each electrode delivers.
        frequency_hz: the frequency at which it is presented, NaN if it has none.
        pattern: index of the pattern that the electrodes form, -1 if they form none; `NOTHING` if nothing is delivered.
        presentation: number of its trial.

    Raises:
        InvalidArgument: for values of another type, including a time in float32, or electrodes where nothing is
            delivered.
    """

    time_s: float
    electrodes: tuple[int, ...]
    pulse: Pulse
    frequency_hz: float = math.nan
    pattern: int = -1
    presentation: int = 0

    def __post_init__(self) -> None:
        # A closed loop makes five per action: values that are already plain are left as they are.
        if type(self.time_s) is not float:
            object.__setattr__(self, "time_s", seconds("time_s", self.time_s))
        if type(self.electrodes) is not tuple or not _ONLY_INT.issuperset(map(type, self.electrodes)):
            object.__setattr__(self, "electrodes", _plain_electrodes(self.electrodes))
        if type(self.pulse) is not Pulse:
            if not isinstance(self.pulse, Pulse):
                raise InvalidArgument(f"pulse: expected a Pulse, got {type(self.pulse).__name__}")
            object.__setattr__(self, "pulse", Pulse(self.pulse.phases))
        if type(self.frequency_hz) is not float:
            object.__setattr__(self, "frequency_hz", number("frequency_hz", self.frequency_hz))
        for name in ("pattern", "presentation"):
            if type(value := getattr(self, name)) is not int:
                object.__setattr__(self, name, whole_number(name, value))
        if self.pattern == NOTHING and self.electrodes:
            raise InvalidArgument(f"electrodes: expected none where nothing is delivered, got {self.electrodes}")

    @property
    def is_rest(self) -> bool:
        """Whether nothing is delivered; a stimulus without electrodes by mistake is not a rest, and is refused."""
        return self.pattern == NOTHING


def plain_stimuli(stimuli: Iterable[Stimulus]) -> tuple[Stimulus, ...]:
    """A tuple of stimuli that cannot change, as those of a subclass are copied; InvalidArgument for anything else."""
    if not isinstance(stimuli, Iterable):
        raise InvalidArgument(f"stimuli: expected several Stimulus, got {type(stimuli).__name__}")
    return tuple([stimulus if type(stimulus) is Stimulus else _plain_stimulus(stimulus) for stimulus in stimuli])


def _plain_electrodes(electrodes: Any) -> tuple[int, ...]:
    try:
        listed = tuple(electrodes)
    except TypeError as error:
        raise InvalidArgument(f"electrodes: expected several, got {type(electrodes).__name__}") from error
    return tuple(whole_number("electrodes", electrode) for electrode in listed)


def _plain_stimulus(stimulus: Any) -> Stimulus:
    if not isinstance(stimulus, Stimulus):
        raise InvalidArgument(f"stimuli: expected Stimulus, got {type(stimulus).__name__}")
    return Stimulus(**{field.name: getattr(stimulus, field.name) for field in fields(Stimulus)})


@checked_arguments
@dataclass(frozen=True, eq=False)
class Stimuli:
    """The table of stimulation pulses, one row per pulse, in order of time.

    Attributes:
        time_s: start of each pulse on the recording's clock, shape (stimuli,).
        frequency_hz: the frequency at which it was presented, NaN if not known, shape (stimuli,).
        pattern: index of the pattern, `UNKNOWN`, or `NOTHING` where nothing was delivered, shape (stimuli,).
        electrodes: electrodes pulsed together, padded with `UNKNOWN`, shape (stimuli, electrodes).
        presentation: number of its trial, after whose last pulse a response is read, shape (stimuli,).
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    time_s: Float64[np.ndarray, " stimuli"]
    frequency_hz: Float64[np.ndarray, " stimuli"]
    pattern: Int64[np.ndarray, " stimuli"]
    electrodes: Int64[np.ndarray, "stimuli electrodes"]
    presentation: Int64[np.ndarray, " stimuli"]

    def __post_init__(self) -> None:
        kinds = {"time_s": np.float64, "frequency_hz": np.float64, "pattern": np.int64, "presentation": np.int64}
        freeze(self, "the stimulus table", **kinds, electrodes=np.int64)
        if self.electrodes.ndim != 2:
            expected = "stimuli.electrodes: expected shape (stimuli, electrodes), padded with -1"
            raise UnusableData(f"{expected}, got {self.electrodes.shape}")
        expect_rising_times("stimuli.time_s", self.time_s)
        known = self.frequency_hz[~np.isnan(self.frequency_hz)]
        wrong = (known <= 0) | (known > FASTEST_HZ)
        if np.any(wrong):
            expected = f"expected positive frequencies up to {FASTEST_HZ:g} Hz, or NaN"
            raise UnusableData(f"stimuli.frequency_hz: {expected}, got {known[wrong][0]:g}")
        if np.any(np.diff(self.presentation) < 0):
            raise UnusableData("stimuli.presentation: expected numbers that never fall over time")

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def is_last_of_presentation(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether a pulse is the last one of its trial, the one whose response is read; shape (stimuli,)."""
        return is_last_of(self.presentation)

    @property
    def is_rest(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether nothing was delivered, shape (stimuli,)."""
        return (self.pattern == NOTHING) & np.all(self.electrodes == UNKNOWN, axis=1)  # type: ignore[no-any-return]


def is_last_of(presentation: Int64[np.ndarray, " stimuli"]) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Whether each pulse is the last one of its trial, by the trials' numbers; shape (stimuli,)."""
    return np.append(presentation[1:] != presentation[:-1], True)[: len(presentation)]
