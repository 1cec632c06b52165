"""A simulator of synthetic responses with a known distribution, for first trials and for tests without recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from animat.errors import InvalidArgument
from animat.neurons.simulator import PERCENTILES, HistogramSimulator, to_jax

MEANS_HZ = (30.0, 36.0, 42.0, 48.0, 54.0)
"""Mean responses to the five conditions, in the order of 5, 10, 20, 40 and 80 Hz."""
LEAST_SHAPE = 0.1
"""With a smaller one the lowest percentiles are below the accuracy with which they are found."""
LABELS = ("5 Hz", "10 Hz", "20 Hz", "40 Hz", "80 Hz")


def synthetic_simulator(means_hz: Sequence[float] = MEANS_HZ, *, shape: float = 6.0) -> HistogramSimulator:
    """The histogram simulator of gamma-distributed responses, in closed form: nothing is drawn or fitted.

        x | condition c  ~  Gamma(shape, means_hz[c] / shape)

    With the defaults, a response passes the pooled median (38.7 Hz) with probability 0.22, 0.38, 0.53, 0.64 and 0.74.
    The histogram has 20 bins, the paper's from 0 to 120 Hz, or as many times wider as the largest mean is larger than
    54 Hz; the last has all above. P0 and P100 are not those of the distribution, 0 and infinity, but of the paper's
    n = 500 responses: 1/(n + 1) and n/(n + 1).

    Args:
        means_hz: mean response to each condition, Hz per channel.
        shape: of all gamma distributions; the larger, the narrower.

    Raises:
        InvalidArgument: for no means, a mean that is not positive, or a shape below 0.1.
    """
    from scipy.optimize import brentq
    from scipy.special import gammainc

    means = np.asarray(means_hz, np.float64)
    if means.ndim != 1 or not len(means) or not np.all(np.isfinite(means) & (means > 0)):
        raise InvalidArgument(f"means_hz: expected a positive mean in Hz per condition, got {means_hz!r}")
    if not (np.isfinite(shape) and shape >= LEAST_SHAPE):
        raise InvalidArgument(f"shape: expected a number from {LEAST_SHAPE} up, got {shape!r}")

    edges_hz = np.linspace(0.0, 120.0 * (means.max() / MEANS_HZ[-1]), 21)
    cumulative = gammainc(shape, edges_hz * shape / means[:, None])
    cumulative[:, -1] = 1.0

    def pooled(x_hz: float, share: float) -> float:
        return float(np.mean(gammainc(shape, x_hz * shape / means))) - share

    shares = np.clip(np.array(PERCENTILES) / 100, 1 / 501, 500 / 501)
    percentiles_hz = [brentq(pooled, 0.0, 100 * float(means.max()), (share,)) for share in shares]
    return HistogramSimulator(*(to_jax(each) for each in (cumulative, edges_hz, percentiles_hz)))
