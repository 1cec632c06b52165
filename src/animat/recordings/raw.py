"""Raw traces: the voltage of all channels over time, read piece by piece from wherever it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32

from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.recording import Channels


class RawTraces(Protocol):
    """What raw traces are to whoever reads them. May be read from several threads.

    Attributes:
        channels: the table of channels, one a column.
        samples: how many each channel has.
        start_s: time of the first sample on the recording's clock.
    """

    @property
    def channels(self) -> Channels: ...
    @property
    def samples(self) -> int: ...
    @property
    def sampling_rate_hz(self) -> float: ...
    @property
    def start_s(self) -> float: ...

    def read_uv(self, start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        """The voltage of samples `start` to `stop` of all channels, in microvolts.

        What is read from it channel by channel is read faster where it lies so in memory (`in_microvolts`).
        """


TILE_SAMPLES, TILE_CHANNELS = 256, 64


def in_microvolts(steps: np.ndarray[Any, Any], uv_per_step: float) -> Float32[np.ndarray, "samples channels"]:
    """Traces in microvolts, each channel in one stretch of memory, as filters want it.

    Args:
        steps: of any number type, in any layout, shape (samples, channels).
    """
    samples, channels = steps.shape
    rows = np.empty((channels, samples), dtype=np.float32)
    # In tiles: a whole column of 1,024 channels' samples is a step of 4 KB each, for which caches have few places.
    # Copied so, a second of 1,024 channels takes a quarter of the time.
    for first in range(0, channels, TILE_CHANNELS):
        block = slice(first, first + TILE_CHANNELS)
        for start in range(0, samples, TILE_SAMPLES):
            rows[block, start : start + TILE_SAMPLES] = steps[start : start + TILE_SAMPLES, block].T
        rows[block] *= np.float32(uv_per_step)
    return rows.T


@dataclass(frozen=True, eq=False)
class ArrayTraces:
    """Raw traces in memory.

    Attributes:
        voltage_uv: shape (samples, channels), any number type.
        channels: one a column.
        start_s: time of the first sample.
        uv_per_step: what one step of `voltage_uv` is, 1 for microvolts.
    """

    voltage_uv: np.ndarray[Any, Any]
    channels: Channels
    sampling_rate_hz: float
    start_s: float = 0.0
    uv_per_step: float = 1.0

    def __post_init__(self) -> None:
        if self.voltage_uv.ndim != 2 or self.voltage_uv.shape[1] != len(self.channels):
            raise InvalidArgument(
                f"voltage_uv: expected shape (samples, {len(self.channels)} channels), got {self.voltage_uv.shape}"
            )

    @property
    def samples(self) -> int:
        return int(self.voltage_uv.shape[0])

    def read_uv(self, start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        return in_microvolts(self.voltage_uv[start:stop], self.uv_per_step)


@dataclass(frozen=True, eq=False)
class Hdf5Traces:
    """Raw traces in an HDF5 dataset of whole numbers, read as they are asked for.

    Attributes:
        path, where: of the dataset; its values are checked to lie in the file itself.
        columns: of the dataset, in the order of the channels.
        channels_first: whether the dataset is (channels, samples) and not (samples, channels).
        channels: one a column.
        samples, sampling_rate_hz, start_s: as in `RawTraces`.
    """

    path: Path
    where: str
    columns: np.ndarray[Any, np.dtype[np.int64]]
    channels_first: bool
    channels: Channels
    samples: int
    sampling_rate_hz: float
    uv_per_step: float
    start_s: float = 0.0

    def read_uv(self, start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
        """The voltage of samples `start` to `stop`.

        Raises:
            InvalidFile: if the samples cannot be read.
        """
        from animat.recordings.formats.hdf5 import hdf5_file

        with hdf5_file(self.path, "file of raw traces") as file:
            dataset = file.dataset(self.where)
            piece = np.asarray(dataset[:, start:stop].T if self.channels_first else dataset[start:stop])
        if piece.shape[0] != stop - start:
            raise InvalidFile(f"{self.path}: expected samples up to {stop:,} at /{self.where}, got {piece.shape[0]:,}")
        if not np.array_equal(self.columns, np.arange(piece.shape[1])):
            piece = piece[:, self.columns]
        return in_microvolts(piece, self.uv_per_step)
