"""Adaptive thresholds: the percentiles of a culture as it is now, not of a past hour."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy.special import ndtr, ndtri

from animat.coding.mapping import N_PERCENTILES
from animat.neurons.expected_rank import ExpectedRank

COUNTED = 100
"""Of a condition: as many as the paper's recording holds."""
_SHARES = np.linspace(0.0, 1.0, N_PERCENTILES)


class AdaptiveThresholds:
    """Percentiles of a recording, moved by how far the culture's newest responses are above the expected rank.

    A culture drifts and tires: minutes after a recording its responses to all conditions are smaller, and more of them
    stay under the recording's median. Let d_c be how far responses to a condition are above the rank that is expected
    after the same history, a running mean over about `COUNTED` of them, and d the mean of all d_c. Every condition
    counts the same, however often it is chosen. Then the percentile of the share k is

        P_k = Q(Phi(Phi^-1(k) + sqrt(2) Phi^-1(1/2 + d))),

    with the recording's quantiles Q and the normal distribution Phi. This is what P_k becomes when the responses, on a
    scale on which they are normal, all move by as much, and their mean rank is then 1/2 + d. With d = 0.05 the median
    is at the recording's P57, with d = -0.05 at P43.

    Args:
        expected: of the recording that thresholds start from.
    """

    def __init__(self, expected: ExpectedRank) -> None:
        self.expected = expected
        self._above = np.zeros_like(expected.levels)
        self._counts = np.zeros(len(expected.levels))

    @property
    def seen(self) -> int:
        """How many responses were added."""
        return int(self._counts.sum())

    def add(self, condition: int, beyond: Float64[np.ndarray, " readouts"]) -> None:
        """How far above the expected rank a new non-burst response is (`ExpectedRank.beyond`), of each readout."""
        self._counts[condition] += 1
        self._above[condition] += (beyond - self._above[condition]) / min(self._counts[condition], COUNTED)

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """P0, P10, ..., P100 of the culture now, in Hz, shape (11,), or (readouts, 11)."""
        by = np.sqrt(2) * ndtri(0.5 + self._above.mean(axis=0))
        shares = ndtr(ndtri(_SHARES) + by[:, None])
        each = zip(np.atleast_2d(self.expected.sorted_hz), shares, strict=True)
        moved = [np.quantile(own_hz, share) for own_hz, share in each]
        return np.asarray(moved, np.float32).reshape(*self.expected.sorted_hz.shape[:-1], N_PERCENTILES)
