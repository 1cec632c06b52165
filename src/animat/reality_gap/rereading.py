"""A recording's responses as a loop with adaptive thresholds would have read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from animat.closed_loop.adaptive import AdaptiveThresholds, kept_counts
from animat.neurons.history import Ranked
from animat.neurons.history_tracker import AdjustedRanks, HistoryState
from animat.responses.responses import Responses


def reread(responses: Responses, adjusted: AdjustedRanks) -> Responses:
    """Replace each response by the recording's quantile of the rank that adaptive thresholds give it at its time.

    Responses rise and fall together, over seconds and minutes. Adaptive thresholds follow this, so it disturbs the
    controller less. A simulator draws responses from all times, and takes all of this for chance. So the recording is
    read again, by thresholds that begin with the first responses of each condition and adapt after each trial
    (`animat.closed_loop.adaptive`). A simulator of these responses takes only the rest for chance.

    Args:
        responses: of a recording that is not in blocks, where condition and time would be confounded.
        adjusted: of these responses.

    Returns:
        The responses with x read again, for all channels or for readouts; nothing else changes.
    """
    first = [slice(kept) for kept in kept_counts(adjusted)]
    first_hz, first_ranks = (
        tuple(each[of] for each, of in zip(values, first, strict=True))
        for values in (adjusted.responses_hz, adjusted.ranks)
    )
    thresholds = AdaptiveThresholds(replace(adjusted, responses_hz=first_hz, ranks=first_ranks))
    read_hz, ranks = responses.read_hz, []
    histories = Ranked(responses).states(adjusted.remembering.memory)
    trials = zip(responses.condition, read_hz, histories, responses.is_burst, strict=True)
    for condition, x_hz, history, is_burst in trials:
        ranks.append(thresholds.ranks(x_hz))
        if not is_burst:
            thresholds.add(int(condition), HistoryState(*history), x_hz)
    of_readouts = zip(np.atleast_2d(adjusted.sorted_hz), np.array(ranks).T, strict=True)
    reread_hz = np.stack([np.quantile(sorted_hz, rank) for sorted_hz, rank in of_readouts], axis=-1)
    reread_hz = reread_hz.reshape(read_hz.shape)
    if responses.readout_hz is not None:
        return replace(responses, readout_hz=reread_hz)
    presented, place = responses.presentations
    all_hz = presented.rate_hz.copy()
    all_hz[place] = reread_hz
    return replace(responses, rate_hz=reread_hz, presented=replace(presented, rate_hz=all_hz), place=place)
