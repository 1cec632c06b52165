"""The returns of a session's agents so far, beside what was predicted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from animat.closed_loop.outline import Episode
from animat.watch.plain import mapped, number, text

_MOST_RETURNS = 200
"""Of each agent that are drawn, the last ones."""


def by_agent(episodes: Sequence[Episode], header: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of each agent: how many episodes came to their end, their returns and mean with its 95 % interval, as it narrows.

    The header is that of the session's log, with a prediction or without.
    """
    predicted = _predicted(header)
    returns: dict[str, list[float]] = {name: [] for name in predicted}
    for episode in episodes:
        of = returns.setdefault(text(episode.agent), [])
        if episode.is_whole and number(episode.total) is not None:
            of.append(episode.total)
    return [
        {
            "name": name,
            "n": len(of),
            "returns": of[-_MOST_RETURNS:],
            "mean": number(fmean(of)) if of else None,
            "half": number(_half_width(of)),
            "predicted": predicted.get(name),
        }
        for name, of in returns.items()
    ]


def _half_width(returns: Sequence[float]) -> float | None:
    """Half of the 95 % interval of a mean, Student's; None of fewer than two."""
    if len(returns) < 2:
        return None
    from scipy.special import stdtrit

    return float(stdtrit(len(returns) - 1, 0.975)) * stdev(returns) / math.sqrt(len(returns))


def _predicted(header: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """Mean and interval; of what is no prediction nothing."""
    read = {text(name): mapped(of) for name, of in mapped(header.get("predicted")).items()}
    found = {name: [number(of.get(each)) for each in ("mean", "low", "high")] for name, of in read.items()}
    return {name: of for name, of in found.items() if None not in of}
