"""How fast a culture's responses change from recording to recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from animat.responses.responses import Responses

NEWEST = 3
"""Recordings that a drift is taken from: it slows down over hours."""
_BOOTSTRAPS = 100


class MedianDrift(NamedTuple):
    """The relative change of P50 a minute.

    Attributes:
        per_min: d ln(P50) / dt, negative where responses fall.
        error: its standard error, from responses drawn anew.
    """

    per_min: float
    error: float

    def minutes_to(self, change: float) -> tuple[float, float]:
        """How long P50 takes to change by a part of itself, and how long it does at least: at a rate two errors faster.

        A fall of 0.25 is one to 0.75, a rise one to 1.25.
        """

        def minutes(per_min: float) -> float:
            return math.inf if per_min == 0 else math.log1p(math.copysign(change, per_min)) / per_min

        return minutes(self.per_min), minutes(self.per_min + math.copysign(2 * self.error, self.per_min))


def median_drift(series: Sequence[Responses]) -> MedianDrift | None:
    """The drift of P50 over the newest recordings of a culture, by least squares of ln(P50) against their starts.

    With t_i the starts less their mean: the slope is sum(t_i ln(P50_i)) / sum(t_i^2), and its error
    sqrt(sum(t_i^2 e_i^2)) / sum(t_i^2), e_i the spread of ln(P50_i) as that recording's responses are drawn anew.

    Args:
        series: in the order of time. None is told of fewer than two, nor where a median is 0.
    """
    newest = series[-NEWEST:]
    if len(newest) < 2 or not all(each.median_rate_hz > 0 for each in newest):
        return None
    rng = np.random.default_rng(0)
    t = np.array([each.start_min for each in newest])
    t -= t.mean()
    logs = np.log([each.median_rate_hz for each in newest])
    # By condition, as they were presented.
    drawn = np.array([[each.bootstrapped(rng).median_rate_hz for _ in range(_BOOTSTRAPS)] for each in newest])
    errors = np.std(np.log(np.maximum(drawn, 1e-9)), axis=1)
    spread = float(t @ t)
    return MedianDrift(float(t @ logs) / spread, float(np.sqrt(np.sum((t * errors) ** 2))) / spread)
