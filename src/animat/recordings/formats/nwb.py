"""NWB, animat's own format on disk: written with pynwb as whole columns, read with plain h5py."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float64, Int64

from animat.arguments import checked_arguments
from animat.compilation import pynwb_importable
from animat.errors import InvalidArgument, InvalidFile, UnusableData, in_file
from animat.recordings.formats.foreign_nwb import read_foreign_nwb
from animat.recordings.formats.hdf5 import Hdf5File
from animat.recordings.formats.nwb_layout import ELECTRODES, FORMAT_VERSION, PROVENANCE, RECORDING, STIMULI, UNITS
from animat.recordings.formats.nwb_spikes import SpikeBlock, SpikeCounts, write_spikes
from animat.recordings.metadata import from_metadata
from animat.recordings.recording import Channels, Recording
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN
from animat.writing import atomic_write

LARGEST_VALUES = 10_000_000
"""Rows times columns of the electrodes table."""


@checked_arguments
def write_nwb(
    recording: Recording,
    path: str | os.PathLike[str],
    spikes: Iterable[SpikeBlock] | None = None,
    counts: SpikeCounts | None = None,
    *,
    replaces: bool = True,
) -> None:
    """Write a recording as one NWB file, complete or absent.

    NWB's fields for its origin are filled from `Recording.provenance`, by the keys in docs/recordings.md.

    Args:
        path: parent folders are created, and an old file is replaced only by a complete new one.
        replaces: whether there may be an old file.
        spikes, counts: instead of the recording's own, which must be empty; may exceed memory, in any order.

    Raises:
        InvalidFile: if the file cannot be written (no permission, a full disk, an old file that must stay).
        InvalidArgument: for a name that does not end in `.nwb`, text that HDF5 cannot hold, or a `recorded_at` that is
            no date.
        UnusableData: for `spikes` that are not finite, not on a channel, or outside the recording.
    """
    if not os.fspath(path).endswith(".nwb"):
        raise InvalidArgument(f"path: expected a name ending in .nwb, got {path}")
    with pynwb_importable():
        from hdmf.build import BuildManager
        from pynwb import NWBHDF5IO

        from animat.recordings.formats.nwb_tables import nwb_file

    if spikes is None or counts is None:
        own = recording.spike_times_s, recording.spike_channels
        spikes, counts = [own], SpikeCounts(len(recording.channels))
        counts.add(*own)
    of_channels, (first_s, last_s) = counts.of_channels, counts.span_s
    if np.any(of_channels) and not recording.start_s <= first_s <= last_s <= recording.stop_s:
        expected = f"times within the recording ({recording.start_s:g} to {recording.stop_s:g} s)"
        raise UnusableData(f"spike_times_s: expected {expected}, got {first_s:g} to {last_s:g} s")
    tree = nwb_file(recording, of_channels)
    with atomic_write(path, replaces=replaces) as temporary, _ErrorKeepingFile(temporary, "r+") as disk:
        try:
            with (
                h5py.File(disk, "w") as file,
                NWBHDF5IO(file=file, mode="w", manager=BuildManager(_types())) as nwb_io,
            ):
                nwb_io.write(tree)
                if len(recording.channels):
                    write_spikes(file[f"{UNITS}/spike_times"], spikes, of_channels)
        except Exception as error:
            # A full disk is the cause; HDF5's own error only follows from it.
            raise disk.error or error from None
        if disk.error is not None:
            raise disk.error


@lru_cache(maxsize=1)
def _types() -> Any:
    """pynwb's map of NWB types, kept because it caches what it looks up while writing."""
    import pynwb

    return pynwb.get_type_map()


def recording_name(start_min: float) -> str:
    """The file name of a recording that starts at `start_min` on the culture's clock."""
    return f"recording_{format(start_min, 'g').zfill(4)}_min.nwb"


class _ErrorKeepingFile(io.FileIO):
    """A file that accepts every write and remembers the first error, as HDF5 does not recover from a full disk."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data)
        try:
            while left and self.error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return len(data)

    def readinto(self, buffer: Any) -> int:
        # HDF5 reads what it wrote, and h5py hands it whatever is in the buffer: garbage, with which it may crash.
        view = memoryview(buffer).cast("B")
        n = super().readinto(view) or 0
        view[n:] = bytes(len(view) - n)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


def read_nwb(file: Hdf5File, stimuli: str | None = None) -> Recording:
    """Read an open file of `write_nwb`, which equals the original recording, or of another program."""
    path = file.path
    if not file.has(RECORDING):
        return read_foreign_nwb(file, stimuli)
    if stimuli is not None:
        raise InvalidFile(f"{path}: expected no choice of stimuli for animat's own file, got {stimuli!r}")
    version = int(_cell(file, "format_version"))
    if version > FORMAT_VERSION:
        raise InvalidFile(f"{path}: expected format version {FORMAT_VERSION} or older, got {version}: update animat")
    texts = dict[str, str]()
    if file.has(PROVENANCE):
        keys, values = (file.read(f"{PROVENANCE}/{name}").tolist() for name in ("key", "words"))
        texts = dict(zip(keys, values, strict=True))
    order, pulses = str(_cell(file, "presentation_order")), int(_cell(file, "presentation_pulses"))
    names = ("sampling_rate_hz", "start_s", "duration_s", "start_min")
    scalars: dict[str, Any] = {name: float(_cell(file, name)) for name in names}
    times, channels = _spikes(file)
    with in_file(path):
        return Recording(
            spike_times_s=times,
            spike_channels=channels,
            channels=_channels(file),
            stimuli=_stimuli(file, int(_cell(file, "stimulus_electrode_columns"))),
            presentation=Presentation(order, pulses) if order else None,  # type: ignore[arg-type]
            **scalars,
            **from_metadata(texts),
        )


def _cell(file: Hdf5File, name: str) -> Any:
    return file.read(f"{RECORDING}/{name}")[0].item()


def _spikes(file: Hdf5File) -> tuple[Float64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
    if not file.has(UNITS):
        return np.empty(0), np.empty(0, dtype=np.int64)
    times = file.read(f"{UNITS}/spike_times")
    counts = file.row_lengths(f"{UNITS}/spike_times", len(times))
    channels = np.repeat(np.arange(len(counts)), counts)
    # By channel: a stable sort leaves simultaneous spikes in the order of their channels, as Recording requires.
    order = np.argsort(times, kind="stable")
    return times[order], channels[order]


def _channels(file: Hdf5File) -> Channels:
    if not file.has(ELECTRODES):
        return Channels(label=np.empty(0, np.str_), electrode=np.empty(0, np.int64), x_um=np.empty(0), y_um=np.empty(0))
    return Channels(*(file.read(f"{ELECTRODES}/{name}") for name in ("label", "electrode_id", "rel_x", "rel_y")))


def _stimuli(file: Hdf5File, columns: int) -> Stimuli:
    time_s = file.read(f"{STIMULI}/start_time")
    if file.has(f"{STIMULI}/electrode_ids"):
        flat = file.read(f"{STIMULI}/electrode_ids")
        lengths = file.row_lengths(f"{STIMULI}/electrode_ids", len(flat))
    else:
        flat, lengths = np.empty(0, np.int64), np.zeros(len(time_s), np.int64)
    if not 0 <= columns <= LARGEST_VALUES // max(len(lengths), 1):
        raise UnusableData(f"stimulus_electrode_columns: expected the width of a table, got {columns}")
    electrodes = np.full((len(lengths), columns), UNKNOWN, dtype=np.int64)
    electrodes[np.arange(columns)[None, :] < lengths[:, None]] = flat
    others = {name: file.read(f"{STIMULI}/{name}") for name in ("frequency_hz", "pattern", "presentation")}
    return Stimuli(time_s=time_s, electrodes=electrodes, **others)
