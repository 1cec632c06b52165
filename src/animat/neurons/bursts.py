"""Burst separation: responses in which the whole culture fires come regardless of the stimulus, and are set apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from animat.errors import InvalidArgument


@dataclass(frozen=True, eq=False)
class BurstSeparation:
    """Responses in two classes by their ratio of active channels, and how far the classes stand apart.

    Attributes:
        threshold: a response whose ratio is at or under it is non-burst; NaN without responses.
        separability: between-class over total variance of the ratios, from 0 to 1. A normal distribution, in which
            there is nothing to separate, reaches 0.64 all the same, a flat one 0.75.
        valley: how deep the density of ratios falls between the classes, from 0 (no valley: one hump, cut in two) to
            1 (an empty gap): 1 - (lowest density between the class means) / (the lower of the two classes' peaks).
        is_burst: shape (responses,).
    """

    threshold: float
    separability: float
    valley: float
    is_burst: Bool[np.ndarray, " responses"]


def otsu_threshold(values: Float64[np.ndarray, " values"]) -> float:
    """Otsu's threshold: the cut that makes the variance between the two classes largest.

        w0 w1 (m0 - m1)^2 -> max,  w: the classes' shares, m: their means; values at or under the cut are class 0.

    It is exact: every distinct value is tried as the cut (ratios of active channels are k/N, so there are few), not
    the edges of a histogram. The first of several equally good cuts is taken. Where all values are equal there is
    nothing to cut, and the threshold is that value; without values it is NaN.

    Source: Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. SMC 9 (1979), 62-66,
    doi:10.1109/TSMC.1979.4310076.
    """
    distinct, counts = np.unique(values, return_counts=True)
    if len(distinct) < 2:
        return float(distinct[0]) if len(distinct) else float("nan")
    # Centred: the sums below then lose no digits when the values lie far from 0.
    sums = np.cumsum(counts * (distinct - np.mean(values)))
    n0 = np.cumsum(counts)[:-1]
    n1 = len(values) - n0
    between = n0 * n1 * (sums[:-1] / n0 - (sums[-1] - sums[:-1]) / n1) ** 2
    return float(distinct[np.argmax(between)])


def separate_bursts(active_ratio: Float64[np.ndarray, " responses"], threshold: float | None = None) -> BurstSeparation:
    """Set bursts apart from the other responses of a recording, all conditions at once.

    Args:
        active_ratio: the share of channels with at least one spike in the window, shape (responses,).
        threshold: a ratio to use in place of Otsu's threshold; 1 keeps every response.

    Raises:
        InvalidArgument: for a threshold that is no ratio from 0 to 1.

    Source: the paper's burst separation (Otsu's threshold over all ratios of a recording).
    """
    if threshold is None:
        threshold = otsu_threshold(active_ratio)
    elif not 0 <= threshold <= 1:
        raise InvalidArgument(f"burst_threshold: expected a share of channels from 0 to 1, got {threshold:g}")
    is_burst = active_ratio > threshold
    return BurstSeparation(threshold, separability(active_ratio, is_burst), _valley(active_ratio, is_burst), is_burst)


def separability(values: Float64[np.ndarray, " values"], is_upper: Bool[np.ndarray, " values"]) -> float:
    """Between-class over total variance, w0 w1 (m0 - m1)^2 / var(values); 0 where one class is empty."""
    upper, lower = values[is_upper], values[~is_upper]
    if not len(upper) or not len(lower) or np.ptp(values) == 0:
        return 0.0
    share = len(upper) / len(values)
    return float(share * (1 - share) * (np.mean(upper) - np.mean(lower)) ** 2 / np.var(values))


def _valley(values: Float64[np.ndarray, " values"], is_upper: Bool[np.ndarray, " values"]) -> float:
    """Depth of the valley between the two classes in a kernel estimate of the density."""
    upper, lower = values[is_upper], values[~is_upper]
    if not len(upper) or not len(lower):
        return 0.0
    distinct, counts = np.unique(values, return_counts=True)
    within_sd = np.sqrt(np.var(values) * max(1 - separability(values, is_upper), 0.0))
    # Silverman's width for the classes, but never under the step between possible ratios: its comb is no valley.
    width = max(1.06 * within_sd * len(values) ** -0.2, float(np.min(np.diff(distinct))))
    grid = np.linspace(distinct[0], distinct[-1], 400)
    density: np.ndarray[Any, np.dtype[np.float64]] = np.exp(-0.5 * ((grid[:, None] - distinct) / width) ** 2) @ counts
    between = np.flatnonzero((grid >= np.mean(lower)) & (grid <= np.mean(upper)))
    if not len(between):
        return 0.0
    lowest = between[np.argmin(density[between])]
    return float(1 - density[lowest] / min(density[: lowest + 1].max(), density[lowest:].max()))
