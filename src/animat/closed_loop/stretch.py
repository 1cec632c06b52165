"""A stretch of time of a closed loop: what was asked of the culture, whether its answer can be, what was seen in it.

A closed loop believes no backend's answer that it did not look at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.closed_loop.log import Record
from animat.closed_loop.loop import Loop
from animat.cultures.failures import describe_error
from animat.cultures.observed import Observed
from animat.recordings.recording import Channels
from animat.responses.windows import read_windows
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


def wrong_with(
    observed: Observed,
    *,
    asked_s: Float64[np.ndarray, " stimuli"],
    duration_s: float,
    since_s: float,
    from_s: float,
    sample_s: float,
    n_channels: int,
) -> str | None:
    """What is wrong with an answer, in a sentence; None for one that can be.

    Args:
        observed: the answer.
        asked_s: times of the stimuli, counted from `since_s`: none can begin before.
        duration_s: that was asked for: it is seen up to then at least.
        since_s: when it was asked for, on the culture's clock.
        from_s: the soonest time on the culture's clock that it can begin at.
        sample_s: of the culture; times may be rounded to whole ones.
        n_channels: of the culture.
    """
    try:
        times_s, channel = observed.spikes
        pulses_s, start_s, seen_s = observed.stimulus_time_s, observed.start_s, observed.duration_s
        if len(times_s) != len(channel):
            return f"the culture answered {len(times_s)} spike times for {len(channel)} channels"
        if pulses_s.shape != asked_s.shape:
            return f"the culture answered {pulses_s.shape} stimulus times for {len(asked_s)} stimuli"
        if start_s < from_s - 1.5 * sample_s:
            return f"the culture's clock went back to {start_s} s"
        if not (isfinite(start_s) and isfinite(seen_s) and start_s + seen_s >= since_s + duration_s - 1e-6):
            asked = f"{duration_s} s from {since_s} s"
            return f"the culture answered a stretch of {seen_s} s from {start_s} s where {asked} were asked"
        for name, given_s in (("spike", times_s), ("stimulus", pulses_s)):
            # Not (a <= b): a NaN fails it too.
            if len(given_s) and not (given_s[0] >= -1e-9 and given_s[-1] <= seen_s + 1e-9):
                return f"the culture answered {name} times outside of the {seen_s:g} s that were seen"
            if not bool((given_s[1:] >= given_s[:-1]).all()):
                return f"the culture answered {name} times that are no rising numbers"
        # From when the answer starts.
        asked_s = asked_s - (start_s - since_s)
        if bool((pulses_s < asked_s - 1.5 * sample_s).any()):
            early_ms = 1000 * float((asked_s - pulses_s).max())
            return f"the culture answered that a stimulus came {early_ms:.3g} ms before it was asked for"
        if channel.dtype.kind not in "iu":
            return f"the culture answered channels that are no whole numbers ({channel.dtype})"
        if len(channel) and not (channel.min() >= 0 and channel.max() < n_channels):
            return f"the culture answered channel {int(channel.max())} of {n_channels}"
    except Exception as error:
        return f"the culture answered something that cannot be read: {describe_error(error)}"
    return None


class Read(NamedTuple):
    """A response.

    Attributes:
        x_hz: what the decoder is given, one number a readout.
        told: the same as a tick tells it (`animat.closed_loop.tick.Tick`).
        is_burst: whether it was one.
    """

    x_hz: Float64[np.ndarray, "*readouts"]
    told: dict[str, Any]
    is_burst: bool


def read_response(
    loop: Loop,
    drawn_from: Float64[np.ndarray, "responses *readouts"] | None,
    stretch: Stretch,
    members: Bool[np.ndarray, "readouts channels"],
    after_s: Float64[np.ndarray, "1"],
    rng: np.random.Generator,
) -> Read:
    """The response after a pulse, or one drawn in its place."""
    rate_hz, active_ratio = read_windows(stretch, after_s, loop.window_ms)
    reads_all = loop.readouts.are_all
    x_hz = rate_hz[0] if reads_all else loop.readouts.read(stretch, members, after_s, loop.window_ms)[0]
    # Of what was seen, also where another response is drawn.
    window_s = (loop.window_ms[1] - loop.window_ms[0]) * 1e-3
    spikes = round(float(rate_hz[0]) * window_s * len(stretch.channels))
    if drawn_from is not None:
        x_hz = drawn_from[rng.integers(len(drawn_from))]
        rate_hz = np.atleast_1d(x_hz) if reads_all else rate_hz
    is_burst = bool(active_ratio[0] > loop.burst_threshold) and drawn_from is None
    told = {
        "spikes": spikes,
        "rate_hz": float(rate_hz[0]),
        "active_ratio": float(active_ratio[0]),
        "is_burst": is_burst,
        "readout_hz": () if reads_all else tuple(np.atleast_1d(x_hz).tolist()),
    }
    return Read(x_hz, told, is_burst)
