"""How large a channel's noise is, told by the median, which spikes do not move."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

SAMPLES = 2500
"""Of a channel that are looked at, about."""
NORMAL = 0.6745
"""Median of |x| over the standard deviation of x, of a normal distribution."""


def median_noise_uv(
    voltage_uv: Float32[np.ndarray, "channels samples"], is_blank: Bool[np.ndarray, "channels samples"] | None = None
) -> Float32[np.ndarray, " channels"]:
    """Standard deviation of each channel's noise: median(|v - median(v)|) / 0.6745.

    Args:
        voltage_uv: filtered traces, one row a channel.
        is_blank: samples that do not count.
    """
    if is_blank is not None and is_blank.any():
        # A sample counts where no channel is blanked, if there are enough; a few long blanks do not move a median.
        kept = ~is_blank.any(axis=0)
        if np.count_nonzero(kept) >= 0.5 * voltage_uv.shape[1]:
            voltage_uv = voltage_uv[:, kept]
    # Neighbouring samples of a filtered trace say the same: every few of them tell as much.
    voltage_uv = voltage_uv[:, :: max(voltage_uv.shape[1] // SAMPLES, 1)]
    return np.asarray(_median(np.abs(voltage_uv - _median(voltage_uv)[:, None])) / NORMAL, dtype=np.float32)


def _median(values: Float32[np.ndarray, "rows values"]) -> Float32[np.ndarray, " rows"]:
    """Of each row; of the two middle values of an even number, the upper one: one partition, where numpy's takes three,
    and several times as long."""
    middle = values.shape[1] // 2
    return np.asarray(np.partition(values, middle, axis=1)[:, middle], dtype=np.float32)
