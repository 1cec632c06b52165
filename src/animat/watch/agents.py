"""The returns of a session's agents so far, with the predicted ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from animat.closed_loop.outline import Episode
from animat.watch.plain import mapped, number, text

_MOST_RETURNS = 200
"""Most returns drawn per agent: the last ones."""


def by_agent(episodes: Sequence[Episode], header: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each agent: the number of whole episodes, their returns, and the mean with its 95 % interval.

    The header is that of the session's log, with or without a prediction.
    """
    predicted = _predicted(header)
    returns_of: dict[str, list[float]] = {name: [] for name in predicted}
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
    """Half the width of the 95 % interval of a mean, by Student's t; None for fewer than two returns."""
    if len(returns) < 2:
        return None
    from scipy.special import stdtrit

    return float(stdtrit(len(returns) - 1, 0.975)) * stdev(returns) / math.sqrt(len(returns))


def _predicted(header: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """Mean and interval of each agent; anything that is not a prediction is left out."""
    rows = {text(name): mapped(row) for name, row in mapped(header.get("predicted")).items()}
    predicted = {name: [number(row.get(key)) for key in ("mean", "low", "high")] for name, row in rows.items()}
    return {name: values for name, values in predicted.items() if None not in values}
