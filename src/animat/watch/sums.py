"""Totals, episodes and faults of a session so far, counted in slices while it is watched."""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from typing import Any

from animat.closed_loop.outline import Outline
from animat.watch.plain import number, numbers, text, whole
from animat.watch.tail import Tail

_MOST_FAULTS = 50
"""Most faults shown."""
_MOST_THRESHOLDS = 20_000
"""Most changes of thresholds kept; beyond it every second one is dropped, repeatedly."""
_LOOKS = 64
"""Records between two looks at the clock."""
_KINDS = {
    "agent": str, "handled": str, "pulse_time_s": list, "is_burst": bool, "terminated": bool, "truncated": bool,
}  # fmt: skip
"""Types of a tick's values."""


class Sums:
    """The totals of a log's records counted so far.

    Attributes:
        counted: number of records counted.
        outline: their outline.
        totals: for each record the return of its episode so far; NaN without a tick.
        on_electrode: number of pulses on each electrode.
        faults: the last ones: when, on the session's clock, and what happened.
        n_faults: number of all faults.
        percentiles: when thresholds changed, and the percentiles in Hz since then.
        strange: number of records that are not understood.
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
        """Count the records that were added, for at most `within_s`."""
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
        """The share of the log's records that are counted."""
        return self.counted / max(1, len(self._tail))

    def _add(self, fields: dict[str, Any]) -> None:
        total = math.nan
        try:
            _expect_fit(fields)
            self.outline.add(fields)
            kind = fields["kind"]
            if kind == "seen":
                self._end_s = float(fields["start_s"]) + float(fields["duration_s"])
                for _, _, _, electrodes in fields["stimuli"]:
                    self.on_electrode.update(electrodes)
                if fields["tick"]:
                    total = self._add_tick(fields["tick"])
            elif kind == "event":
                self.n_faults += 1
                when, what = number(fields.get("asked_at_s")), f"{text(fields['what'])}: {text(fields['message'])}"
                self.faults = [*self.faults, (when, what)][-_MOST_FAULTS:]
            # Older sessions have separate records for them.
            if "percentiles_hz" in fields:
                self.percentiles.append((self._end_s, first_readout(fields["percentiles_hz"])))
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
    """The percentiles of the first or only readout."""
    return numbers(percentiles[0] if percentiles and isinstance(percentiles[0], list) else percentiles)


def _expect_fit(fields: dict[str, Any]) -> None:
    """Raise ValueError for a record that cannot be counted: it would spoil the sums for good."""
    tick, kind = fields.get("tick"), fields["kind"]
    if kind == "seen" and tick:
        fits = all(isinstance(tick[name], kind) for name, kind in _KINDS.items())
        fits &= None not in (number(tick["late_s"]), number(tick["frequency_hz"]), whole(tick["episode"]))
        if not fits or tick["frequency_hz"] <= 0:
            raise ValueError("tick")
        if tick["reward"] is not None and number(tick["reward"]) is None:
            raise ValueError("reward")
    elif kind == "start" and (whole(fields["episode"]) is None or not isinstance(fields["observation"], list)):
        raise ValueError("start")
    elif kind in ("asked", "event") and not isinstance(fields.get("stimuli", []), list):
        raise ValueError("stimuli")
    if fields.get("stretch") is not None and whole(fields["stretch"]) is None:
        raise ValueError("stretch")
