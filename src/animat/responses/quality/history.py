"""Whether a culture's response depends on what came before: on its last response, or on a repeated condition."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64

from animat.recordings.findings import Finding
from animat.responses.responses import Responses

CERTAIN = 4.0
"""Standard errors by which a difference must differ from 0."""
STRETCH = 250
"""Responses in a stretch of the recording; each stretch has its own median, as drift is not a difference."""
LEAST_OF_REPETITION = 0.15
"""Least difference in how often the median is passed: on virtual cultures it is at most 0.06 with frequencies and 0.14
with corners, for which predictions hold, and at least 0.24 with similar patterns, for which they do not."""


class Passing(NamedTuple):
    """How often the responses of a group, and all others, pass the median; `error`: of the difference."""

    group: float
    others: float
    error: float

    @property
    def difference(self) -> float:
        """How much more often those of the group pass."""
        return self.group - self.others

    @property
    def is_certain(self) -> bool:
        """Whether the difference is more than chance."""
        return abs(self.difference) > CERTAIN * self.error


def compare_passing(
    responses: Responses,
    is_usable: Bool[np.ndarray, " responses"],
    in_group: Callable[[Int64[np.ndarray, " rows"], float], Bool[np.ndarray, " rows"]],
) -> Passing | None:
    """Compare a group of non-burst responses with all others, within conditions and stretches; None without both.

    For each condition in each stretch of the recording, p1 is how often the group's responses pass the stretch's
    median, and p0 how often the others do. The difference is averaged over all of these with the weights
    w = n1 n0 / (n1 + n0), so neither differences between conditions nor drift count. Its standard error is that of
    independent responses, sqrt(sum w p (1 - p) n / (n - 1)) / sum w, with n = n1 + n0 and p = (n1 p1 + n0 p0) / n.

    `in_group` says which of some rows are in the group, given the median of their stretch, Hz.

    Source: Cochran 1954 (doi:10.2307/3001616), differences of proportions in several tables; Mantel and Haenszel 1959
    (doi:10.1093/jnci/22.4.719), n / (n - 1), as there may be few responses in a table.
    """
    tables = []
    for stretch in np.array_split(np.arange(len(responses)), max(1, len(responses) // STRETCH)):
        usable = stretch[~responses.is_burst[stretch] & is_usable[stretch]]
        if not len(usable):
            continue
        median_hz = float(np.median(responses.rate_hz[usable]))
        for condition in np.unique(responses.condition[usable]).tolist():
            chosen = usable[responses.condition[usable] == condition]
            passes, group = responses.rate_hz[chosen] >= median_hz, in_group(chosen, median_hz)
            n1 = int(np.count_nonzero(group))
            if 0 < n1 < len(chosen):
                tables.append((n1, len(chosen) - n1, float(passes[group].mean()), float(passes[~group].mean())))
    if not tables:
        return None
    n1s, n0s, p1, p0 = (np.array(column, np.float64) for column in zip(*tables, strict=True))
    n = n1s + n0s
    weights, pooled = n1s * n0s / n, (n1s * p1 + n0s * p0) / n
    variances = pooled * (1 - pooled) * n / (n - 1)
    error = math.sqrt(float(np.sum(weights * variances))) / float(weights.sum())
    return Passing(float(np.average(p1, weights=weights)), float(np.average(p0, weights=weights)), error)


def memory_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on the culture's memory from one response to the next (`memory`), if there is any.

    Responses after one that passed the median are compared with those after one that did not.
    """
    last_hz = responses.last_hz
    after_one = compare_passing(responses, ~np.isnan(last_hz), lambda rows, median_hz: last_hz[rows] >= median_hz)
    if after_one is None or not after_one.is_certain:
        return
    message = (
        f"the culture remembers: {100 * after_one.group:.0f} % of the responses pass the median if the previous "
        f"response did, {100 * after_one.others:.0f} % if it did not (within conditions); histogram simulators ignore "
        f"this, memory simulators do not{' (fitted to recordings with --order mixed)' if responses.is_blocked else ''}"
    )
    yield Finding("memory", "note", message, after_one.difference)


def repetition_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on responses to a condition that the trial before had too (`repetition`), if they are different.

    They are compared with those after another condition; responses after silence are left out. Memory of the previous
    response alone makes hardly a difference: repeated conditions have both small and large responses.
    """
    presented, place = responses.presentations
    repeats = repetitions(responses)
    repeated = compare_passing(responses, ~presented.is_rested[place], lambda rows, _: repeats[rows] > 0)
    if repeated is None or not repeated.is_certain or abs(repeated.difference) < LEAST_OF_REPETITION:
        return
    message = (
        f"responses depend on repetition: {100 * repeated.group:.0f} % pass the median where the trial before had the "
        f"same condition, {100 * repeated.others:.0f} % where it had another (within conditions); simulators know only "
        "a part of this, and policies repeat conditions often, so predicted returns may be wrong: use conditions that "
        "differ more, as in frequency or in the number of electrodes"
    )
    yield Finding("repetition", "warning", message, repeated.difference)


def repetitions(responses: Responses) -> Int64[np.ndarray, " responses"]:
    """How many trials in a row, directly before each response's own and without silence, had the same condition."""
    presented, place = responses.presentations
    rows = np.arange(len(presented.condition))
    begins = presented.is_rested | np.concatenate([[True], np.diff(presented.condition) != 0])[: len(rows)]
    return np.asarray((rows - np.maximum.accumulate(np.where(begins, rows, 0)))[place])
