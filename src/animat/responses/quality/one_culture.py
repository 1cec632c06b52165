"""Whether the responses of several recordings can be used together: of one culture, recorded and read alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

import numpy as np

from animat.errors import in_min
from animat.recordings.findings import Finding
from animat.recordings.recording import Channels
from animat.responses.condition import Condition, stimulus_mismatch
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.tables import UNKNOWN


def series_mismatch(series: Sequence[Responses]) -> str | None:
    """How recordings, in the order of time, differ in what a timeline must share, or which share a minute, if any."""
    # First, as the other messages tell recordings apart by their minutes.
    for one, other in pairwise(series):
        if one.start_min == other.start_min:
            return f"start_min: expected recordings at different minutes, got two at {in_min(one.start_min)}"
    first = series[0]
    for other in series[1:]:
        for name in ("conditions", "window_ms", "presentation", "readouts"):
            if getattr(other, name) != getattr(first, name):
                return (
                    f"{name}: expected the same in all recordings, got {_words(getattr(first, name))} at "
                    f"{in_min(first.start_min)} and {_words(getattr(other, name))} at {in_min(other.start_min)}"
                )
        if "pattern" in (first.by or "") and (different := _differently_named(first, other)):
            return f"patterns: expected the same names in all recordings, got {different}"
        if others := stimulus_mismatch(first.conditions, other.conditions):
            return f"conditions: {others} at {in_min(other.start_min)}"
    return None


def _differently_named(one: Responses, other: Responses) -> str | None:
    """A pattern's number that has another name in another recording, as each file numbers its names by itself."""
    ours, theirs = one.pattern_names, other.pattern_names
    numbers = sorted(ours.keys() & theirs.keys() if ours and theirs else ours.keys() | theirs.keys())
    different = [number for number in numbers if ours.get(number) != theirs.get(number)]
    if not different:
        return None
    names = (f"{each.pattern_names.get(different[0], 'none')!r} at {in_min(each.start_min)}" for each in (one, other))
    return f"{' and '.join(names)} for pattern {different[0]}"


def unlike_finding(series: Sequence[Responses]) -> Iterator[Finding]:
    """The finding on recordings with stimuli that cannot be in one timeline (`not-a-series`), in any order."""
    stimulated = sorted((each for each in series if len(each)), key=lambda responses: responses.start_min)
    if stimulated and (mismatch := series_mismatch(stimulated)):
        yield Finding("not-a-series", "warning", f"animat train refuses these recordings together: {mismatch}")


def series_findings(series: Sequence[Responses]) -> Iterator[Finding]:
    """Findings on recordings of several cultures (`several-cultures`) or on other channels (`other-channels`)."""
    for one, other in combinations(series, 2):
        if one.culture and other.culture and (difference := one.culture.difference(other.culture)):
            of_one, of_other = difference
            message = (
                f"expected recordings of one culture, got {of_one} (at {in_min(one.start_min)}) and {of_other} (at "
                f"{in_min(other.start_min)}); leave out all but one culture's"
            )
            yield Finding("several-cultures", "refuse", message)
            break
    known = [each.recording for each in series if each.recording is not None]
    for one_of, next_of in pairwise(sorted(known, key=lambda recording: recording.start_min)):
        over_s = one_of.duration_s - 60 * (next_of.start_min - one_of.start_min)
        if 0.01 * one_of.duration_s < over_s < one_of.duration_s:
            at = f"that at {in_min(one_of.start_min)} lasts {over_s:.3g} s longer than to the next"
            message = f"recordings overlap in time: {at}, at {in_min(next_of.start_min)}: correct start_min"
            yield Finding("recordings-overlap", "warning", message, over_s)
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
    """The most channels of any table that are not in all: by electrode if it is known of all, otherwise by label."""
    knows = all(np.all(table.electrode != UNKNOWN) for table in tables)
    names = [table.electrode if knows else table.label for table in tables]
    in_all = set.intersection(*(set(each.tolist()) for each in names)) if names else set()
    return max((sum(name not in in_all for name in each.tolist()) for each in names), default=0)


def _words(value: object) -> str:
    if isinstance(value, tuple) and value and isinstance(value[0], Condition):
        return ", ".join(condition.label for condition in value)
    return ", ".join(value.names) if isinstance(value, Readouts) else "unknown" if value is None else str(value)
