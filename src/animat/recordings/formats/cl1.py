"""Reads spikes and stimuli of Cortical Labs CL1 recordings (H5), and the stimulus parameters that animat adds."""

from __future__ import annotations

from typing import Any

import numpy as np

from animat.errors import InvalidFile
from animat.recordings.columns import Column, PlainColumns, recorded_span
from animat.recordings.findings import Finding
from animat.recordings.formats.cl1_layout import CHANNELS, IDENTIFIERS, NO_STIMULATION, SITES, STAND_IN, STIMULUS_STREAM
from animat.recordings.formats.hdf5 import Hdf5File, is_positive
from animat.recordings.formats.stimulus_text import LONGEST, stimulus_columns
from animat.recordings.recording import Recording
from animat.tables import padded

USUAL_RATE_HZ = 25_000.0
_TEXT_HEADERS = {0xD9: 2, 0xDA: 3, 0xDB: 5}
_LARGEST_CHANNEL_COUNT = 4096
_TOGETHER_FRAMES = 2
"""A pulse lasts longer: stimuli that follow so soon are of other electrodes, and of the same pulse."""


def is_cl1(file: Hdf5File) -> bool:
    """Whether a file is laid out as the CL1's are."""
    if any({"timestamp", "channel"} <= set(file.fields(table)) for table in ("spikes", "stims")):
        return True
    return file.attribute("/", "uV_per_sample_unit") is not None and file.has("samples")


def read_cl1(file: Hdf5File, *, spikes: bool = True) -> Recording:
    """Read spikes, which must exist, and stimuli of an open CL1 recording; or only stimuli, for raw traces."""
    findings: list[Finding] = []
    if spikes and not file.has("spikes"):
        remedy = "it was recorded with include_spikes=False; detect them in its raw traces with animat convert --raw"
        raise InvalidFile(f"{file.path}: expected spikes at /spikes, found none: {remedy}")
    rates_hz = [file.attribute("/", name) for name in ("frames_per_second", "sampling_frequency")]
    rate_hz = next((float(rate) for rate in rates_hz if is_positive(rate)), None)
    if rate_hz is None:
        rate_hz, message = USUAL_RATE_HZ, "the sampling rate is not in the file: assumed to be 25 kHz"
        findings.append(Finding("sampling-missing", "warning", message))
    frame, channel = file.columns("spikes", "timestamp", "channel") if spikes else np.empty((2, 0), np.int64)
    n_channels = file.attribute("/", "channel_count")
    if not isinstance(n_channels, int) or not 0 < n_channels <= _LARGEST_CHANNEL_COUNT:
        message = f"the number of channels is not in the file: assumed to be {CHANNELS}"
        findings.append(Finding("channel-count-missing", "note", message))
        n_channels = CHANNELS
    n_channels = max(n_channels, int(channel.max(initial=0)) + 1)
    # A channel is an electrode on this rig, so its number is used for both.
    electrodes = np.array(SITES if n_channels == CHANNELS else range(n_channels), dtype=np.int64)
    stimulus_frame, columns = _stimuli(file)
    columns |= _parameters(file, stimulus_frame, findings)
    # Frames count from 0, or from the start of the rig. Which one is stated by a pickle, which is not opened; so it is
    # inferred: none lies before the start, and the last one beyond the number of frames.
    start, frames = file.attribute("/", "start_timestamp"), file.attribute("/", "duration_frames")
    every = np.concatenate([frame, stimulus_frame])
    is_stated = isinstance(start, int) and isinstance(frames, int) and 0 < frames < every.max(initial=0)
    start = start if is_stated and every.min() >= start else 0
    on_electrode = np.isin(channel, electrodes)
    if stray := int(np.count_nonzero(~on_electrode)):
        strays = np.unique(channel[~on_electrode]).tolist()
        names = ", ".join(f"{c} ({NO_STIMULATION.get(c, 'unknown')})" for c in strays)
        message = f"{stray:,} of {len(channel):,} spikes are on channels {names}, which are no electrodes: left out"
        findings.append(Finding("spikes-not-on-electrodes", "note", message, float(stray)))
    spike_time_s, stimulus_time_s = (frame[on_electrode] - start) / rate_hz, (stimulus_frame - start) / rate_hz
    if isinstance(frames, int) and frames > 0:
        columns |= recorded_span(frames, rate_hz, spike_time_s, stimulus_time_s)
    provenance = {"source": file.path.name, "format": "CL1"}
    for name, key in {"created_utc": "recorded_at", **{name: name for name in IDENTIFIERS}}.items():
        text = file.attribute("/", name)
        if isinstance(text, str) and text and text.isprintable() and text != STAND_IN:
            provenance[key] = text
    columns |= {"channel_label": electrodes, "channel_electrode": electrodes, "sampling_rate_hz": rate_hz}
    plain = PlainColumns(spike_time_s, channel[on_electrode], stimulus_time_s, **columns)
    return plain.to_recording(provenance, tuple(findings))


def _stimuli(file: Hdf5File) -> tuple[Column, dict[str, Any]]:
    """First frame of each stimulus, and its electrodes, which may be a frame or two apart."""
    if not file.has("stims"):
        return np.empty(0, np.int64), {}
    columns = [column.astype(np.int64) for column in file.columns("stims", "timestamp", "channel")]
    frame, channel = np.unique(np.stack(columns), axis=1)
    first = np.flatnonzero(np.diff(frame, prepend=-np.inf) > _TOGETHER_FRAMES)
    electrodes = np.split(channel, first[1:])[: len(first)]
    return frame[first], {"stimulus_electrodes": padded([pulsed.tolist() for pulsed in electrodes])}


def _parameters(file: Hdf5File, stimulus: Column, findings: list[Finding]) -> dict[str, Any]:
    """The parameters of stimuli, except electrodes, from animat's data stream: each entry applies until the next."""
    at = f"data_stream/{STIMULUS_STREAM}"
    if not len(stimulus) or not file.has(f"{at}/index") or not file.has(f"{at}/data"):
        return {}
    index = [file.read(f"{at}/index", column).astype(np.int64) for column in ("timestamp", "start_index", "end_index")]
    frame, starts, ends = index
    data = file.read(f"{at}/data").astype(np.uint8).tobytes()
    # Some versions of the SDK write the first rows of the index again and again: nothing is known from there on.
    _, first = np.unique(np.stack(index), axis=1, return_index=True)
    n_valid = int(np.setdiff1d(np.arange(len(frame)), first).min(initial=len(frame)))
    is_lost = stimulus > frame[:n_valid].max(initial=-1) if n_valid < len(frame) else np.zeros(len(stimulus), bool)
    if lost := int(np.count_nonzero(is_lost)):
        where = f"after {n_valid:,} of {len(frame):,} entries: frequency and pattern of the last {lost:,} stimuli"
        message = f"the SDK's index of the data stream repeats itself {where} are not known; animat's own file has them"
        findings.append(Finding("stimulus-words-lost", "warning", message, float(lost)))
    order = np.argsort(frame[:n_valid], kind="stable")
    texts = [_text(data, int(starts[i]), int(ends[i])) for i in order]
    entry = np.where(is_lost, -1, np.searchsorted(frame[order], stimulus, side="right") - 1)
    columns = stimulus_columns([texts[i] if i >= 0 else "" for i in entry])
    columns.pop("stimulus_electrodes", None)
    return columns


def _text(data: bytes, start: int, end: int) -> str:
    """The text of an entry: msgpack's header of a text, then UTF-8."""
    entry = data[start:end] if 0 <= start < end <= start + LONGEST + 5 else b""
    if not entry:
        return ""
    header = 1 if 0xA0 <= entry[0] <= 0xBF else _TEXT_HEADERS.get(entry[0], 0)
    return entry[header:].decode("utf-8", "replace")
