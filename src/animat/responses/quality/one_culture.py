"""Whether the responses of several recordings are of one culture, read on the same channels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool

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
    if different := _different([responses.channels for responses in series if responses.channels is not None]):
        message = f"{different:,} of the {most:,} channels are not the same in all recordings: {advice}"
        yield Finding("other-channels", "warning", message, float(different))


def _different(tables: Sequence[Channels]) -> int:
    """The most channels of any of these tables that are not in all of the others."""
    in_all = [np.all([_is_in(table, other) for other in tables], axis=0) for table in tables]
    return max((int(np.count_nonzero(~each)) for each in in_all), default=0)


def _is_in(table: Channels, other: Channels) -> Bool[np.ndarray, " channels"]:
    """Whether each channel of a table is in another: by electrode if it is known of all, otherwise by label."""
    knows = all(np.all(each.electrode != UNKNOWN) for each in (table, other))
    one, two = (each.electrode if knows else each.label for each in (table, other))
    return np.isin(one, two)
