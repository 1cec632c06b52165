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

    Args:
        responses: with their times; without times, the order of rows is used.
    """
    if len(responses) < FEWEST:
        return
    time_s = np.arange(float(len(responses))) if responses.time_s is None else responses.time_s
    times, relative = [], []
    span_s = float(time_s[-1] - time_s[0])
    if span_s <= 0:
        return
    for i in range(len(responses.conditions)):
        chosen = (responses.condition == i) & ~responses.is_burst
        mean_hz = float(responses.rate_hz[chosen].mean()) if chosen.any() else 0.0
        if np.count_nonzero(chosen) < 3 or mean_hz <= 0:
            continue
        presented_s = time_s[responses.condition == i]
        of_condition_s = float(presented_s[-1] - presented_s[0])
        if of_condition_s <= 0:
            continue
        time = time_s[chosen] / of_condition_s
        times.append(time - time.mean())
        relative.append(responses.rate_hz[chosen] / mean_hz - 1)
    if not times:
        return
    t, x = np.concatenate(times), np.concatenate(relative)
    spread = float(t @ t)
    if len(t) < FEWEST or spread <= 0:
        return
    slope = float(t @ x) / spread
    error = math.sqrt(float(np.sum((x - slope * t) ** 2)) / max(len(t) - 2, 1) / spread)
    if abs(slope) <= CERTAIN * error:
        return
    large = abs(slope) > LARGE
    is_mixed = responses.presentation is not None and responses.presentation.order == "mixed"
    message = (
        f"responses {'rise' if slope > 0 else 'fall'} by {100 * abs(slope):.0f} % of their mean "
        f"(+- {100 * error:.0f} %) from a condition's first stimuli to its last "
        + ("(in the order of the rows)" if responses.time_s is None else f"(recording: {span_s / 60:.1f} min)")
        + (
            ": one simulator represents a culture that changes; record for a shorter time or wait until it has settled"
            + ("" if is_mixed else ", or present conditions mixed, so that drift is not taken for a difference")
            if large
            else ""
        )
    )
    yield Finding("drift", "warning" if large else "note", message, slope)
