"""A recording out of raw traces: the spikes found in them, with the channels and stimuli of their file."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from animat.progress import Progress
from animat.recordings.detection.finding_spikes import find_spikes
from animat.recordings.detection.settings import Detection
from animat.recordings.findings import merged
from animat.recordings.raw import RawTraces
from animat.recordings.recording import Recording


def read_traces(
    path: str | os.PathLike[str],
    settings: Detection | None = None,
    *,
    part: str | None = None,
    stimuli: str | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Find the spikes in a file's raw traces (MaxWell, CL1, NWB) and make a recording of them.

    Args:
        part, stimuli: as in `read_recording`.
        progress: told after each piece.

    Raises:
        InvalidFile: if the file holds no raw traces, or they cannot be read.
        InvalidArgument: for settings that the traces do not allow.
    """
    from animat.recordings.formats.traces import open_traces
    from animat.recordings.reading import expect_traces

    expect_traces(Path(path))
    traces, base = open_traces(path, part=part, stimuli=stimuli)
    return with_spikes_of(traces, base, settings, progress=progress)


def with_spikes_of(
    traces: RawTraces, base: Recording, settings: Detection | None = None, *, progress: Progress | None = None
) -> Recording:
    """A recording with the spikes of raw traces in place of its own; how they were found goes into its provenance.

    Args:
        traces: of the recording's channels.
        base: channels (those of the traces), stimuli, span and provenance.
        progress: told after each piece.
    """
    settings = settings or Detection()
    found = find_spikes(traces, base.stimuli.time_s, settings, progress=progress)
    band = "as recorded" if settings.band_hz is None else f"{settings.band_hz[0]:g}-{settings.band_hz[1]:g} Hz"
    how = (
        f"{band}, {settings.threshold:g} x median noise, dead time {settings.dead_time_ms:g} ms, blanked "
        f"{settings.blank_ms[0]:g} ms before to {settings.blank_ms[1]:g} ms after stimuli"
    )
    # A spike is at its sample, which rounding may put an ulp outside of the span.
    time_s = np.clip(found.time_s, base.start_s, base.stop_s)
    return replace(
        base,
        spike_times_s=time_s,
        spike_channels=found.channel,
        sampling_rate_hz=traces.sampling_rate_hz,
        provenance={**base.provenance, "spikes": how},
        findings=merged((*base.findings, *found.findings)),
    )
