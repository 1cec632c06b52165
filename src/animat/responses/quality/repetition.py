"""Whether a culture's response depends on how often the same condition has just been presented."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int64

from animat.recordings.findings import Finding
from animat.responses.quality.within_conditions import compare_passing
from animat.responses.responses import Responses

LEAST = 0.15
"""Least difference in how often the median is passed.

On virtual cultures it is at most 0.06 with frequencies and 0.14 with corners, for which predictions hold, and at least
0.24 with similar patterns, for which they do not.
"""


def repetition_findings(responses: Responses) -> Iterator[Finding]:
    """A finding on responses to a condition that the trial before had too (`repetition`), if they are different.

    They are compared with those after another condition; responses after silence are left out. Memory of the previous
    response alone makes hardly a difference: repeated conditions have both small and large responses.
    """
    presented, place = responses.presentations
    repeats = repetitions(responses)
    repeated = compare_passing(responses, ~presented.is_rested[place], lambda rows, _: repeats[rows] > 0)
    if repeated is None or not repeated.is_certain or abs(repeated.difference) < LEAST:
        return
    message = (
        f"responses depend on repetition: {100 * repeated.group:.0f} % pass the median where the trial before had the "
        f"same condition, {100 * repeated.others:.0f} % where it had another (within conditions); simulators ignore "
        "this, but policies repeat conditions often, so predicted returns may be wrong: use conditions that differ "
        "more, as in frequency or in the number of electrodes"
    )
    yield Finding("repetition", "warning", message, repeated.difference)


def repetitions(responses: Responses) -> Int64[np.ndarray, " responses"]:
    """How many trials in a row, directly before each response's own and without silence, had the same condition."""
    presented, place = responses.presentations
    rows = np.arange(len(presented.condition))
    begins = presented.is_rested | np.concatenate([[True], np.diff(presented.condition) != 0])[: len(rows)]
    return np.asarray((rows - np.maximum.accumulate(np.where(begins, rows, 0)))[place])
