"""When a culture was stimulated, as far back as the limits on pace look; kept from session to session."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

NS = 1_000_000_000


class Event(NamedTuple):
    """A stimulus on the culture's clock."""

    start_ns: int
    end_ns: int
    electrodes: tuple[int, ...]


class History:
    """The stimuli of the last second, and the last one on each electrode, in whole nanoseconds of the culture's clock.

    Starts are in order of time. A guard consults it and adds what it admits. Reopening a culture continues the same
    history, because a living culture does not forget its stimuli when a program closes it.
    """

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._starts_on: dict[int, list[int]] = {}
        self._seen_ns = 0
        self.busy_until_ns = -(2**63)
        """When the last stimulus ends; before any, too long ago for every gap."""

    def in_second_to(self, time_ns: int, electrode: int | None = None) -> int:
        """Stimuli, on one electrode or on any, that began less than a second before a time not before the last."""
        starts = self._starts if electrode is None else self._starts_on.get(electrode, ())
        return len(starts) - bisect_right(starts, time_ns - NS)

    def last_on(self, electrode: int) -> int | None:
        """When the last stimulus on an electrode began, however long ago; None: there was none."""
        starts = self._starts_on.get(electrode)
        return starts[-1] if starts else None

    def add(self, events: Sequence[Event], now_ns: int) -> None:
        """Add stimuli in order of time, and forget those more than a second old."""
        self._seen_ns = now_ns
        _forget(self._starts, now_ns)
        for start_ns, end_ns, electrodes in events:
            self._starts.append(start_ns)
            for electrode in electrodes:
                starts = self._starts_on.setdefault(electrode, [])
                _forget(starts, now_ns)
                starts.append(start_ns)
            self.busy_until_ns = end_ns

    def resume(self, now_ns: int) -> None:
        """Continue in a new session whose clock is at `now_ns`.

        A clock behind its last reading was restarted: no time is assumed to have passed. Stimuli admitted for later
        than now were interrupted; it is not known how many were delivered, so all count as if they had begun just now.
        Either way stimuli may seem more recent than they were, never less recent.
        """
        behind_ns = max(0, self._seen_ns - now_ns)
        self._seen_ns = now_ns
        lasts_ns = self.busy_until_ns - self._starts[-1] if self._starts else 0
        for starts in (self._starts, *self._starts_on.values()):
            starts[:] = [min(start_ns - behind_ns, now_ns) for start_ns in starts]
        if self._starts:
            self.busy_until_ns = self._starts[-1] + lasts_ns


def _forget(starts: list[int], now_ns: int) -> None:
    """Drop starts a second or more ago, except the last: a limit on intervals may be longer than a second."""
    del starts[: min(bisect_right(starts, now_ns - NS), len(starts) - 1)]
