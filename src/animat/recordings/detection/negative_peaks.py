"""Finds spikes as negative peaks, and estimates the noise that sets their threshold."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int64

SAMPLES = 2500
"""Approximate number of samples used per channel."""
NORMAL = 0.6745
"""Ratio of the median of |x| to the standard deviation of x for a normal distribution."""
LEAST_SHARE = 0.1
"""Share of a channel's samples from which its noise can be estimated."""


def median_noise_uv(
    voltage_uv: Float32[np.ndarray, "channels samples"], is_blank: Bool[np.ndarray, "channels samples"] | None = None
) -> Float32[np.ndarray, " channels"]:
    """Standard deviation of each channel's noise, in filtered traces: median(|v - median(v)|) / 0.6745.

    NaN for a channel of which nearly everything is blanked.
    """
    if is_blank is not None and is_blank.any():
        # A sample counts if no channel is blanked, if there are enough of these.
        kept, samples = ~is_blank.any(axis=0), voltage_uv.shape[1]
        if np.count_nonzero(kept) < 0.5 * samples:
            rows = [row[~blank] for row, blank in zip(voltage_uv, is_blank, strict=True)]
            least = LEAST_SHARE * samples
            each = [median_noise_uv(row[None])[0] if len(row) >= least else np.nan for row in rows]
            return np.array(each, dtype=np.float32)
        voltage_uv = voltage_uv[:, kept]
    # Neighbouring samples of a filtered trace are correlated: a subset of them is as informative.
    voltage_uv = voltage_uv[:, :: max(voltage_uv.shape[1] // SAMPLES, 1)]
    return np.asarray(_median(np.abs(voltage_uv - _median(voltage_uv)[:, None])) / NORMAL, dtype=np.float32)


def _median(values: Float32[np.ndarray, "rows values"]) -> Float32[np.ndarray, " rows"]:
    """The (upper) median of each row by one partition; numpy's does three and takes several times as long."""
    middle = values.shape[1] // 2
    return np.asarray(np.partition(values, middle, axis=1)[:, middle], dtype=np.float32)


def find_negative_peaks(
    voltage_uv: Float32[np.ndarray, "channels samples"],
    depth_uv: Float32[np.ndarray, " channels"],
    apart: int,
    first: int,
    last: int,
) -> tuple[Int64[np.ndarray, " peaks"], Int64[np.ndarray, " peaks"]]:
    """Rows and samples of the negative peaks from sample `first` on until `last`.

    A sample t is a peak if v(t) < -depth and v(t) <= v(s) for all s within `apart` samples, at least 1; of equal ones,
    the first. A channel of infinite depth has none.
    """
    inner = voltage_uv[:, first:last]
    # The neighbourhood is checked for these few samples only.
    row, column = np.nonzero(inner < -depth_uv[:, None])
    column = column + first
    before, after = np.maximum(column - 1, 0), np.minimum(column + 1, voltage_uv.shape[1] - 1)
    peak_uv = voltage_uv[row, column]
    low = (peak_uv <= voltage_uv[row, before]) & (peak_uv <= voltage_uv[row, after])
    row, column, peak_uv = row[low], column[low], peak_uv[low]
    if not len(row):
        return row.astype(np.int64), column.astype(np.int64)
    padded = np.pad(voltage_uv, ((0, 0), (apart, apart)), constant_values=np.inf)
    around = padded[row[:, None], column[:, None] + np.arange(2 * apart + 1)[None, :]]
    is_least = np.all(peak_uv[:, None] < around[:, :apart], axis=1)
    is_least &= np.all(peak_uv[:, None] <= around[:, apart + 1 :], axis=1)
    return row[is_least].astype(np.int64), column[is_least].astype(np.int64)
