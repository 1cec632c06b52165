"""A stretch of time of a closed loop: what was asked of the culture in it, and what was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.closed_loop.log import Record
from animat.recordings.recording import Channels
from animat.stimulation.stimulus import Stimulus


@dataclass(frozen=True, eq=False)
class Asked:
    """What was asked of the culture; written down too where no answer comes.

    Attributes:
        stretch: number of the stretch of time in the session, from 0.
        at_s: when, on the session's clock.
        stimuli: times counted from then.
    """

    stretch: int
    at_s: float
    stimuli: tuple[Stimulus, ...]

    def to_dict(self) -> dict[str, Any]:
        """As the words of a record."""
        return {
            "stretch": self.stretch,
            "asked_at_s": self.at_s,
            "asked_for_s": [stimulus.time_s for stimulus in self.stimuli],
            "stimuli": rows_of(self.stimuli),
        }


@dataclass(frozen=True, eq=False)
class Stretch:
    """What was seen in a stretch of time, on the session's clock, its times on the culture's samples."""

    number: int
    asked_at_s: float
    start_s: float
    duration_s: float
    spike_times_s: Float64[np.ndarray, " spikes"]
    spike_channels: Int64[np.ndarray, " spikes"]
    channels: Channels
    stimulus_time_s: Float64[np.ndarray, " stimuli"]


def rows_of(stimuli: Sequence[Stimulus]) -> list[list[Any]]:
    """What was stimulated; when is in the tick."""
    return [[s.frequency_hz, s.pattern, s.presentation, list(s.electrodes)] for s in stimuli]


def seen_in(stretch: Stretch, stimuli: Sequence[Stimulus], tick: dict[str, Any] | None) -> Record:
    """What was seen, to be written down."""
    span = {"stretch": stretch.number, "start_s": stretch.start_s, "duration_s": stretch.duration_s}
    words = {"kind": "seen", **span, "stimuli": rows_of(stimuli), "tick": tick}
    return Record(words, stretch.spike_times_s, stretch.spike_channels)
