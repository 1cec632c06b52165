"""Raw traces: the voltage of all channels over time, read piece by piece from wherever it is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from animat.errors import InvalidArgument
from animat.recordings.recording import Channels

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
class RawTraces:
    """Raw traces of a recording. May be read from several threads.

    Attributes:
        read_uv: the voltage of samples `start` to `stop` of all channels, in microvolts, shape (samples, channels):
            `read_uv(start, stop)`. What is read from it channel by channel is read faster where it lies so in memory
            (`in_microvolts`).
        channels: the table of channels, one a column.
        samples: how many each channel has.
        start_s: time of the first sample on the recording's clock.
    """

    read_uv: Callable[[int, int], Float32[np.ndarray, "samples channels"]]
    channels: Channels
    samples: int
    sampling_rate_hz: float
    start_s: float = 0.0

    @classmethod
    def of_array(
        cls,
        voltage_uv: np.ndarray[Any, Any],
        channels: Channels,
        sampling_rate_hz: float,
        start_s: float = 0.0,
        uv_per_step: float = 1.0,
    ) -> RawTraces:
        """Raw traces in memory.

        Args:
            voltage_uv: shape (samples, channels), any number type.
            channels: one a column.
            start_s: time of the first sample.
            uv_per_step: what one step of `voltage_uv` is, 1 for microvolts.

        Raises:
            InvalidArgument: for another shape.
        """
        if voltage_uv.ndim != 2 or voltage_uv.shape[1] != len(channels):
            raise InvalidArgument(
                f"voltage_uv: expected shape (samples, {len(channels)} channels), got {voltage_uv.shape}"
            )

        def read_uv(start: int, stop: int) -> Float32[np.ndarray, "samples channels"]:
            return in_microvolts(voltage_uv[start:stop], uv_per_step)

        return cls(read_uv, channels, len(voltage_uv), sampling_rate_hz, start_s)
