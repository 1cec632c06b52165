"""What was observed while stimuli were delivered, and how it becomes a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from animat.recordings.recording import Recording
from animat.stimulation.schedule import Schedule
from animat.stimulation.stimulus import Stimuli, Stimulus
from animat.tables import UNKNOWN

Rows = Int64[np.ndarray, " spikes"]


class Spikes(NamedTuple):
    """Spikes in order of time, counted from the start that the method returning them documents; shapes (spikes,).

    `channel` is the row of the culture's channel table.
    """

    time_s: Float64[np.ndarray, " spikes"]
    channel: Int64[np.ndarray, " spikes"]


@dataclass(frozen=True, eq=False)
class Observed:
    """What was observed in a stretch of time.

    Attributes:
        start_s: on the culture's clock.
        duration_s: length of the stretch; at least as long as requested, as a living culture's data may come late.
        spikes: times counted from the start.
        stimulus_time_s: when each stimulus actually began, counted from the start, shape (stimuli,).
    """

    start_s: float
    duration_s: float
    spikes: Spikes
    stimulus_time_s: Float64[np.ndarray, " stimuli"]


def observed_in_frames(
    start: int, stop: int, frame: Rows, row: Rows, begun: Float64[np.ndarray, " stimuli"], rate: int, zero: int = 0
) -> Observed:
    """What a device with `rate` frames a second saw from frame `start` to `stop`, without spikes on `UNKNOWN` rows.

    `begun` are the frames in which stimuli began, and `zero` is that in which the culture's clock is 0.
    """
    frame, row = frame[row != UNKNOWN], row[row != UNKNOWN]
    order = np.lexsort((row, frame))
    spikes = Spikes((frame[order] - start) / rate, row[order])
    return Observed((start - zero) / rate, (stop - start) / rate, spikes, (begun - start) / rate)


def following(before: Observed, observed: Observed) -> tuple[Observed, float]:
    """An observation, extended back to the end of the one before it, and the unobserved seconds in between."""
    missed_s = max(0.0, observed.start_s - before.start_s - before.duration_s)
    spikes = Spikes(observed.spikes.time_s + missed_s, observed.spikes.channel)
    start_s, duration_s = observed.start_s - missed_s, observed.duration_s + missed_s
    return Observed(start_s, duration_s, spikes, observed.stimulus_time_s + missed_s), missed_s


def with_rests(observed: Observed, stimuli: Sequence[Stimulus], now_s: float) -> Observed:
    """The observation of a delivery with the times of all requested stimuli, rests among them, counted from `now_s`.

    A rest comes at its requested time, plus the delay of the stimulus delivered before it.
    """
    if not any(stimulus.is_rest for stimulus in stimuli):
        return observed
    began_s, late_s, times_s = iter(observed.stimulus_time_s.tolist()), 0.0, []
    for stimulus in stimuli:
        requested_s = stimulus.time_s + (now_s - observed.start_s)
        if stimulus.is_rest:
            times_s.append(max(0.0, requested_s + late_s))
        else:
            times_s.append(next(began_s))
            late_s = times_s[-1] - requested_s
    return replace(observed, stimulus_time_s=np.array(times_s))


def assemble(schedule: Schedule, observed: Sequence[Observed], *, sampling_rate_hz: float, **about: Any) -> Recording:
    """A recording from the observations of a schedule's blocks, concatenated on one clock and rounded to samples.

    It ends with the sample in which the last block ends. Other arguments are those of `Recording`.
    """
    starts_s = np.cumsum([0.0, *(block.duration_s for block in observed)])
    tables = [block.stimuli for block in schedule.blocks]
    columns = {each.name: np.concatenate([getattr(table, each.name) for table in tables]) for each in fields(Stimuli)}

    def on_samples(parts: Sequence[Float64[np.ndarray, " times"]]) -> Float64[np.ndarray, " times"]:
        # Adding the blocks' starts introduces rounding errors.
        times_s = np.concatenate([start_s + part for start_s, part in zip(starts_s, parts, strict=False)])
        return np.asarray(np.rint(times_s * sampling_rate_hz) / sampling_rate_hz)

    return Recording(
        spike_times_s=on_samples([block.spikes.time_s for block in observed]),
        spike_channels=np.concatenate([block.spikes.channel for block in observed]),
        stimuli=Stimuli(**columns | {"time_s": on_samples([block.stimulus_time_s for block in observed])}),
        sampling_rate_hz=sampling_rate_hz,
        start_s=0.0,
        # A block may end between two samples; what is rounded to the later one must be within. Rounding errors aside.
        duration_s=float(np.ceil(starts_s[-1] * sampling_rate_hz - 1e-6) / sampling_rate_hz),
        presentation=schedule.protocol.presentation,
        protocol=schedule.protocol,
        **about,
    )
