"""Files laid out as rigs and other programs write them, made with h5py alone; every trap is an argument."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

RATE_HZ = 20_000
FIRST_FRAME = 5_000_000
MAPPING = np.dtype([("channel", "<i4"), ("electrode", "<i4"), ("x", "<f8"), ("y", "<f8")])
SPIKES = np.dtype([("frameno", "<i8"), ("channel", "<i4"), ("amplitude", "<f4")])
EVENTS = np.dtype([("frameno", "<i8"), ("eventtype", "<u4"), ("eventid", "<u4"), ("eventmessage", h5py.string_dtype())])
BITS = np.dtype([("frameno", "<i8"), ("bits", "<u4")])
UNKNOWN_FILTER = 32_001
"""No filter of this number is installed; the vendor's is one of these."""


def mapping_table(channels: Sequence[int], electrodes: Sequence[int]) -> np.ndarray:
    """Electrodes lie on the MaxOne's grid."""
    table = np.zeros(len(channels), MAPPING)
    table["channel"], table["electrode"] = channels, electrodes
    table["x"], table["y"] = np.array(electrodes) % 220 * 17.5, np.array(electrodes) // 220 * 17.5
    return table


def spike_table(seconds: Sequence[float], channels: Sequence[int], first_frame: int = FIRST_FRAME) -> np.ndarray:
    """As the rig writes it."""
    table = np.zeros(len(seconds), SPIKES)
    table["frameno"] = first_frame + np.rint(np.array(seconds) * RATE_HZ).astype(np.int64)
    table["channel"], table["amplitude"] = channels, -30.0
    return table


def event_table(seconds: Sequence[float], messages: Sequence[str], types: Sequence[int] | None = None) -> np.ndarray:
    """As the rig writes it."""
    table = np.zeros(len(seconds), EVENTS)
    table["frameno"] = FIRST_FRAME + np.rint(np.array(seconds) * RATE_HZ).astype(np.int64)
    table["eventtype"] = np.ones(len(seconds)) if types is None else types
    table["eventid"] = 7
    table["eventmessage"] = messages
    return table


def write_maxwell(
    path: Path,
    *,
    mapping: np.ndarray | None,
    spikes: np.ndarray | None,
    events: np.ndarray | None = None,
    recorded: Sequence[int] | None = None,
    raw: np.ndarray | None = None,
    compressed: bool = False,
    frames: int = 200_000,
    parts: Sequence[tuple[str, str]] = (("well000", "rec0000"),),
    linked: bool = False,
) -> Path:
    """A file of the new layout; `linked`: the data are in /data_store and the wells are links, as in newest files."""
    with h5py.File(path, "w") as file:
        file["version"] = np.array([b"20190530"])
        for i, (well, rec) in enumerate(parts):
            at = f"data_store/data{i:04d}" if linked else f"wells/{well}/{rec}"
            group = file.create_group(at)
            if mapping is not None:
                group["settings/mapping"] = mapping
            group["settings/sampling"] = np.array([float(RATE_HZ)])
            group["settings/lsb"] = np.array([6.3e-6])
            group["start_time"] = np.array([1_700_000_000_000])
            if spikes is not None:
                group["spikes"] = spikes
            if events is not None:
                group["events"] = events
            if recorded is not None:
                routed = group.create_group("groups/routed")
                routed["channels"] = np.array(recorded, dtype="<u4")
                n = frames if raw is None else raw.shape[1]
                routed["frame_nos"] = FIRST_FRAME + np.arange(n, dtype="<u8")
                if raw is not None:
                    _raw(routed, raw, compressed)
            if linked:
                file.require_group(f"wells/{well}")[rec] = h5py.SoftLink(f"/{at}")
                file.require_group(f"recordings/{rec}")[well] = h5py.SoftLink(f"/{at}")
    return path


def write_old_maxwell(
    path: Path,
    *,
    mapping: np.ndarray,
    spikes: np.ndarray | None,
    bits: np.ndarray | None,
    sig: np.ndarray | None = None,
    lost: int = 0,
) -> Path:
    """A file of version 20160704: 1,024 channels and four rows more, the last two the frame number.

    Half way, so many frames are lost.
    """
    with h5py.File(path, "w") as file:
        file["version"] = np.array([b"20160704"])
        file["mapping"] = mapping
        file["settings/lsb"] = np.array([6.3e-6])
        if sig is None:
            sig = np.zeros((1028, 100), "<u2")
        at = np.arange(sig.shape[1])
        frame = FIRST_FRAME + at + lost * (at >= len(at) // 2)
        sig[-2, :], sig[-1, :] = frame & 0xFFFF, frame >> 16
        file["sig"] = sig
        if spikes is not None:
            file["proc0/spikeTimes"] = spikes
        if bits is not None:
            file["bits"] = bits
    return path


class Bomb:
    """Says so when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return (Path.touch, (self.mark,))


def write_cl1(
    path: Path,
    *,
    spikes: Sequence[tuple[int, int]] | None,
    stims: Sequence[tuple[int, int]] | None,
    stream: Sequence[tuple[int, bytes]] | None = None,
    samples: np.ndarray | None = None,
    start: int = 0,
    mark: Path | None = None,
) -> Path:
    """A recording of the SDK, with pickled attributes as PyTables writes them; `mark`: with one that does something."""
    with h5py.File(path, "w") as file:
        file.attrs["frames_per_second"] = 25_000
        file.attrs["channel_count"] = 64
        file.attrs["duration_frames"] = 250_000
        file.attrs["start_timestamp"] = start
        file.attrs["created_utc"] = "2025-03-01T10:00:00+00:00"
        file.attrs["uV_per_sample_unit"] = 0.195
        format_ = {"version": "SDK", "stim_and_spike_timestamps_relative_to_start": start == 0}
        file.attrs["file_format"] = np.bytes_(pickle.dumps(format_, 0))
        file.attrs["application"] = np.bytes_(pickle.dumps(Bomb(mark) if mark else {}, 0))
        if spikes is not None:
            table = np.zeros(len(spikes), [("timestamp", "<i8"), ("channel", "u1"), ("samples", "<f4", (75,))])
            table["timestamp"], table["channel"] = np.array(spikes, np.int64).reshape(-1, 2).T
            file["spikes"] = table
        if stims is not None:
            table = np.zeros(len(stims), [("timestamp", "<i8"), ("channel", "u1")])
            table["timestamp"], table["channel"] = np.array(stims, np.int64).reshape(-1, 2).T
            file["stims"] = table
        if samples is not None:
            file["samples"] = samples
        file.create_group("data_stream")
        if stream is not None:
            ends = np.cumsum([len(data) for _, data in stream])
            index = np.zeros(len(stream), [("timestamp", "<i8"), ("start_index", "<u8"), ("end_index", "<u8")])
            index["timestamp"] = [frame for frame, _ in stream]
            index["start_index"], index["end_index"] = [0, *ends[:-1]], ends
            file["data_stream/animat_stimuli/index"] = index
            file["data_stream/animat_stimuli/data"] = np.frombuffer(b"".join(data for _, data in stream), np.uint8)
    return path


def packed_text(text: str) -> bytes:
    """A text as msgpack packs it."""
    data = text.encode()
    if len(data) < 32:
        return bytes([0xA0 | len(data)]) + data
    return (bytes([0xD9, len(data)]) if len(data) < 256 else b"\xda" + len(data).to_bytes(2, "big")) + data


def _raw(group: h5py.Group, raw: np.ndarray, compressed: bool) -> None:
    if not compressed:
        group["raw"] = raw
        return
    # A dataset that names a filter nobody has: as raw traces look to whoever lacks the vendor's plugin.
    created = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    created.set_chunk((1, min(100, raw.shape[1])))
    created.set_filter(UNKNOWN_FILTER, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple(raw.shape)
    h5py.h5d.create(group.id, b"raw", h5py.h5t.NATIVE_UINT16, space, created)
