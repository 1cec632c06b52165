"""A stretch of time of a closed loop: the request, the check of its answer, the response, or an early ending."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.closed_loop.log import LogRecord
from animat.closed_loop.loop import Loop
from animat.closed_loop.tick import Ending
from animat.cultures.base import Culture
from animat.cultures.failures import describe_error
from animat.cultures.observed import Observed
from animat.errors import UnsafeStimulus
from animat.recordings.recording import Channels
from animat.responses.windows import read_windows
from animat.stimulation.stimulus import Stimulus

Times = Float64[np.ndarray, " stimuli"]
Drawn = Float64[np.ndarray, "responses *readouts"]
Members = Bool[np.ndarray, "readouts channels"]
_MOST_CUT_S = 0.001
"""By how much a response window may be cut: a device may report a pulse a few samples after it was due."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """What was observed in a stretch of time, numbered from 0; times are on the session's clock, rounded to samples."""

    number: int
    start_s: float
    duration_s: float
    spike_times_s: Float64[np.ndarray, " spikes"]
    spike_channels: Int64[np.ndarray, " spikes"]
    channels: Channels
    stimulus_time_s: Times


def request_fields(number: int, at_s: float, stimuli: Sequence[Stimulus]) -> dict[str, Any]:
    """The fields of a request for a stretch of time, logged even if no answer comes; its times count from `at_s`."""
    times_s = [stimulus.time_s for stimulus in stimuli]
    return {"stretch": number, "asked_at_s": at_s, "asked_for_s": times_s, "stimuli": _rows_of(stimuli)}


def _rows_of(stimuli: Sequence[Stimulus]) -> list[list[Any]]:
    """Stimuli as rows of plain data; their times are in the tick."""
    return [[s.frequency_hz, s.pattern, s.presentation, list(s.electrodes)] for s in stimuli]


def stretch_record(stretch: Stretch, stimuli: Sequence[Stimulus], tick: dict[str, Any] | None) -> LogRecord:
    """The log record of a stretch of time."""
    span = {"stretch": stretch.number, "start_s": stretch.start_s, "duration_s": stretch.duration_s}
    fields = {"kind": "seen", **span, "stimuli": _rows_of(stimuli), "tick": tick}
    return LogRecord(fields, stretch.spike_times_s, stretch.spike_channels)


def check_answer(
    observed: Observed,
    *,
    requested_s: Times,
    duration_s: float,
    since_s: float,
    from_s: float,
    sample_s: float,
    n_channels: int,
) -> str | None:
    """What is wrong with an answer of the culture, in a sentence; None for a possible one.

    It was requested at `since_s` on the culture's clock, and may start at `from_s` at the earliest. Stimuli begin at
    the times requested or later, but for rounding to samples, and the answer covers at least the duration.
    """
    try:
        times_s, channel = observed.spikes
        pulses_s, start_s, seen_s = observed.stimulus_time_s, observed.start_s, observed.duration_s
        if len(times_s) != len(channel):
            return f"the culture returned {len(times_s)} spike times for {len(channel)} channels"
        if pulses_s.shape != requested_s.shape:
            return f"the culture returned {pulses_s.shape} stimulus times for {len(requested_s)} stimuli"
        if start_s < from_s - 1.5 * sample_s:
            return f"the culture's clock went back to {start_s} s"
        if not (isfinite(start_s) and isfinite(seen_s) and start_s + seen_s >= since_s + duration_s - 1e-6):
            requested = f"{duration_s} s from {since_s} s"
            return f"the culture returned {seen_s} s from {start_s} s where {requested} were requested"
        for name, returned_s in (("spike", times_s), ("stimulus", pulses_s)):
            # Not (a <= b): a NaN fails it too.
            if len(returned_s) and not (returned_s[0] >= -1e-9 and returned_s[-1] <= seen_s + 1e-9):
                return f"the culture returned {name} times outside of the {seen_s:g} s that it observed"
            if not bool((returned_s[1:] >= returned_s[:-1]).all()):
                return f"the culture returned {name} times that do not rise"
        # Counted from the start of the answer.
        late_s = pulses_s - (requested_s - (start_s - since_s))
        if bool((late_s < -1.5 * sample_s).any()):
            return f"the culture returned a stimulus {-1000 * late_s.min():.3g} ms before its requested time"
        if len(late_s) and seen_s < since_s + duration_s - start_s + late_s[-1] - _MOST_CUT_S:
            return f"the culture delivered a stimulus {1000 * late_s[-1]:.3g} ms late, but observed no longer after it"
        if channel.dtype.kind not in "iu":
            return f"the culture returned channels that are not whole numbers ({channel.dtype})"
        if len(channel) and not (channel.min() >= 0 and channel.max() < n_channels):
            return f"the culture returned channel {int(channel.max())} of {n_channels}"
    except Exception as error:
        return f"the culture returned something that cannot be read: {describe_error(error)}"
    return None


def ending_of(error: Exception, culture: Culture, is_stopped: bool) -> Ending:
    """The ending for an error of the culture; `is_stopped`: whether a person had stopped it before."""
    if is_stopped:
        return Ending("person", "stopped by a person")
    if isinstance(error, UnsafeStimulus) and error.limit in ("stimuli_per_session", "net_charge_per_session"):
        return Ending("budget", str(error))
    if isinstance(error, UnsafeStimulus) and culture.is_stopped:
        return Ending("culture", f"the culture was stopped: {error}")
    lost = "the connection to the culture is lost: " if _is_lost(error) else "the culture raised "
    return Ending("culture", lost + describe_error(error))


def _is_lost(error: BaseException | None) -> bool:
    """Whether an error comes from a lost connection; a timeout does not, as the device is still there."""
    if error is None:
        return False
    return (isinstance(error, OSError) and not isinstance(error, TimeoutError)) or _is_lost(error.__cause__)


def read_response(
    loop: Loop, drawn_from: Drawn | None, stretch: Stretch, members: Members, after_s: Times, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "*readouts"], dict[str, Any]]:
    """The response after a pulse, or one drawn in its place: x of each readout, Hz, and the fields of its tick."""
    rate_hz, active_ratio = read_windows(stretch, after_s, loop.window_ms)
    reads_all = loop.readouts.are_all
    x_hz = rate_hz[0] if reads_all else loop.readouts.read(stretch, members, after_s, loop.window_ms)[0]
    # The culture's own spikes, even if another response is drawn.
    window_s = (loop.window_ms[1] - loop.window_ms[0]) * 1e-3
    spikes = round(float(rate_hz[0]) * window_s * len(stretch.channels))
    if drawn_from is not None:
        x_hz = drawn_from[rng.integers(len(drawn_from))]
        rate_hz = np.atleast_1d(x_hz) if reads_all else rate_hz
    return x_hz, {
        "spikes": spikes,
        "rate_hz": float(rate_hz[0]),
        "active_ratio": float(active_ratio[0]),
        "is_burst": bool(active_ratio[0] > loop.burst_threshold) and drawn_from is None,
        "readout_hz": () if reads_all else tuple(np.atleast_1d(x_hz).tolist()),
    }
