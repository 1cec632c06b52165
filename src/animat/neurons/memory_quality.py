"""Whether what a culture answers depends on what it answered just before."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from animat.recordings.findings import Finding

if TYPE_CHECKING:
    from animat.neurons.responses import Responses

CERTAIN = 4.0
"""Standard errors that the difference must be away from none."""


def memory_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on the culture's memory from one response to the next (`memory`), if there is some.

    For each condition, how often its non-burst responses pass P50 after a response that did, p1, and after one that did
    not, p0. The difference is averaged over conditions, each weighted by n1 n0 / (n1 + n0), so that what differs
    between conditions is not taken for memory; its standard error is that of independent responses.

    Args:
        responses: in the order of time.

    Source: the weights of Cochran 1954 (doi:10.2307/3001616) for differences of proportions in several tables.
    """
    median_hz = responses.median_rate_hz
    passes, after = responses.rate_hz >= median_hz, responses.before_hz >= median_hz
    weights, above, below = [], [], []
    for i in range(len(responses.conditions)):
        chosen = (responses.condition == i) & ~responses.is_burst
        n1, n0 = (int(np.count_nonzero(chosen & (after == did))) for did in (True, False))
        if n1 and n0:
            weights.append(n1 * n0 / (n1 + n0))
            above.append(float(passes[chosen & after].mean()))
            below.append(float(passes[chosen & ~after].mean()))
    if not weights:
        return
    w, p1, p0 = (np.array(each) for each in (weights, above, below))
    # Without memory both shares are the condition's own; n1 and n0 come into it by the weight alone.
    pooled = (p1 + p0) / 2
    error = math.sqrt(float(np.sum(w * pooled * (1 - pooled)))) / float(w.sum())
    after_one, after_none = (float(np.average(p, weights=w)) for p in (p1, p0))
    difference = after_one - after_none
    if abs(difference) <= CERTAIN * error:
        return
    yield Finding(
        "memory",
        "note",
        f"the culture remembers: after a response that passes P50 {100 * after_one:.0f} % of the next ones do, after "
        f"one that does not {100 * after_none:.0f} %, conditions apart; histograms know nothing of it, the memory "
        "simulator does",
        difference,
    )
