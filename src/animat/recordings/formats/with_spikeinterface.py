"""Opens raw traces in any format that SpikeInterface reads, with the extra `animat[raw]`, which is imported on demand.

The format is never guessed, which would try many readers on an untrusted file. SpikeInterface's own saved objects are
not read, as they name Python classes to load.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from animat.errors import InvalidArgument, InvalidFile, first_line
from animat.extras import install_command
from animat.recordings.columns import PlainColumns, recorded_span
from animat.recordings.formats.csv import in_stimulus_file, read_stimuli_csv, stimuli_beside
from animat.recordings.raw import RawTraces, in_microvolts
from animat.recordings.recording import Recording


def open_with_spikeinterface(
    path: str | os.PathLike[str], reader: str, *, stimuli_path: str | os.PathLike[str] | None = None
) -> tuple[RawTraces, Recording]:
    """Raw traces of a file or folder read by SpikeInterface, and their recording without spikes.

    The reader is the format, such as `intan`. Stimulus times, from the start of the traces, are in CSV, by default in
    `NAME_stimuli.csv` beside it. Raises InvalidArgument for an unknown reader, or if SpikeInterface is not installed,
    and InvalidFile if the file cannot be read.
    """
    path = Path(path)
    if not path.exists():
        raise InvalidFile(f"{path}: no such file")
    read = _reader(reader)
    try:
        recording = read(path, **({"install_maxwell_plugin": False} if reader == "maxwell" else {}))
        labels = np.array([str(name) for name in recording.get_channel_ids()], dtype=np.str_)
        xy_um = np.asarray(recording.get_channel_locations())[:, :2] if recording.has_probe() else None
        samples = int(recording.get_num_samples(segment_index=0))
        rate_hz = float(recording.get_sampling_frequency())
        segments = int(recording.get_num_segments())
    except Exception as error:
        # The readers of some 40 formats raise all kinds of errors.
        raise InvalidFile(f"{path}: expected {reader} data for SpikeInterface, got {first_line(error)}") from error
    if segments != 1:
        raise InvalidFile(f"{path}: expected one segment of traces, got {segments}; export them one by one")
    pulses = Path(stimuli_path) if stimuli_path is not None else stimuli_beside(path.with_name(f"{path.stem}.csv"))
    columns: dict[str, Any]
    columns, findings = ({"stimulus_time_s": np.empty(0)}, []) if pulses is None else read_stimuli_csv(pulses)
    columns |= recorded_span(samples, rate_hz, columns["stimulus_time_s"])
    columns |= {"channel_label": labels, "channel_xy_um": xy_um, "sampling_rate_hz": rate_hz}
    plain = PlainColumns(np.empty(0), np.empty(0, np.int64), **columns)
    with in_stimulus_file(pulses):
        base = plain.to_recording({"source": path.name, "format": f"{reader}, by SpikeInterface"}, tuple(findings))
    get_traces = partial(recording.get_traces, segment_index=0, return_in_uV=recording.has_scaleable_traces())

    def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        return in_microvolts(get_traces(start_frame=start, end_frame=stop), 1.0)

    # The first sample is at 0 s, as the times of stimuli count from the start of the traces.
    return RawTraces(read_uv, base.channels, samples, rate_hz), base


def _reader(name: str) -> Callable[..., Any]:
    try:
        extractors = importlib.import_module("spikeinterface.extractors")
    except ImportError as error:
        missing = "reader: expected the package SpikeInterface, which is not installed"
        raise InvalidArgument(f"{missing}: {install_command('raw')}") from error
    # Excludes readers of sortings, events and SpikeInterface's own objects, and one that needs more than a file.
    of_traces = list(extractors.recording_extractor_full_dict.values())
    readers = {n[5:]: getattr(extractors, n) for n in dir(extractors) if n.startswith("read_")}
    readers = {n: read for n, read in readers.items() if read in of_traces and n != "binary"}
    if name not in readers:
        raise InvalidArgument(f"reader: expected one of {', '.join(sorted(readers))}; got {name!r}")
    return readers[name]  # type: ignore[no-any-return]
