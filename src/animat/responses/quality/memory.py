"""Whether a culture's response depends on its previous response."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.responses.quality.within_conditions import compare_passing
from animat.responses.responses import Responses


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
