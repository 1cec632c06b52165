"""What was observed while stimuli were delivered, and how it becomes a recording."""

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
    """Spikes in order of time.

    Attributes:
        time_s: counted from the start that the method returning them documents, shape (spikes,).
        channel: row of the culture's channel table, shape (spikes,).
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


def with_rests(observed: Observed, stimuli: Sequence[Stimulus], now_s: float) -> Observed:
    """The observation with the times of rests inserted among those of the delivered stimuli.

    A rest comes at its requested time, plus the delay of the stimulus delivered before it.

    Args:
        observed: of the delivery, without times of rests.
        stimuli: all that were requested, in order of time.
        now_s: the zero of their times, on the culture's clock.
    """
    if not any(stimulus.is_rest for stimulus in stimuli):
        return observed
    is_rest = np.array([stimulus.is_rest for stimulus in stimuli])
    requested_s = np.array([stimulus.time_s for stimulus in stimuli]) + (now_s - observed.start_s)
    late_s = np.zeros(len(stimuli))
    late_s[~is_rest] = observed.stimulus_time_s - requested_s[~is_rest]
    before = np.maximum.accumulate(np.where(is_rest, -1, np.arange(len(stimuli))))
    late_s = np.where(before < 0, 0.0, late_s[before])
    time_s = np.maximum(0.0, requested_s + late_s)
    time_s[~is_rest] = observed.stimulus_time_s
    return replace(observed, stimulus_time_s=time_s)


def assemble(
    schedule: Schedule,
    observed: Sequence[Observed],
    *,
    channels: Channels,
    sampling_rate_hz: float,
    start_min: float,
    provenance: Mapping[str, str],
    culture: RecordedCulture | None,
) -> Recording:
    """The blocks of a schedule, concatenated on one clock, as a recording.

    Args:
        schedule: as delivered.
        observed: the observation of each block.
        channels: of the culture.
        sampling_rate_hz: of the samples to which times are rounded.
        start_min: of the recording on the culture's clock.
        provenance, culture: of the recording.

    Returns:
        The recording; it ends with the sample in which the last block ends.
    """
    starts_s = np.cumsum([0.0, *(block.duration_s for block in observed)])
    tables = [block.stimuli for block in schedule.blocks]
    columns = {
        column.name: np.concatenate([getattr(table, column.name) for table in tables]) for column in fields(Stimuli)
    }

    def on_samples(parts: Sequence[Float64[np.ndarray, " times"]]) -> Float64[np.ndarray, " times"]:
        # Adding the blocks' starts introduces rounding errors.
        times_s = np.concatenate([start_s + part for start_s, part in zip(starts_s, parts, strict=False)])
        return np.asarray(np.rint(times_s * sampling_rate_hz) / sampling_rate_hz)

    return Recording(
        spike_times_s=on_samples([block.spikes.time_s for block in observed]),
        spike_channels=np.concatenate([block.spikes.channel for block in observed]),
        channels=channels,
        stimuli=Stimuli(**columns | {"time_s": on_samples([block.stimulus_time_s for block in observed])}),
        sampling_rate_hz=sampling_rate_hz,
        start_s=0.0,
        # A block may end between two samples; what is rounded to the later one must be within. Rounding errors aside.
        duration_s=float(np.ceil(starts_s[-1] * sampling_rate_hz - 1e-6) / sampling_rate_hz),
        start_min=start_min,
        presentation=schedule.protocol.presentation,
        provenance=provenance,
        protocol=schedule.protocol,
        culture=culture,
    )


def more_left_out(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """The counts left out between two readings that are not zero."""
    more = {what: count - before.get(what, 0) for what, count in after.items()}
    return {what: count for what, count in more.items() if count}
