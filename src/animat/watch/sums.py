"""What a session came to so far, counted a slice at a time while it is looked at: totals, episodes, faults."""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from typing import Any

from animat.closed_loop.outline import Outline
from animat.watch.plain import number, numbers, text, whole
from animat.watch.tail import Tail

_MOST_TOLD = 50
"""Faults that are told."""
_MOST_THRESHOLDS = 20_000
"""Of a session's; of a longer one every second is kept, and so on."""
_LOOKS = 64
"""Records between two looks at the clock."""


class Sums:
    """The totals of a log's records, as far as they were counted.

    Attributes:
        counted: of the log's records.
        outline: what they came to.
        totals: of each record the return of its episode so far; NaN without a tick.
        on_electrode: pulses on each.
        faults: the last ones: when, on the session's clock, and what happened.
        n_faults: how many there were.
        percentiles: when thresholds were set anew, and the percentiles in Hz since then.
        strange: records that say nothing that is known.
    """

    def __init__(self, tail: Tail) -> None:
        self._tail = tail
        self.outline = Outline()
        self.counted = self.strange = self.n_faults = 0
        self.totals = array("d")
        self.on_electrode: Counter[int] = Counter()
        self.faults: list[tuple[float | None, str]] = []
        self.percentiles: list[tuple[float, list[float | None]]] = []
        self._episode, self._total, self._end_s = -1, 0.0, 0.0

    def go_on(self, within_s: float) -> None:
        """Count what was added, for so long at most."""
        until_s = time.monotonic() + within_s
        while self.counted < len(self._tail):
            record = self._tail.peek(self.counted)
            if record is None:
                return
            self._add(record)
            self.counted += 1
            if self.counted % _LOOKS == 0 and time.monotonic() > until_s:
                return

    @property
    def share(self) -> float:
        """Of the records that are there."""
        return self.counted / max(1, len(self._tail))

    def _add(self, words: dict[str, Any]) -> None:
        total = math.nan
        try:
            _expect_fit(words)
            self.outline.add(words)
            kind = words["kind"]
            if kind == "seen":
                self._end_s = float(words["start_s"]) + float(words["duration_s"])
                for _, _, _, electrodes in words["stimuli"]:
                    self.on_electrode.update(electrodes)
                if words["tick"]:
                    total = self._add_tick(words["tick"])
            elif kind == "event":
                self.n_faults += 1
                when, what = number(words.get("asked_at_s")), f"{text(words['what'])}: {text(words['message'])}"
                self.faults = [*self.faults, (when, what)][-_MOST_TOLD:]
            # Sessions of before have records of their own for them.
            if "percentiles_hz" in words:
                self.percentiles.append((self._end_s, first_readout(words["percentiles_hz"])))
                if len(self.percentiles) > _MOST_THRESHOLDS:
                    del self.percentiles[1::2]
        except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError):
            self.strange += 1
        self.totals.append(total)

    def _add_tick(self, tick: dict[str, Any]) -> float:
        if tick["episode"] != self._episode:
            self._episode, self._total = tick["episode"], 0.0
        self._total += tick["reward"] or 0.0
        return self._total


def first_readout(percentiles: Any) -> list[float | None]:
    """The percentiles of one readout; of several those of the first."""
    return numbers(percentiles[0] if percentiles and isinstance(percentiles[0], list) else percentiles)


def _expect_fit(words: dict[str, Any]) -> None:
    """Raise ValueError for what cannot be counted: one such record would leave sums that no later one could mend."""
    tick, kind = words.get("tick"), words["kind"]
    if kind == "seen" and tick:
        kinds = (
            isinstance(tick["agent"], str),
            isinstance(tick["handled"], str),
            isinstance(tick["pulse_time_s"], list),
        )
        flags = (tick[name] for name in ("is_burst", "terminated", "truncated"))
        known = [number(tick[name]) for name in ("late_s", "frequency_hz")]
        fits = all(kinds) and all(isinstance(flag, bool) for flag in flags) and None not in known
        if not fits or whole(tick["episode"]) is None or tick["frequency_hz"] <= 0:
            raise ValueError("tick")
        if tick["reward"] is not None and number(tick["reward"]) is None:
            raise ValueError("reward")
    elif kind == "start" and (whole(words["episode"]) is None or not isinstance(words["observation"], list)):
        raise ValueError("start")
    elif kind in ("asked", "event") and not isinstance(words.get("stimuli", []), list):
        raise ValueError("stimuli")
    if words.get("stretch") is not None and whole(words["stretch"]) is None:
        raise ValueError("stretch")
