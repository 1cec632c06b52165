"""Reads HDF5 files by their layout (NWB, MaxWell, CL1): as a recording, or as raw traces with one without spikes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from jaxtyping import Float32, Float64, Int64

from animat.errors import InvalidArgument, InvalidFile, some_of
from animat.recordings.columns import duration_between
from animat.recordings.formats.cl1 import is_cl1, read_cl1
from animat.recordings.formats.foreign_nwb import read_foreign_nwb
from animat.recordings.formats.hdf5 import PLUGIN_ADVICE, Hdf5File, choose, hdf5_file, is_positive, unavailable_filters
from animat.recordings.formats.maxwell import OLD_CHANNELS, is_maxwell, is_old, parts, read_maxwell
from animat.recordings.formats.nwb import read_nwb
from animat.recordings.raw import RawTraces, in_microvolts
from animat.recordings.recording import Channels, Recording
from animat.tables import UNKNOWN

OLD_LSB_V = 6.294e-6
"""Volts per step in the old layout, if the file does not state it."""
Scale = float | Float64[np.ndarray, " channels"]
"""Microvolts per step, of all channels or of each."""


def _format_of(file: Hdf5File) -> Literal["NWB", "MaxWell", "CL1"]:
    """The format of an open file; refuses an unknown one."""
    if "nwb_version" in file.file.attrs:
        return "NWB"
    if is_maxwell(file):
        return "MaxWell"
    if is_cl1(file):
        return "CL1"
    found = f"another HDF5 file (it holds: {some_of(file.names('/'), 5) or 'nothing'})"
    raise InvalidFile(f"{file.path}: expected NWB, MaxWell or CL1, got {found}; save its columns as NPZ or CSV")


def read_hdf5(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """Read a recording in any of the formats; `part`, `stimuli` and errors are those of `read_recording`."""
    with hdf5_file(path) as file:
        kind = _format_of(file)
        if part is not None and kind != "MaxWell":
            raise InvalidArgument(f"part: expected only for MaxWell files, got {part!r} for one of {kind}")
        if stimuli is not None and kind == "CL1":
            raise InvalidArgument(f"stimuli: expected only for NWB and MaxWell files, got {stimuli!r} for a CL1 file")
        if kind == "NWB":
            return read_nwb(file, stimuli)
        return read_maxwell(file, part, stimuli) if kind == "MaxWell" else read_cl1(file)


def open_traces(path: Path, *, part: str | None = None, stimuli: str | None = None) -> tuple[RawTraces, Recording]:
    """The raw traces of a file, and its recording without spikes: channels, stimuli, provenance.

    `part` says which recording of a MaxWell file, or which series of an NWB file, `stimuli` as in `read_recording`.
    """
    with hdf5_file(path) as file:
        kind = _format_of(file)
        if kind == "MaxWell":
            base = read_maxwell(file, part, stimuli, spikes=False)
            if len(base.stimuli) and any(finding.name == "clock-from-first-event" for finding in base.findings):
                raise InvalidFile(f"{path}: expected frame_nos, which align the traces with stimuli, found none")
            traces = _maxwell(file, part, base)
        elif kind == "CL1":
            base = read_cl1(file, spikes=False)
            traces = _traces(file, "samples", base, _number(file.attribute("/", "uV_per_sample_unit"), 0.195))
        else:
            base = read_foreign_nwb(file, stimuli, spikes=False)
            traces = _nwb(file, part, base)
    rate_hz, pulses_s = traces.sampling_rate_hz, base.stimuli.time_s
    # The recording's own start and stop may only be assumed.
    start_s = float(pulses_s.min(initial=traces.start_s))
    stop_s = float(pulses_s.max(initial=traces.start_s + traces.samples / rate_hz))
    duration_s = duration_between(start_s, stop_s)
    # Replaced together: stimuli lie within the new span, but perhaps not within the new start and the old duration.
    base = replace(base, channels=traces.channels, sampling_rate_hz=rate_hz, start_s=start_s, duration_s=duration_s)
    return traces, base


def _maxwell(file: Hdf5File, part: str | None, base: Recording) -> RawTraces:
    if is_old(file):
        scale = 1e6 * _number(file.first("settings/lsb"), OLD_LSB_V)
        traces = _traces(file, "sig", base, scale, channels_first=True, labels=np.arange(OLD_CHANNELS))
        if all(finding.name != "frames-lost" for finding in base.findings):
            return traces
        low, high = file.dataset("sig")[-2:].astype(np.int64)
        return _with_gaps(file, traces, (high - high[0] << 16) + low - low[0])
    recordings = parts(file)
    at = recordings[choose(f"{file.path}: part", "--part", recordings, part)]
    groups = [f"{at}/groups/{g}" for g in file.names(f"{at}/groups") if file.has(f"{at}/groups/{g}/raw")]
    if not groups:
        raise InvalidFile(f"{file.path}: expected raw traces at /{at}/groups, found none: the rig kept spikes only")
    # Most groups are parts of another one; the one with the most channels has them all.
    group = max(groups, key=lambda group: file.dataset(f"{group}/raw").shape[0])
    labels = file.read(f"{group}/channels") if file.has(f"{group}/channels") else None
    scale = 1e6 * _number(file.first(f"{at}/settings/lsb"), OLD_LSB_V)
    traces = _traces(file, f"{group}/raw", base, scale, channels_first=True, labels=labels)
    if own := file.ends(f"{group}/frame_nos"):
        # The clock starts with the earliest of all groups, also of those without traces.
        every = [file.ends(f"{at}/groups/{name}/frame_nos") for name in file.names(f"{at}/groups")]
        traces = replace(traces, start_s=(own[0] - min(ends[0] for ends in every if ends)) / base.sampling_rate_hz)
        if own[1] - own[0] + 1 != own[2]:
            traces = _with_gaps(file, traces, file.read(f"{group}/frame_nos").astype(np.int64) - own[0])
    return traces


def _with_gaps(file: Hdf5File, traces: RawTraces, frame: Int64[np.ndarray, " samples"]) -> RawTraces:
    """The traces with NaN for the frames that the rig lost; `frame` is the number of each sample, from 0 on."""
    if len(frame) != traces.samples or np.any(np.diff(frame) <= 0) or frame[-1] > 100 * len(frame):
        expected = f"expected rising frame_nos or timestamps for {traces.samples:,} samples"
        got = f"got {len(frame):,} up to frame {frame[-1]:,} that do not rise or belong to others"
        raise InvalidFile(f"{file.path}: {expected}, {got}: damaged; copy or record it again")

    def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        first, last = np.searchsorted(frame, [start, stop]).tolist()
        voltage_uv = np.full((len(traces.channels), stop - start), np.nan, np.float32).T
        voltage_uv[frame[first:last] - start] = traces.read_uv(first, last)
        return voltage_uv

    return replace(traces, read_uv=read_uv, samples=int(frame[-1]) + 1)


def _nwb(file: Hdf5File, part: str | None, base: Recording) -> RawTraces:
    path, kind = file.path, "neurodata_type"
    names = file.names("acquisition")
    series = [name for name in names if file.attribute(f"acquisition/{name}", kind) == "ElectricalSeries"]
    if not series:
        raise InvalidFile(f"{path}: expected raw traces as an ElectricalSeries in /acquisition, found none")
    at = f"acquisition/{choose(f'{path}: series', '--part', series, part, commands='animat convert')}"
    rate_hz, start_s = file.attribute(f"{at}/starting_time", "rate"), float(file.first(f"{at}/starting_time") or 0.0)
    frame = None
    if file.has(f"{at}/timestamps"):
        rate_hz, start_s, frame = _rate_and_frames(file, f"{at}/timestamps")
    if not is_positive(rate_hz):
        raise InvalidFile(f"{path}: expected timestamps of /{at}, or a rate in Hz at its starting_time, found none")
    labels = None
    if file.has(f"{at}/electrodes"):
        rows = file.read(f"{at}/electrodes").astype(np.int64)
        if len(rows) and rows.max() < len(base.channels) and rows.min() >= 0:
            labels = base.channels.label[rows]
    scale: Scale = 1e6 * _number(file.attribute(f"{at}/data", "conversion"), 1.0)
    if file.has(f"{at}/channel_conversion"):
        scale = scale * file.read(f"{at}/channel_conversion").astype(np.float64).reshape(-1)
    base = replace(base, sampling_rate_hz=float(rate_hz))
    traces = _traces(file, f"{at}/data", base, scale, start_s=start_s, labels=labels)
    return traces if frame is None else _with_gaps(file, traces, frame)


def _rate_and_frames(file: Hdf5File, at: str) -> tuple[float, float, Int64[np.ndarray, " samples"]]:
    """The rate of samples with timestamps, in Hz, the time of the first, and the number of each, gaps included."""
    time_s = file.read(at).astype(np.float64).reshape(-1)
    step_s = np.diff(time_s)
    usual_s = float(np.median(step_s)) if len(step_s) else 0.0
    if not usual_s > 0 or not np.isfinite(time_s).all():
        raise InvalidFile(f"{file.path}: expected two or more rising times in s at /{at}, got {len(time_s):,} others")
    # Timestamps are rounded; the mean over all steps but gaps is not.
    rate_hz = 1 / float(np.mean(step_s[np.abs(step_s - usual_s) < 0.5 * usual_s]))
    return rate_hz, float(time_s[0]), np.insert(np.cumsum(np.rint(step_s * rate_hz)), 0, 0).astype(np.int64)


def _traces(
    file: Hdf5File,
    where: str,
    base: Recording,
    uv_per_step: Scale,
    *,
    channels_first: bool = False,
    start_s: float = 0.0,
    labels: Any = None,
) -> RawTraces:
    """Traces in a dataset, with those of the recording's channels that it holds; one label per row or column."""
    path = file.path
    if not isinstance(file.node(where), h5py.Dataset):
        raise InvalidFile(f"{path}: expected raw traces at /{where}, found none")
    dataset = file.dataset(where)
    if dataset.ndim != 2 or dataset.dtype.kind not in "iuf":
        raise InvalidFile(f"{path}: expected traces by channel at /{where}, got {dataset.shape} {dataset.dtype}")
    if missing := unavailable_filters(dataset):
        remedy = f"{PLUGIN_ADVICE}; spikes detected by the rig can be read without it"
        raise InvalidFile(f"{path}: /{where} is compressed by {missing}, which is not installed: {remedy}")
    samples, columns = dataset.shape[::-1] if channels_first else dataset.shape
    if isinstance(uv_per_step, np.ndarray) and len(uv_per_step) != columns:
        raise InvalidFile(f"{path}: expected a conversion of each of the {columns} traces, got {len(uv_per_step)}")
    used, channels = _channels_in(base.channels, columns, labels)
    scale = uv_per_step[used] if isinstance(uv_per_step, np.ndarray) else uv_per_step

    def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        with hdf5_file(path) as again:
            dataset = again.dataset(where)
            piece = np.asarray(dataset[:, start:stop].T if channels_first else dataset[start:stop])
        if piece.shape[0] != stop - start:
            raise InvalidFile(f"{path}: expected samples up to {stop:,} at /{where}, got {piece.shape[0]:,}")
        if not np.array_equal(used, np.arange(columns)):
            piece = piece[:, used]
        return in_microvolts(piece, scale)

    return RawTraces(read_uv, channels, int(samples), base.sampling_rate_hz, start_s)


def _channels_in(table: Channels, columns: int, labels: Any) -> tuple[Int64[np.ndarray, " used"], Channels]:
    """The columns of traces that belong to channels of a table, and these channels; all columns if none do.

    Columns without labels are the table's channels in their order, or are numbered.
    """
    if labels is None and len(table) == columns:
        rows = np.arange(columns)
    else:
        row_of = {str(label): row for row, label in enumerate(table.label)}
        names = range(columns) if labels is None else labels[:columns]
        rows = np.array([row_of.get(str(name), UNKNOWN) for name in names], dtype=np.int64)
    used = np.flatnonzero(rows != UNKNOWN)
    if not len(used):
        every, nowhere = np.arange(columns), np.full(columns, np.nan)
        return every, Channels(every.astype(np.str_), np.full(columns, UNKNOWN), nowhere, nowhere)
    # If a channel occurs twice in the traces, its first column is used.
    _, first = np.unique(rows[used], return_index=True)
    used = used[np.sort(first)]
    kept = rows[used]
    return used, Channels(table.label[kept], table.electrode[kept], table.x_um[kept], table.y_um[kept])


def _number(value: Any, otherwise: float) -> float:
    # Negative where an amplifier inverts.
    return float(value) if isinstance(value, int | float) and is_positive(abs(value)) else otherwise
