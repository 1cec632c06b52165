"""The returns of a session's agents so far, with the predicted ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any

from animat.closed_loop.outline import Episode
from animat.watch.plain import mapped, number, text

_MOST_RETURNS = 200
"""Most returns drawn per agent: the last ones."""


def by_agent(names: Sequence[str], episodes: Sequence[Episode], predictions: Any) -> list[dict[str, Any]]:
    """For each agent: the number of whole episodes, their returns, and the mean with its 95 % interval.

    The names of the agents and the predictions are those of the session's header; what is no prediction is left out.
    """
    predicted = {}
    for name, row in mapped(predictions).items():
        values = [number(mapped(row).get(key)) for key in ("mean", "low", "high")]
        if None not in values:
            predicted[text(name)] = values
    returns_of: dict[str, list[float]] = {text(name): [] for name in names}
    for episode in episodes:
        returns = returns_of.setdefault(text(episode.agent), [])
        if episode.is_whole and number(episode.total) is not None:
            returns.append(episode.total)
    return [
        {
            "name": name,
            "n": len(returns),
            "returns": returns[-_MOST_RETURNS:],
            "mean": number(fmean(returns)) if returns else None,
            "half": number(_half_width(returns)),
            "predicted": predicted.get(name),
        }
        for name, returns in returns_of.items()
    ]


def _half_width(returns: Sequence[float]) -> float | None:
    """Half the width of the 95 % interval of a mean, by Student's t; None if returns do not show how they vary."""
    if len(set(returns)) < 2:
        return None
    from scipy.special import stdtrit

    return float(stdtrit(len(returns) - 1, 0.975)) * stdev(returns) / math.sqrt(len(returns))
