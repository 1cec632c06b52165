"""Spikes as negative peaks: samples below a threshold that nothing around them is below."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64


def find_negative_peaks(
    voltage_uv: Float32[np.ndarray, "channels samples"],
    depth_uv: Float32[np.ndarray, " channels"],
    apart: int,
    first: int,
    last: int,
) -> tuple[Int64[np.ndarray, " peaks"], Int64[np.ndarray, " peaks"]]:
    """Rows and samples of the negative peaks.

    A sample t is one if v(t) < -depth and v(t) <= v(s) for all s within `apart` samples; of equal ones, the first.

    Args:
        voltage_uv: filtered, one row a channel.
        depth_uv: that a negative peak must exceed on each channel; infinite where nothing is to be found.
        apart: half the width of the neighbourhood, in samples, at least 1.
        first, last: look for negative peaks at samples from `first` on, below `last`.
    """
    inner = voltage_uv[:, first:last]
    # A few of all samples: the neighbourhood is looked at for these only.
    row, column = np.nonzero(inner < -depth_uv[:, None])
    column = column + first
    before, after = np.maximum(column - 1, 0), np.minimum(column + 1, voltage_uv.shape[1] - 1)
    here = voltage_uv[row, column]
    low = (here <= voltage_uv[row, before]) & (here <= voltage_uv[row, after])
    row, column, here = row[low], column[low], here[low]
    if not len(row):
        return row.astype(np.int64), column.astype(np.int64)
    padded = np.pad(voltage_uv, ((0, 0), (apart, apart)), constant_values=np.inf)
    around = padded[row[:, None], column[:, None] + np.arange(2 * apart + 1)[None, :]]
    is_least = np.all(here[:, None] < around[:, :apart], axis=1) & np.all(
        here[:, None] <= around[:, apart + 1 :], axis=1
    )
    return row[is_least].astype(np.int64), column[is_least].astype(np.int64)
