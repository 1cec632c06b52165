"""Progress of long work, as an object passed to it: silent, or a bar or lines with an estimate of the time left."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

LINE_EVERY_S = 10.0
"""Between lines, if there is no terminal."""
SAME_EVERY_S = 60.0
"""Between lines that differ in nothing but speed and time left."""
_CHECK_EVERY_S = 1.0
_BAR_WIDTH = 24
_RECENT = 2 / 3
"""Share of the elapsed time that the speed is measured over: how fast the beginning went says less about the rest."""
_ROUNDING = 1e-9
"""Share of all work that sums of parts may be off by; this much is not progress."""
_FEWEST_MOVED = 0.01
"""Share of all work that must be done before anything can be said about the rest."""


@runtime_checkable
class Progress(Protocol):
    """What long work reports to: how much of it is done, and a few words on how it is going."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Report that `done` of `total` units of work are finished; `note` is a remark, such as the last return."""


class Silent:
    """A progress that shows nothing."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Ignore the report."""


class Part:
    """A part of longer work, `units` of the whole's total after `before`; its `note` is for reports without one."""

    def __init__(self, whole: Progress, before: float, units: float, total: float, note: str = "") -> None:
        self._whole, self._before, self._units, self._total, self._note = whole, before, units, total, note

    def update(self, done: float, total: float, note: str = "") -> None:
        self._whole.update(self._before + self._units * done / total, self._total, note or self._note)


class EqualPhases:
    """Work in several phases as one progress that never goes back: each phase is an equal part of the whole."""

    def __init__(self, whole: Progress, phases: int) -> None:
        self._whole, self._last = whole, phases - 1
        self._phase, self._has_reported = 0, False

    def begin(self) -> None:
        """Begin the next phase, if the current one has reported anything."""
        self._phase = min(self._phase + self._has_reported, self._last)
        self._has_reported = False

    def update(self, done: float, total: float, note: str = "") -> None:
        self._has_reported = True
        self._whole.update(self._phase + done / total, self._last + 1, note)


def in_phase(progress: Progress | None, title: str, amount: float = 0.0, unit: str = "") -> Progress:
    """The progress of the next phase of the work, whose length says nothing about that of the others.

    A `Bar` shows each phase separately, one below the other, and for `EqualPhases` each is a part of the whole; any
    other progress receives the reports of all phases one after the other. `amount` is how much is done in the phase,
    if a number says more than a share, and `unit` its unit in the plural.
    """
    if isinstance(progress, Bar):
        progress.begin(title, amount, unit)
    elif isinstance(progress, EqualPhases):
        progress.begin()
    return Silent() if progress is None else progress


class Speed:
    """The speed of work, over the later two thirds of the time since it first moved.

    What came before, such as compilation and the work loaded from a checkpoint, says nothing about the rest. Work is
    measured as a share of the whole, or in larger units, over `most_s` seconds at the most.
    """

    def __init__(self, most_s: float = math.inf) -> None:
        self._most_s = most_s
        self._seen: deque[tuple[float, float]] = deque()
        self._began_s = self._done = 0.0
        self._has_moved = False

    def see(self, done: float) -> None:
        """Record how much is done; if that is less than before, new work has begun."""
        now_s, self._done = time.monotonic(), done
        if self._seen and done < self._seen[-1][1] - _ROUNDING:
            self._seen.clear()
            self._has_moved = False
        if self._seen and not self._has_moved and done > self._seen[0][1] + _ROUNDING:
            self._seen.clear()
            self._has_moved = True
        if not self._seen:
            self._began_s = now_s
        over_s = min(_RECENT * (now_s - self._began_s), self._most_s)
        if not self._seen or now_s - self._seen[-1][0] >= max(0.5, over_s / 130):
            self._seen.append((now_s, done))
        while len(self._seen) > 1 and self._seen[1][0] <= now_s - over_s:
            self._seen.popleft()

    @property
    def per_s(self) -> float | None:
        """How much is done per second; None while too little is done to know."""
        if not self._seen:
            return None
        since_s, before = self._seen[0]
        passed_s, moved = time.monotonic() - since_s, self._done - before
        return moved / passed_s if passed_s > 0 and moved >= _FEWEST_MOVED else None

    def left_s(self, left: float) -> float | None:
        """Seconds until `left` more is done; None if unknown."""
        return None if self.per_s is None else left / self.per_s


class WorkPhase:
    """One phase of work and its progress."""

    def __init__(self, title: str, amount: float = 0.0, unit: str = "") -> None:
        self.title, self.share, self.note = title, 0.0, ""
        self.has_reported = False
        self._amount, self._unit = amount, unit
        self._began_s, self._ended_s = time.monotonic(), math.inf
        self._speed = Speed()

    def update(self, done: float, total: float, note: str = "") -> None:
        # Sums of parts may pass either end by a rounding error.
        self.share, self.note, self.has_reported = min(1.0, max(0.0, done / total)), note, True
        self._speed.see(self.share)

    def end(self) -> None:
        self.share, self.note, self._ended_s = 1.0, "", time.monotonic()

    @property
    def passed_s(self) -> float:
        return min(time.monotonic(), self._ended_s) - self._began_s

    def counted(self) -> list[str]:
        """How much is done, and how fast if that is known."""
        if not self._amount:
            return []
        done = f"{self.share * self._amount:,.0f} of {self._amount:,.0f} {self._unit}"
        per_s = self._speed.per_s
        return [done] if per_s is None else [done, format_rate(per_s * self._amount)]

    def left(self) -> str:
        """The time left at the current speed; empty if unknown."""
        left_s = self._speed.left_s(1 - self.share)
        return f"{format_duration(left_s)} left" if left_s else ""


def format_rate(per_s: float) -> str:
    """A rate, such as `5,300 a second` or `2.1 a minute`."""
    for unit, seconds in (("second", 1), ("minute", 60)):
        if (rate := per_s * seconds) >= 1:
            return f"{rate:,.0f} a {unit}" if rate >= 10 else f"{rate:.1f} a {unit}"
    return f"{per_s * 3600:.1f} an hour"


def format_duration(seconds: float) -> str:
    """A duration, such as `80 s`, `12 min` or `3.4 h`."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


class Bar:
    """A progress bar on standard error, with the time left; if that is not a terminal, a line every ten seconds.

        training: 34 %, 81,600 of 240,000 iterations, 1,940 a second, 82 s left, return 101.2

    While nothing moves, the line comes every minute. It is a context manager. Each phase of the work (`in_phase`) has
    its own bar.
    """

    def __init__(self, title: str) -> None:
        self._phases = [WorkPhase(title)]
        self._live: Live | None = None
        self._is_over = threading.Event()
        self._printed_s, self._printed = time.monotonic(), [""]
        self._printing = threading.Lock()

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(
                get_renderable=self._rendered,
                console=Console(stderr=True),
                # Printed text appears above the bar; if standard output is a file or a pipe, it is unaffected.
                redirect_stdout=sys.stdout.isatty(),
            )
            self._live.start()
        else:
            # Work that reports nothing for a long time needs lines too.
            threading.Thread(target=self._keep_printing, name="progress", daemon=True).start()
        return self

    def begin(self, title: str, amount: float = 0.0, unit: str = "") -> None:
        """Begin another phase; the current one is done. See `in_phase`."""
        self._phases[-1].end()
        # Phases that reported nothing are not shown.
        self._phases = [*(phase for phase in self._phases if phase.has_reported), WorkPhase(title, amount, unit)]

    def update(self, done: float, total: float, note: str = "") -> None:
        self._phases[-1].update(done, total, note)
        if self._live is None:
            self._print_line()

    def _keep_printing(self) -> None:
        while not self._is_over.wait(_CHECK_EVERY_S):
            self._print_line()

    def _print_line(self) -> None:
        with self._printing:
            now_s, phase = time.monotonic(), self._phases[-1]
            if now_s - self._printed_s < LINE_EVERY_S:
                return
            done, counted = f"{phase.title}: {100 * phase.share:.0f} %", phase.counted()
            news = [done, *counted[:1], phase.note]
            if news == self._printed and now_s - self._printed_s < SAME_EVERY_S:
                return
            self._printed_s, self._printed = now_s, news
            print(", ".join(filter(None, [done, *counted, phase.left(), phase.note])), file=sys.stderr, flush=True)

    def _rendered(self) -> RenderableType:
        """The phases one below the other, then further details of the last, cut to the terminal's width."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        phases = self._phases
        table = Table.grid(padding=(0, 1))
        for phase in phases:
            minutes, seconds = divmod(int(phase.passed_s), 60)
            table.add_row(
                Text(phase.title, no_wrap=True, overflow="ellipsis"),
                ProgressBar(1.0, phase.share, _BAR_WIDTH),
                Text(f"{100 * phase.share:3.0f} %"),
                Text(f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"),
                Text(phase.left(), no_wrap=True),
            )
        details = ", ".join(filter(None, [*phases[-1].counted(), phases[-1].note]))
        return Group(table, Text(details, no_wrap=True, overflow="ellipsis")) if details else table

    def __exit__(self, kind: object, *_: object) -> None:
        self._is_over.set()
        if kind is None:
            # Not all work reports its end.
            self._phases[-1].end()
        if self._live is not None:
            self._live.stop()
            self._live = None
