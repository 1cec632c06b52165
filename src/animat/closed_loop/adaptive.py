"""Adaptive thresholds: the percentiles of a culture's current responses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy.special import ndtr, ndtri

from animat.coding.mapping import N_PERCENTILES
from animat.neurons.history import ranks_among
from animat.neurons.history_tracker import AdjustedRanks, HistoryState

NEWEST = 100
"""Responses kept of a condition, as many as in the paper's recording; with more, thresholds would adapt late."""
LATEST = 5
"""Responses to a condition in the running mean: with five conditions 25 trials, some seconds."""
_SCORES = ndtri(np.linspace(0.0, 1.0, N_PERCENTILES))
"""P0, P10, ..., P100 of a normal distribution."""
_LIMITS = 0.01, 0.99
"""Limits of the mean rank 1/2 + d: at 0 and 1 thresholds would be infinite."""


class AdaptiveThresholds:
    """Percentiles of the newest responses, shifted by how far the latest of them are above the others.

    A culture drifts and tires: minutes after a recording its responses to all conditions are smaller, and more of them
    stay below the recording's median. So each new response replaces the oldest one to its condition. Every condition
    keeps the share that it has in the recording, however often it is chosen.

    Responses also rise and fall within seconds. Let y be a response's rank without what its history explains
    (`AdjustedRanks`), and d_c the difference between two means of y: that of about the `LATEST` responses to a
    condition and that of all its kept responses. d is the mean of d_c over the conditions, weighted by w_c: 1 when the
    condition was delivered last, and multiplied by 1 - 1 / (`LATEST` C) with each response to another of the C
    conditions. Then the percentile of the share k is

        P_k = Q(Phi(Phi^-1(k) + sqrt(2) Phi^-1(1/2 + d))),

    with the quantiles Q of the newest responses to all conditions together, and the normal distribution Phi. P_k
    becomes this when all responses rise equally, on a scale on which they are normal, so that their mean rank is
    1/2 + d. With d = 0.05 the median is at P57, with d = -0.05 at P43.

    Thresholds start from the `recorded` responses. If a condition has more than `NEWEST`, the newest are used, and the
    same share for all conditions.
    """

    def __init__(self, recorded: AdjustedRanks) -> None:
        self._kept = np.array(kept_counts(recorded))
        self._first = np.cumsum(self._kept) - self._kept
        self._hz, self._ranks = (
            np.concatenate([responses[-kept:] for responses, kept in zip(values, self._kept, strict=True)])
            for values in (recorded.responses_hz, recorded.ranks)
        )
        self._recorded, self._added = recorded, np.zeros(len(self._kept), np.int64)
        self._latest, self._weights = self._means(), np.ones(len(self._kept))

    def add(self, condition: int, at_trial: HistoryState, read_hz: Float64[np.ndarray, "*readouts"]) -> None:
        """Add a new non-burst response to a condition, with the history state at its trial."""
        row = self._first[condition] + self._added[condition] % self._kept[condition]
        self._hz[row] = read_hz
        self._ranks[row] = rank = self._recorded.of_response(at_trial, read_hz)
        self._latest[condition] += (rank - self._latest[condition]) / LATEST
        self._added[condition] += 1
        self._weights *= 1 - 1 / (LATEST * len(self._weights))
        self._weights[condition] = 1.0

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """P0, P10, ..., P100 of the culture now, in Hz, shape (11,), or (readouts, 11)."""
        shares, places = ndtr(_SCORES + self._shift[:, None]), np.arange(len(self._hz))
        columns = zip(self._hz.reshape(len(self._hz), -1).T, shares, strict=True)
        # Same as `np.quantile`, which takes longer than a decision.
        values = np.array([np.interp(share * places[-1], places, np.sort(hz)) for hz, share in columns], np.float32)
        return values.reshape(*self._hz.shape[1:], N_PERCENTILES)

    def ranks(self, read_hz: Float64[np.ndarray, "*readouts"]) -> Float64[np.ndarray, " readouts"]:
        """The share of the culture's current responses below `read_hz`; ties count half."""
        columns = zip(self._hz.reshape(len(self._hz), -1).T, np.atleast_1d(read_hz), strict=True)
        among = np.array([ranks_among(np.sort(hz), np.array([x]))[0] for hz, x in columns])
        return np.asarray(ndtr(ndtri(among) - self._shift))

    @property
    def _shift(self) -> Float64[np.ndarray, " readouts"]:
        """How far the latest responses are above the newest, on the normal scale."""
        # Same as `np.average` and `np.clip`, which take longer than everything else here.
        weights = self._weights[:, None]
        above = (weights * (self._latest - self._means())).sum(axis=0) / weights.sum()
        return np.asarray(np.sqrt(2) * ndtri(np.minimum(np.maximum(0.5 + above, _LIMITS[0]), _LIMITS[1])))

    def _means(self) -> Float64[np.ndarray, "conditions readouts"]:
        return np.asarray(np.add.reduceat(self._ranks, self._first) / self._kept[:, None])


def kept_counts(recorded: AdjustedRanks) -> list[int]:
    """Number of kept responses to each condition: at most `NEWEST`, and the same share for all conditions."""
    share = min(1.0, NEWEST / max(map(len, recorded.ranks)))
    return [max(1, round(share * len(ranks))) for ranks in recorded.ranks]
