"""Network bursts of an unstimulated culture: stretches in which it fires far above its usual rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.recordings.recording import Recording

BIN_S = 0.05
MOST_BINS = 10_000_000
"""Five days; the bins of longer recordings are wider."""
TIMES_MEDIAN, BY_CHANCE = 8.0, 0.01


@dataclass(frozen=True, eq=False)
class NetworkBursts:
    """The bursts of a recording, on its clock, and the spikes of all channels in the bins in which they were found.

    Attributes:
        threshold: spikes in a bin above which it belongs to a burst.
        share: the share of all spikes that are in bursts; NaN without spikes.
    """

    start_s: Float64[np.ndarray, " bursts"]
    end_s: Float64[np.ndarray, " bursts"]
    edges_s: Float64[np.ndarray, " edges"]
    count: Float64[np.ndarray, " bins"]
    threshold: float
    share: float

    def __len__(self) -> int:
        return len(self.start_s)

    @property
    def median_s(self) -> float:
        """Median duration in seconds; NaN without bursts."""
        return float(np.median(self.end_s - self.start_s)) if len(self) else math.nan


def find_network_bursts(recording: Recording) -> NetworkBursts:
    """Find runs of 50 ms bins with far more spikes than usual, on all channels together.

    A bin belongs to a burst if it holds more than 8 times the median bin, and more than independent spikes at the mean
    rate (Poisson) would put into any bin in all but one of a hundred recordings.
    """
    from scipy.stats import poisson

    # Times in a wrong unit must not exhaust the memory.
    bin_s = max(BIN_S, recording.duration_s / MOST_BINS)
    edges_s = recording.start_s + bin_s * np.arange(max(1, math.ceil(recording.duration_s / bin_s)) + 1)
    count = np.histogram(recording.spike_times_s, edges_s)[0].astype(np.float64)
    by_chance = float(poisson.isf(BY_CHANCE / len(count), count.mean()))
    threshold = max(TIMES_MEDIAN * float(np.median(count)), by_chance)
    above = np.concatenate([[False], count > threshold, [False]])
    starts, ends = np.flatnonzero(above[1:] & ~above[:-1]), np.flatnonzero(above[:-1] & ~above[1:])
    share = float(count[above[1:-1]].sum() / count.sum()) if count.sum() else math.nan
    return NetworkBursts(edges_s[starts], edges_s[ends], edges_s, count, threshold, share)
