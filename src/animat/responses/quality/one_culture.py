"""Whether the responses of several recordings are of one culture, read on the same channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from animat.errors import in_min
from animat.recordings.findings import Finding
from animat.recordings.recording import Channels
from animat.responses.responses import Responses
from animat.tables import UNKNOWN


def series_findings(series: Sequence[Responses]) -> Iterator[Finding]:
    """Findings on recordings of several cultures (`several-cultures`) or on other channels (`other-channels`)."""
    for one, other in combinations(series, 2):
        if one.culture and other.culture and (difference := one.culture.difference(other.culture)):
            of_one, of_other = difference
            message = (
                f"expected recordings of one culture, got one of {of_one} (at {in_min(one.start_min)}) and one of "
                f"{of_other} (at {in_min(other.start_min)}); leave out all but one culture's"
            )
            yield Finding("several-cultures", "refuse", message)
            break
    if not series:
        return
    n_channels = [responses.n_channels for responses in series]
    advice = "a response is the mean over all channels, so use recordings of one culture with the same channels"
    if (fewest := min(n_channels)) < (most := max(n_channels)):
        message = f"the recordings have {fewest:,} to {most:,} channels: {advice}"
        yield Finding("other-channels", "warning", message, float(most - fewest))
        return
    tables = [responses.channels for responses in series if responses.channels is not None]
    if different := max((_different(tables[0], table) for table in tables[1:]), default=0):
        message = f"{different:,} of the {most:,} channels are not the same in all recordings: {advice}"
        yield Finding("other-channels", "warning", message, float(different))


def _different(table: Channels, other: Channels) -> int:
    """How many channels of one table are not in another: by electrode if it is known of all, otherwise by label."""
    knows = all(np.all(each.electrode != UNKNOWN) for each in (table, other))
    one, two = (each.electrode if knows else each.label for each in (table, other))
    return int(np.count_nonzero(~np.isin(one, two)))
