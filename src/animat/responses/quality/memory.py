"""Whether a culture's response depends on its previous response."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.responses.responses import Responses

CERTAIN = 4.0
"""Standard errors by which the difference must differ from 0."""
STRETCH = 250
"""Responses in a stretch of the recording; each stretch has its own median, as drift is not memory."""


def memory_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on the culture's memory from one response to the next (`memory`), if there is any.

    For each condition in each stretch of the recording, p1 is how often its non-burst responses pass the stretch's
    median after a response that did, and p0 after one that did not. The difference is averaged over all of these with
    the weights w = n1 n0 / (n1 + n0), so neither differences between conditions nor drift count as memory. Its standard
    error is that of independent responses, sqrt(sum w p (1 - p) n / (n - 1)) / sum w, with n = n1 + n0 and
    p = (n1 p1 + n0 p0) / n.

    Source: Cochran 1954 (doi:10.2307/3001616), differences of proportions in several tables; Mantel and Haenszel 1959
    (doi:10.1093/jnci/22.4.719), n / (n - 1), as there may be few responses in a table.
    """
    last_hz = responses.last_hz
    tables = []
    for stretch in np.array_split(np.arange(len(responses)), max(1, len(responses) // STRETCH)):
        usable = stretch[~responses.is_burst[stretch] & ~np.isnan(last_hz[stretch])]
        if not len(usable):
            continue
        median_hz = np.median(responses.rate_hz[usable])
        for condition in range(len(responses.conditions)):
            chosen = usable[responses.condition[usable] == condition]
            passes, after = responses.rate_hz[chosen] >= median_hz, last_hz[chosen] >= median_hz
            n1 = int(np.count_nonzero(after))
            if 0 < n1 < len(chosen):
                tables.append((n1, len(chosen) - n1, float(passes[after].mean()), float(passes[~after].mean())))
    if not tables:
        return
    n1s, n0s, p1, p0 = (np.array(column, np.float64) for column in zip(*tables, strict=True))
    weights = n1s * n0s / (n1s + n0s)
    pooled = (n1s * p1 + n0s * p0) / (n1s + n0s)
    unbiased = pooled * (1 - pooled) * (n1s + n0s) / (n1s + n0s - 1)
    error = math.sqrt(float(np.sum(weights * unbiased))) / float(weights.sum())
    after_one, after_none = (float(np.average(p, weights=weights)) for p in (p1, p0))
    if abs(after_one - after_none) <= CERTAIN * error:
        return
    message = (
        f"the culture remembers: {100 * after_one:.0f} % of the responses pass the median if the previous response "
        f"did, {100 * after_none:.0f} % if it did not (within conditions); histogram simulators ignore this, memory "
        f"simulators do not{' (fitted to recordings with --order mixed)' if responses.is_blocked else ''}"
    )
    yield Finding("memory", "note", message, after_one - after_none)
