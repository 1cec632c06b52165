"""Bursts, in which the whole culture fires: among its responses, regardless of the stimulus, and without stimuli."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from animat.errors import InvalidArgument
from animat.recordings.recording import Recording

LEAST_RESPONSES = 5
"""In each group."""
CLEAR_VALLEY, FAR_VALLEY, FAR = 0.8, 0.5, 8.0
"""The valley between two groups must be `CLEAR_VALLEY` deep, or `FAR_VALLEY` if their means are `FAR` standard
deviations of the lower group apart.

Of samples of 60 to 1,500 responses from 24 distributions with one peak, 2 to 3 % pass as two groups, nearly all of them
because of the long tail of a lognormal distribution (docs/evidence/responses.md)."""
BIN_S = 0.05
MOST_BINS = 10_000_000
"""Five days; the bins of longer recordings are wider."""
TIMES_MEDIAN, BY_CHANCE = 8.0, 0.01


@dataclass(frozen=True, eq=False)
class BurstSeparation:
    """Responses in two classes by their ratio of active channels, and how well the classes are separated.

    Attributes:
        threshold: a response whose ratio is at or below it is not a burst; 1 if there are no two groups, so that
            nothing is set apart; NaN without responses.
        separability: between-class over total variance of the ratios, from 0 to 1; NaN if a given threshold leaves only
            one class. A normal distribution, which has nothing to separate, still reaches 0.64, a flat one 0.75.
        valley: how deep the density of ratios falls between the classes, from 0 (no valley: one hump, cut in two) to
            1 (an empty gap): 1 - (lowest density between the class means) / (the lower of the two classes' peaks).
        rejected: Otsu's threshold if it was rejected, to which the numbers above then belong; NaN otherwise.
    """

    threshold: float
    separability: float
    valley: float
    is_burst: Bool[np.ndarray, " responses"]
    rejected: float = math.nan


def otsu_threshold(values: Float64[np.ndarray, " values"]) -> float:
    """Otsu's threshold: the cut that makes the variance between the two classes largest.

        w0 w1 (m0 - m1)^2 -> max,  w: the classes' shares, m: their means; values at or below the cut are class 0.

    It is exact: every distinct value is tried as the cut (ratios of active channels are k/N, so there are few), not
    the edges of a histogram. The first of several equally good cuts is taken. If all values are equal there is nothing
    to cut, and the threshold is that value; without values it is NaN.

    Source: Otsu 1979, "A threshold selection method from gray-level histograms", doi:10.1109/TSMC.1979.4310076.
    """
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < 2:
        return float(distinct[0]) if len(distinct) else math.nan
    # Centred, so that the sums below lose no digits when the values are far from 0.
    sums = np.cumsum(counts * (distinct - np.mean(values)))
    n0 = np.cumsum(counts)[:-1]
    n1 = len(values) - n0
    between = n0 * n1 * (sums[:-1] / n0 - (sums[-1] - sums[:-1]) / n1) ** 2
    # Equally good cuts may differ by rounding.
    return float(distinct[np.argmax(between >= (1 - 1e-12) * between.max())])


def separate_bursts(
    active_ratio: Float64[np.ndarray, " responses"], threshold: float | None = None, *, n_channels: int
) -> BurstSeparation:
    """Set bursts apart from the other responses of a recording, all conditions together.

    Otsu's method splits any numbers in two. Its split is kept if there are two groups of five responses or more, with a
    valley of at least 0.8 between them, or of 0.5 if they are 8 standard deviations apart; else there are no bursts.

    `active_ratio` is the share of the `n_channels` with a spike in the window; a given `threshold` is used in any case.

    Source: the paper's burst separation (Otsu's threshold over all ratios of a recording), which always cuts.
    """
    check_threshold(threshold)
    cut = otsu_threshold(active_ratio) if threshold is None else threshold
    is_burst = active_ratio > cut
    upper, lower = active_ratio[is_burst], active_ratio[~is_burst]
    valley, apart = _valley(active_ratio, is_burst, n_channels), separability(active_ratio, is_burst)
    if threshold is not None:
        return BurstSeparation(cut, apart if len(upper) and len(lower) else math.nan, valley, is_burst)
    if min(len(upper), len(lower)) >= LEAST_RESPONSES:
        with np.errstate(divide="ignore"):
            distance = (np.mean(upper) - np.mean(lower)) / np.std(lower)
        if valley >= CLEAR_VALLEY or (valley >= FAR_VALLEY and distance >= FAR):
            return BurstSeparation(cut, apart, valley, is_burst)
    kept, rejected = 1.0 if len(active_ratio) else cut, cut if len(upper) else math.nan
    return BurstSeparation(kept, apart, valley, np.zeros_like(is_burst), rejected)


def check_threshold(threshold: float | None) -> None:
    """Raise InvalidArgument for a threshold that is not a share of channels; None is Otsu's."""
    if threshold is not None and not 0 <= threshold <= 1:
        raise InvalidArgument(f"burst_threshold: expected a share of channels from 0 to 1, got {threshold:g}")


def separability(values: Float64[np.ndarray, " values"], is_upper: Bool[np.ndarray, " values"]) -> float:
    """Between-class over total variance, w0 w1 (m0 - m1)^2 / var(values); 0 if one class is empty."""
    upper, lower = values[is_upper], values[~is_upper]
    if not len(upper) or not len(lower) or np.ptp(values) == 0:
        return 0.0
    share = len(upper) / len(values)
    return float(share * (1 - share) * (np.mean(upper) - np.mean(lower)) ** 2 / np.var(values))


def _valley(values: Float64[np.ndarray, " values"], is_upper: Bool[np.ndarray, " values"], n_channels: int) -> float:
    """Depth of the valley between the two classes in a kernel estimate of the density."""
    upper, lower = values[is_upper], values[~is_upper]
    if not len(upper) or not len(lower):
        return 0.0
    distinct, counts = np.unique(values, return_counts=True)
    within_sd = np.sqrt(np.var(values) * max(1 - separability(values, is_upper), 0.0))
    # Silverman's width for the classes, but not below the step between possible ratios: its gaps are not valleys.
    width = max(1.06 * within_sd * len(values) ** -0.2, 1 / n_channels)
    grid = np.linspace(distinct[0], distinct[-1], 400)
    density: np.ndarray[Any, np.dtype[np.float64]] = np.exp(-0.5 * ((grid[:, None] - distinct) / width) ** 2) @ counts
    between = np.flatnonzero((grid >= np.mean(lower)) & (grid <= np.mean(upper)))
    if not len(between):
        return 0.0
    lowest = between[np.argmin(density[between])]
    return float(1 - density[lowest] / min(density[: lowest + 1].max(), density[lowest:].max()))


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
