"""Raw traces: the voltage of all channels over time, read piece by piece from any source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from animat.errors import InvalidArgument
from animat.recordings.recording import Channels

TILE_SAMPLES, TILE_CHANNELS = 256, 64


def in_microvolts(
    steps: np.ndarray[Any, Any], uv_per_step: float | Float64[np.ndarray, " channels"]
) -> Float32[np.ndarray, "samples channels"]:
    """Traces in microvolts, with each channel contiguous in memory, as filters need it."""
    samples, channels = steps.shape
    scale = np.broadcast_to(np.asarray(uv_per_step, np.float32), channels)
    rows = np.empty((channels, samples), dtype=np.float32)
    # In tiles, which takes a quarter of the time: successive samples of 1,024 channels are 4 KB apart, for which caches
    # have few places.
    for first in range(0, channels, TILE_CHANNELS):
        block = slice(first, first + TILE_CHANNELS)
        for start in range(0, samples, TILE_SAMPLES):
            rows[block, start : start + TILE_SAMPLES] = steps[start : start + TILE_SAMPLES, block].T
        rows[block] *= scale[block, None]
    return rows.T


@dataclass(frozen=True, eq=False)
class RawTraces:
    """Raw traces of a recording. Can be read from several threads.

    Attributes:
        read_uv: `read_uv(start, stop)` returns the voltage of samples `start` to `stop` of all channels, in microvolts,
            shape (samples, channels). Processing it by channel is faster if each channel is contiguous in memory
            (`in_microvolts`).
        channels: the channel table, one row per column.
        samples: of each channel.
        start_s: time of the first sample on the recording's clock.
    """

    read_uv: Callable[[int, int], Float32[np.ndarray, "samples channels"]]
    channels: Channels
    samples: int
    sampling_rate_hz: float
    start_s: float = 0.0

    @classmethod
    def from_array(
        cls,
        voltage_uv: np.ndarray[Any, Any],
        channels: Channels,
        sampling_rate_hz: float,
        start_s: float = 0.0,
        uv_per_step: float = 1.0,
    ) -> RawTraces:
        """Raw traces in memory.

        Args:
            voltage_uv: shape (samples, channels), any number type, in steps of `uv_per_step`.

        Raises:
            InvalidArgument: for a wrong shape.
        """
        if voltage_uv.ndim != 2 or voltage_uv.shape[1] != len(channels):
            raise InvalidArgument(f"voltage_uv: expected (samples, {len(channels)} channels), got {voltage_uv.shape}")

        def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
            return in_microvolts(voltage_uv[start:stop], uv_per_step)

        return cls(read_uv, channels, len(voltage_uv), sampling_rate_hz, start_s)
