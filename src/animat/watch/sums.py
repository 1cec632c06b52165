"""Totals, faults and returns of a session so far, counted in slices while it is watched."""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import Any

from animat.closed_loop.outline import Episode, Outline
from animat.watch.plain import mapped, number, numbers, text
from animat.watch.tail import Tail

_MOST_FAULTS = 50
"""Most faults shown."""
_MOST_THRESHOLDS = 20_000
"""Most changes of thresholds kept; beyond it every second one is dropped, repeatedly."""
_MOST_RETURNS = 200
"""Most returns drawn per agent: the last ones."""
_LOOKS = 64
"""Records between two looks at the clock."""

PercentilesSince = tuple[float, list[float | None]]
"""When thresholds changed, on the session's clock, and the percentiles in Hz since then."""


class Sums:
    """The totals of a log's records counted so far.

    Attributes:
        totals: for each record the return of its episode so far; NaN without a tick.
        wall_s: of the last tick, on the program's clock; None before the first.
        faults: the last ones: when, on the session's clock, and what happened.
        percentiles: the thresholds since each change.
        strange: number of records that are not understood.
    """

    def __init__(self, tail: Tail) -> None:
        self._tail = tail
        self.outline = Outline()
        self.counted = self.strange = self.n_faults = 0
        self.totals = array("d")
        self.wall_s: float | None = None
        self.on_electrode: Counter[int] = Counter()
        self.faults: list[tuple[float | None, str]] = []
        self.percentiles: list[PercentilesSince] = []
        self._episode, self._total, self._end_s = -1, 0.0, 0.0

    def go_on(self, within_s: float) -> None:
        """Count the records that were added, for at most `within_s`."""
        until_s = time.monotonic() + within_s
        while self.counted < len(self._tail):
            record = self._tail.peek(self.counted)
            if record is None:
                return
            try:
                self.totals.append(self._add(record))
            except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError):
                self.totals.append(math.nan)
                self.strange += 1
            self.counted += 1
            if self.counted % _LOOKS == 0 and time.monotonic() > until_s:
                return

    @property
    def share(self) -> float:
        """The share of the log's records that are counted."""
        return self.counted / max(1, len(self._tail))

    def _add(self, fields: dict[str, Any]) -> float:
        """Count a record; returns the total of its episode."""
        self.outline.add(fields)
        kind, tick = fields["kind"], fields.get("tick")
        if kind == "seen":
            self._end_s = float(fields["start_s"]) + float(fields["duration_s"])
            for _, _, _, electrodes in fields["stimuli"]:
                self.on_electrode.update(electrodes)
        elif kind == "event":
            self.n_faults += 1
            fault = number(fields.get("asked_at_s")), f"{text(fields['what'])}: {text(fields['message'])}"
            self.faults = [*self.faults, fault][-_MOST_FAULTS:]
        # Older sessions have separate records for them.
        if "percentiles_hz" in fields:
            self.percentiles.append((self._end_s, first_readout(fields["percentiles_hz"])))
            if len(self.percentiles) > _MOST_THRESHOLDS:
                del self.percentiles[1::2]
        if kind != "seen" or not tick:
            return math.nan
        if tick["episode"] != self._episode:
            self._episode, self._total = tick["episode"], 0.0
        self._total += tick["reward"] or 0.0
        self.wall_s = number(tick.get("wall_s"))
        return self._total


def first_readout(percentiles: Any) -> list[float | None]:
    """The percentiles of the first or only readout."""
    return numbers(percentiles[0] if percentiles and isinstance(percentiles[0], list) else percentiles)


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
