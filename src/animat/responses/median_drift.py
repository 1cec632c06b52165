"""The drift of a culture's responses from recording to recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from animat.responses.responses import Responses

NEWEST = 3
"""Recordings from which the drift is estimated: it slows down over hours."""
_BOOTSTRAPS = 100


class MedianDrift(NamedTuple):
    """The relative change of P50 per minute.

    Attributes:
        per_min: d ln(P50) / dt, negative if responses fall.
        error: its standard error, by bootstrap of the responses.
    """

    per_min: float
    error: float

    def minutes_to(self, change: float) -> tuple[float, float]:
        """Minutes until P50 has changed by a fraction of itself; and the same at a rate two errors faster.

        A fall of 0.25 is to 0.75, a rise to 1.25.
        """

        def minutes(per_min: float) -> float:
            return math.inf if per_min == 0 else math.log1p(math.copysign(change, per_min)) / per_min

        return minutes(self.per_min), minutes(self.per_min + math.copysign(2 * self.error, self.per_min))


def median_drift(series: Sequence[Responses]) -> MedianDrift | None:
    """The drift of P50 over the newest recordings of a culture, by least squares of ln(P50) against their starts.

    With t_i the starts less their mean, the slope is sum(t_i ln(P50_i)) / sum(t_i^2), and its error is
    sqrt(sum(t_i^2 e_i^2)) / sum(t_i^2), e_i the standard deviation of ln(P50_i) over bootstrap samples of that
    recording's responses. None for fewer than two recordings, or if a median is 0.
    """
    newest = series[-NEWEST:]
    if len(newest) < 2 or not all(each.median_rate_hz > 0 for each in newest):
        return None
    rng = np.random.default_rng(0)
    t = np.array([each.start_min for each in newest])
    t -= t.mean()
    logs = np.log([each.median_rate_hz for each in newest])
    # Resampled within conditions, as their numbers are fixed by the protocol.
    drawn = np.array([[each.bootstrapped(rng).median_rate_hz for _ in range(_BOOTSTRAPS)] for each in newest])
    errors = np.std(np.log(np.maximum(drawn, 1e-9)), axis=1)
    spread = float(t @ t)
    return MedianDrift(float(t @ logs) / spread, float(np.sqrt(np.sum((t * errors) ** 2))) / spread)
