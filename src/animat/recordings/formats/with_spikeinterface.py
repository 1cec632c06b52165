"""Raw traces of any format that SpikeInterface reads, through the extra `animat[raw]`; imported when asked for.

The format is named by the user (`intan`, `openephys`, `mcsraw`, ...: SpikeInterface's `read_...` functions), never
guessed: guessing would try readers on a stranger's file. SpikeInterface's own saved objects are not read, as they name
Python classes to be loaded.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.columns import PlainColumns
from animat.recordings.formats.csv import read_stimuli_csv, stimuli_beside
from animat.recordings.formats.hdf5 import first_line
from animat.recordings.raw import RawTraces, in_microvolts
from animat.recordings.recording import Channels, Recording

MISSING = (
    "expected the package SpikeInterface, which is not installed: .venv/bin/pip install -c constraints.txt '.[raw]'"
)
REFUSED = ("binary",)
"""A reader of traces that wants to be told more than their file."""


def open_with_spikeinterface(
    path: str | os.PathLike[str], reader: str, *, stimuli_path: str | os.PathLike[str] | None = None
) -> tuple[RawTraces, Recording]:
    """Raw traces read by SpikeInterface, and their recording without spikes.

    Args:
        path: file or folder, as the reader wants it.
        reader: the format, such as `intan`.
        stimuli_path: CSV with the stimuli's times from the start of the traces, as beside CSV spikes; by default
            `NAME_stimuli.csv` beside the file.

    Raises:
        InvalidArgument: for a reader that there is not, or without SpikeInterface.
        InvalidFile: if the file cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InvalidFile(f"{path}: no such file")
    read = _reader(reader)
    try:
        recording = read(path, **({"install_maxwell_plugin": False} if reader == "maxwell" else {}))
        n = int(recording.get_num_channels())
        labels = np.array([str(name) for name in recording.get_channel_ids()], dtype=np.str_)
        placed = recording.has_probe() if hasattr(recording, "has_probe") else False
        xy_um = np.asarray(recording.get_channel_locations())[:, :2] if placed else np.full((n, 2), np.nan)
        x_um, y_um = xy_um.astype(np.float64).T
        channels = Channels(labels, np.full(n, -1), x_um, y_um)
        samples = int(recording.get_num_samples(segment_index=0))
        rate_hz = float(recording.get_sampling_frequency())
        duration_s = samples / rate_hz
        segments = int(recording.get_num_segments())
    except Exception as error:
        # The readers of 40 formats fail in as many ways.
        raise InvalidFile(
            f"{path}: expected {reader} data that SpikeInterface reads, got {first_line(error)}"
        ) from error
    if segments != 1:
        raise InvalidFile(f"{path}: expected one segment of traces, got {segments}; export them one by one")
    pulses = Path(stimuli_path) if stimuli_path is not None else stimuli_beside(path.with_name(f"{path.stem}.csv"))
    columns = {"stimulus_time_s": np.empty(0)} if pulses is None else read_stimuli_csv(pulses)
    base = PlainColumns(
        spike_time_s=np.empty(0),
        spike_channel=np.empty(0, np.int64),
        channel_label=labels,
        channel_xy_um=xy_um,
        sampling_rate_hz=rate_hz,
        duration_s=max(duration_s, float(np.max(columns["stimulus_time_s"], initial=0.0))),
        **columns,
    ).to_recording({"source": path.name, "format": f"{reader}, by SpikeInterface"})

    def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        has_scale = recording.has_scaleable_traces()
        return in_microvolts(
            recording.get_traces(segment_index=0, start_frame=start, end_frame=stop, return_in_uV=has_scale), 1.0
        )

    # From 0 s on, as stimuli beside such files are counted from their start.
    return RawTraces(read_uv, channels, samples, rate_hz), base


def _reader(name: str) -> Callable[..., Any]:
    try:
        extractors = importlib.import_module("spikeinterface.extractors")
    except ImportError as error:
        raise InvalidArgument(f"reader: {MISSING}") from error
    # Not those of sortings and events, nor of SpikeInterface's own saved objects.
    of_traces = list(extractors.recording_extractor_full_dict.values())
    readers = {n[5:]: getattr(extractors, n) for n in dir(extractors) if n.startswith("read_")}
    readers = {n: read for n, read in readers.items() if read in of_traces and n not in REFUSED}
    if name not in readers:
        raise InvalidArgument(f"reader: expected one of {', '.join(sorted(readers))}; got {name!r}")
    return readers[name]  # type: ignore[no-any-return]
