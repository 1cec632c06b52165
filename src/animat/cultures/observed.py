"""What was seen while stimuli were delivered, and how it becomes a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from animat.recordings.recording import Channels, RecordedCulture, Recording
from animat.stimulation.schedule import Schedule
from animat.stimulation.stimulus import Stimuli, Stimulus


class Spikes(NamedTuple):
    """Spikes in the order of time.

    Attributes:
        time_s: counted from whatever the method that returned them says, shape (spikes,).
        channel: row of the culture's channel table, shape (spikes,).
    """

    time_s: Float64[np.ndarray, " spikes"]
    channel: Int64[np.ndarray, " spikes"]


@dataclass(frozen=True, eq=False)
class Observed:
    """What was seen in a stretch of time.

    Attributes:
        start_s: on the culture's clock.
        duration_s: how long was observed; at least as long as asked for, as a living culture's data may come late.
        spikes: times counted from the start.
        stimulus_time_s: when each stimulus really began, counted from the start, shape (stimuli,).
    """

    start_s: float
    duration_s: float
    spikes: Spikes
    stimulus_time_s: Float64[np.ndarray, " stimuli"]


def with_rests(observed: Observed, stimuli: Sequence[Stimulus], now_s: float) -> Observed:
    """What was seen with the times of rests among those of the stimuli that were delivered.

    A rest comes when it was asked for, as late as what was delivered before it.

    Args:
        observed: of the delivery, in which rests have no times.
        stimuli: all that was asked for, in the order of time.
        now_s: that their times count from, on the culture's clock.
    """
    if not any(stimulus.is_rest for stimulus in stimuli):
        return observed
    is_rest = np.array([stimulus.is_rest for stimulus in stimuli])
    asked_s = np.array([stimulus.time_s for stimulus in stimuli]) + (now_s - observed.start_s)
    late_s = np.zeros(len(stimuli))
    late_s[~is_rest] = observed.stimulus_time_s - asked_s[~is_rest]
    before = np.maximum.accumulate(np.where(is_rest, -1, np.arange(len(stimuli))))
    late_s = np.where(before < 0, 0.0, late_s[before])
    time_s = np.maximum(0.0, asked_s + late_s)
    time_s[~is_rest] = observed.stimulus_time_s
    return replace(observed, stimulus_time_s=time_s)


def assembled(
    schedule: Schedule,
    observed: Sequence[Observed],
    *,
    channels: Channels,
    sampling_rate_hz: float,
    start_min: float,
    provenance: Mapping[str, str],
    culture: RecordedCulture | None,
) -> Recording:
    """The blocks of a schedule, one after the other on one clock, as a recording.

    Args:
        schedule: that was delivered.
        observed: what was seen, block by block.
        channels: of the culture.
        sampling_rate_hz: whose samples the spikes lie on.
        start_min: of the recording on the culture's clock.
        provenance, culture: of the recording.

    Returns:
        The recording, its times on samples; it ends with the sample that the last block ends in.
    """
    starts_s = np.cumsum([0.0, *(block.duration_s for block in observed)])
    tables = [block.stimuli for block in schedule.blocks]
    columns = {each.name: np.concatenate([getattr(table, each.name) for table in tables]) for each in fields(Stimuli)}

    def on_samples(parts: Sequence[Float64[np.ndarray, " times"]]) -> Float64[np.ndarray, " times"]:
        # Adding the blocks' starts leaves rounding errors behind.
        times_s = np.concatenate([start_s + part for start_s, part in zip(starts_s, parts, strict=False)])
        return np.asarray(np.rint(times_s * sampling_rate_hz) / sampling_rate_hz)

    return Recording(
        spike_times_s=on_samples([block.spikes.time_s for block in observed]),
        spike_channels=np.concatenate([block.spikes.channel for block in observed]),
        channels=channels,
        stimuli=Stimuli(**columns | {"time_s": on_samples([block.stimulus_time_s for block in observed])}),
        sampling_rate_hz=sampling_rate_hz,
        start_s=0.0,
        # Blocks may end between two samples: what is moved to the next one is still within. Not for a rounding error.
        duration_s=float(np.ceil(starts_s[-1] * sampling_rate_hz - 1e-6) / sampling_rate_hz),
        start_min=start_min,
        presentation=schedule.protocol.presentation,
        provenance=provenance,
        protocol=schedule.protocol,
        culture=culture,
    )


def more_left_out(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """What was left out between two times, where it was anything."""
    more = {what: count - before.get(what, 0) for what, count in after.items()}
    return {what: count for what, count in more.items() if count}
