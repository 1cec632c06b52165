"""Whether a culture responds at the end of a recording as it did at the beginning."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.responses.responses import Responses

LARGE = 0.25
"""Change over the recording, relative to the mean response, above which there is a warning."""
CERTAIN = 4.0
"""Standard errors by which the change must differ from 0."""
FEWEST = 20


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
    # The mean of each condition is estimated too (`times` has one more entry than there are of these).
    freedom = len(t) - len(times)
    error = math.sqrt(float(np.sum((x - slope * t) ** 2)) / freedom / spread)
    if abs(slope) <= CERTAIN * error:
        return
    span = "in the order of the rows" if responses.time_s is None else f"recording: {np.ptp(time_s) / 60:.1f} min"
    message = (
        f"responses {'rise' if slope > 0 else 'fall'} by {100 * abs(slope):.0f} % of their mean "
        f"(+- {100 * error:.0f} %) from a condition's first stimuli to its last ({span})"
    )
    large = abs(slope) > LARGE
    if large:
        message += (
            ": one simulator represents a culture that changes; record for a shorter time or wait until it has settled"
        )
        if responses.presentation is None or responses.presentation.order != "mixed":
            message += ", or present conditions mixed, so that drift is not taken for a difference"
    yield Finding("drift", "warning" if large else "note", message, slope)
