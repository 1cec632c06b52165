"""A recording's responses as a loop with adaptive thresholds would have read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from animat.closed_loop.adaptive import AdaptiveThresholds, kept_of
from animat.neurons.adjusted_rank import AdjustedRanks
from animat.neurons.history import Ranked
from animat.neurons.history_tracker import HistoryState
from animat.responses.responses import Responses


def as_read(responses: Responses, adjusted: AdjustedRanks) -> Responses:
    """Each response at the recording's quantile of the rank that it has for adaptive thresholds at its time.

    Responses rise and fall together, over seconds and minutes. Thresholds that adapt follow that, and it disturbs the
    controller less. A simulator draws responses of all times, and takes all of it for chance. So a recording is read
    once more, by thresholds that begin with the first responses of each condition and adapt after each trial
    (`animat.closed_loop.adaptive`). A simulator of what they read takes only the rest for chance.

    Args:
        responses: of a recording that is not in blocks, where conditions and times are one.
        adjusted: of these responses.

    Returns:
        x of what is read, all channels or readouts; the rest is as it was.
    """
    first = [slice(kept) for kept in kept_of(adjusted)]
    first_hz, first_ranks = (
        tuple(each[of] for each, of in zip(values, first, strict=True))
        for values in (adjusted.responses_hz, adjusted.ranks)
    )
    thresholds = AdaptiveThresholds(replace(adjusted, responses_hz=first_hz, ranks=first_ranks))
    read_hz, found = responses.read_hz, []
    came = Ranked(responses).states(adjusted.remembering.memory)
    for condition, x_hz, history, is_burst in zip(responses.condition, read_hz, came, responses.is_burst, strict=True):
        found.append(thresholds.ranks(x_hz))
        if not is_burst:
            thresholds.add(int(condition), HistoryState(*history), x_hz)
    each = zip(np.atleast_2d(adjusted.sorted_hz), np.array(found).T, strict=True)
    now_hz = np.stack([np.quantile(own_hz, ranks) for own_hz, ranks in each], axis=-1).reshape(read_hz.shape)
    if responses.readout_hz is not None:
        return replace(responses, readout_hz=now_hz)
    presented, place = responses.presentations
    all_hz = presented.rate_hz.copy()
    all_hz[place] = now_hz
    return replace(responses, rate_hz=now_hz, presented=replace(presented, rate_hz=all_hz), place=place)
