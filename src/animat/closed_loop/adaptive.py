"""Adaptive thresholds: the percentiles of a culture as it is now, not of a past hour."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy.special import ndtr, ndtri

from animat.coding.mapping import N_PERCENTILES
from animat.neurons.expected_rank import ExpectedRank
from animat.neurons.remembering import Remembered
from animat.responses.extraction import SILENCE_S

import os
FAST = int(os.environ.get("CNT", "10"))
SLOW = int(os.environ.get("SLOW", "100"))
SLOPE = 2 * np.sqrt(np.pi)
COUNTED = 100
"""Of a condition: as many as the paper's recording holds."""
_SCORES = ndtri(np.linspace(0.0, 1.0, N_PERCENTILES))
_BETWEEN = (0.01, 0.99)
"""The mean rank of a culture that answers nothing any more, or everything, would move thresholds without end."""


class AdaptiveThresholds:
    def __init__(self, expected: ExpectedRank) -> None:
        self._expected = expected
        n_conditions, n_readouts = expected.levels.shape
        self._counts = np.zeros(n_conditions)
        self._drift = np.zeros(n_readouts)
        self._above = np.zeros((n_conditions, n_readouts))
        self._remembered = Remembered()

    @property
    def seen(self) -> int:
        return int(self._counts.sum())

    def take_in(self, condition, read_hz, rate_hz, first_s, at_s, *, is_burst, counts) -> None:
        expected, remembering = self._expected, self._expected.remembering
        is_rested = first_s - self._remembered.at_s > SILENCE_S
        came = remembering.when(self._remembered, at_s, is_rested=bool(is_rested))
        if counts and not is_burst:
            rank = _moved(expected.rank(np.asarray(read_hz)), -self._drift)
            beyond = rank - expected.at(came, condition)
            self._counts[condition] += 1
            n = self._counts[condition]
            self._above[condition] += (beyond - self._above[condition]) / min(n, FAST)
            self._drift += SLOPE * beyond / (len(self._counts) * min(n, SLOW))
        of_all = _moved(remembering.rank(rate_hz), -self._drift.mean())
        self._remembered = remembering.after(came, condition, float(of_all), is_burst=is_burst)

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """P0, P10, ..., P100 of the culture now, in Hz, shape (11,), or (readouts, 11)."""
        mean_rank = np.clip(0.5 + self._above.mean(axis=0), *_BETWEEN)
        shares = ndtr(_SCORES + (self._drift + np.sqrt(2) * ndtri(mean_rank))[:, None])
        sorted_hz = self._expected.sorted_hz
        # Between two responses it is a straight line, as `np.quantile` has it, which would sort them again.
        below, part = np.divmod(shares * (sorted_hz.shape[-1] - 1), 1.0)
        low_hz, high_hz = (
            np.take_along_axis(np.atleast_2d(sorted_hz), np.minimum(at, sorted_hz.shape[-1] - 1).astype(int), axis=1)
            for at in (below, below + 1)
        )
        moved_hz = low_hz + part * (high_hz - low_hz)
        return np.asarray(moved_hz, np.float32).reshape(*sorted_hz.shape[:-1], N_PERCENTILES)


def _moved(rank, by):
    return ndtr(ndtri(np.clip(rank, 1e-4, 1 - 1e-4)) + by)
