"""How a culture's responses drift: within a recording, and from one recording to the next."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from animat.recordings.findings import Finding
from animat.responses.responses import Responses

LARGE = 0.25
"""Change over the recording, relative to the mean response, above which there is a warning."""
CERTAIN = 4.0
"""Standard errors by which the change must differ from 0."""
_MOST = 2.0
FEWEST = 20
NEWEST = 3
"""Recordings from which the drift between them is estimated: it slows down over hours."""
_BOOTSTRAPS = 100


def drift_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on drift within the recording (`drift`), if there is any.

    Least squares of x / m_c = 1 + s t over the non-burst responses, with m_c the mean of the response's condition and t
    its time relative to the mean time of its condition, in units of the time over which the condition was presented. So
    differences between conditions, which a blocked protocol presents one after the other, do not count as drift. s is
    the relative change from a condition's first stimuli to its last; its standard error comes from the residuals.
    Without times, the order of rows is used.
    """
    if len(responses) < FEWEST:
        return
    time_s = np.arange(float(len(responses))) if responses.time_s is None else responses.time_s
    times, relative = [np.empty(0)], [np.empty(0)]
    for i in range(len(responses.conditions)):
        presented_s, is_read = time_s[responses.condition == i], ~responses.is_burst[responses.condition == i]
        rate_hz = responses.rates_of(i)
        if len(rate_hz) < 3 or rate_hz.mean() <= 0 or (of_condition_s := float(np.ptp(presented_s))) <= 0:
            continue
        time = presented_s[is_read] / of_condition_s
        times.append(time - time.mean())
        relative.append(rate_hz / float(rate_hz.mean()) - 1)
    t, x = np.concatenate(times), np.concatenate(relative)
    spread = float(t @ t)
    if len(t) < FEWEST or spread <= 0:
        return
    slope = float(t @ x) / spread
    # Less one for the slope and one for the mean of each condition: `times` has one more entry than conditions.
    freedom = len(t) - len(times)
    error = math.sqrt(float(np.sum((x - slope * t) ** 2)) / freedom / spread)
    if abs(slope) <= CERTAIN * error:
        return
    span = "in the order of the rows" if responses.time_s is None else f"recording: {np.ptp(time_s) / 60:.1f} min"
    # A straight line cannot fall by more, as responses are not below 0: the change was sudden, for example.
    by = f"{100 * abs(slope):.0f} % of their mean (+- {100 * error:.0f} %)"
    by = by if abs(slope) <= _MOST else f"more than {100 * _MOST:.0f} % of their mean"
    message = (
        f"responses {'rise' if slope > 0 else 'fall'} by {by} from a condition's first stimuli to its last ({span})"
    )
    if abs(slope) > _MOST:
        message += f", as if they {'began' if slope > 0 else 'stopped'} in between"
    large = abs(slope) > LARGE
    if large:
        message += (
            ": one simulator represents a culture that changes; record for a shorter time or wait until it has settled"
        )
        if responses.presentation is None or responses.presentation.order != "mixed":
            message += ", or present conditions mixed, so that drift is not taken for a difference"
    yield Finding("drift", "warning" if large else "note", message, slope)


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
    recording's responses. None if all start at the same minute, or if a median is 0.
    """
    newest = series[-NEWEST:]
    if len({each.start_min for each in newest}) < 2 or not all(each.median_rate_hz > 0 for each in newest):
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
