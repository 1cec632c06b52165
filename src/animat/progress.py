"""Progress of long work as an object that is handed in: silent, or a bar or lines with an estimate of the time left."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

LINE_EVERY_S = 10.0
"""Between lines, where there is no terminal."""
_LOOK_EVERY_S = 1.0
_BAR_WIDTH = 24
_OF_USE = 2 / 3
"""Of the time that passed: how fast the beginning went is of less use for the rest."""
_ROUNDING = 1e-9
"""Of all work: what sums of parts may be off by is no progress."""
_FEWEST_MOVED = 0.01
"""Of all work: with less done nothing sensible can be said about the rest."""


class Progress(Protocol):
    """What long work reports to: how far it is, of how much, and a few words on how it goes."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Say that `done` of `total` units of work are finished; `note` is a short remark, such as the last return."""


class Silent:
    """A progress that says nothing."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Ignore the report."""


class Part:
    """A part of longer work, as a progress: so many units of the whole's total, after those before it.

    Where the part itself says nothing, `note` is said.
    """

    def __init__(self, whole: Progress, before: float, units: float, total: float, note: str = "") -> None:
        self._whole, self._before, self._units, self._total, self._note = whole, before, units, total, note

    def update(self, done: float, total: float, note: str = "") -> None:
        """Move the whole on by as much."""
        self._whole.update(self._before + self._units * done / total, self._total, note or self._note)


class EqualPhases:
    """Work in so many phases as one progress that never goes back: each phase is an equal part of the whole."""

    def __init__(self, whole: Progress, phases: int) -> None:
        self._whole, self._last = whole, phases - 1
        self._phase, self._was_told = 0, False

    def begin(self) -> None:
        """The next phase begins, if anything was told of the one before."""
        self._phase = min(self._phase + self._was_told, self._last)
        self._was_told = False

    def update(self, done: float, total: float, note: str = "") -> None:
        """Move the whole on by as much of the phase."""
        self._was_told = True
        self._whole.update(self._phase + done / total, self._last + 1, note)


def in_phase(progress: Progress | None, title: str, amount: float = 0.0, unit: str = "") -> Progress:
    """The progress of another phase of the work, whose length says nothing about that of the others.

    A `Bar` shows each phase by itself, one below the other, and `EqualPhases` lets each be a part of the whole; any other
    progress is told the phases one after the other.

    Args:
        progress: of the whole work; None: silent.
        title: a word or two.
        amount: how much is done in the phase, where there is a number that tells more than a share; 0: none.
        unit: of the amount, in the plural.
    """
    if isinstance(progress, Bar):
        progress.begin(title, amount, unit)
    elif isinstance(progress, EqualPhases):
        progress.begin()
    return Silent() if progress is None else progress


class Speed:
    """How fast work goes on: over the later two thirds of the time since it first moved.

    What was before, compiling and the part of a checkpoint that is gone on from, says nothing about the rest. Work is
    measured as a share of its whole, or in larger units.

    Args:
        most_s: over so many seconds at most.
    """

    def __init__(self, most_s: float = math.inf) -> None:
        self._most_s = most_s
        self._seen: deque[tuple[float, float]] = deque()
        self._began_s = self._done = 0.0
        self._has_moved = False

    def see(self, done: float) -> None:
        """Take in how much is done; where that is less than before, other work has begun."""
        now_s, self._done = time.monotonic(), done
        if self._seen and done < self._seen[-1][1]:
            self._seen.clear()
            self._has_moved = False
        if self._seen and not self._has_moved and done > self._seen[0][1] + _ROUNDING:
            self._seen.clear()
            self._has_moved = True
        if not self._seen:
            self._began_s = now_s
        over_s = min(_OF_USE * (now_s - self._began_s), self._most_s)
        if not self._seen or now_s - self._seen[-1][0] >= max(0.5, over_s / 130):
            self._seen.append((now_s, done))
        while len(self._seen) > 1 and self._seen[1][0] <= now_s - over_s:
            self._seen.popleft()

    @property
    def per_s(self) -> float | None:
        """How much is done a second; None as long as too little is to tell."""
        if not self._seen:
            return None
        since_s, before = self._seen[0]
        passed_s, moved = time.monotonic() - since_s, self._done - before
        return moved / passed_s if passed_s > 0 and moved >= _FEWEST_MOVED else None

    def left_s(self, left: float) -> float | None:
        """Until so much more is done; None where that is not known."""
        return None if self.per_s is None else left / self.per_s


class Phase:
    """One phase of work, and what can be said about it."""

    def __init__(self, title: str, amount: float = 0.0, unit: str = "") -> None:
        self.title, self.share, self.note = title, 0.0, ""
        self.was_told = False
        """Whether anything was reported of it."""
        self._amount, self._unit = amount, unit
        self._began_s, self._ended_s = time.monotonic(), float("inf")
        self._speed = Speed()

    def update(self, done: float, total: float, note: str = "") -> None:
        """Take in a report."""
        # Sums of parts may be a rounding beyond either end.
        self.share, self.note, self.was_told = min(1.0, max(0.0, done / total)), note, True
        self._speed.see(self.share)

    def end(self) -> None:
        """It is done."""
        self.share, self.note, self._ended_s = 1.0, "", time.monotonic()

    @property
    def passed_s(self) -> float:
        """Seconds that it has taken."""
        return min(time.monotonic(), self._ended_s) - self._began_s

    def counted(self) -> list[str]:
        """How much is done, and how fast, where that is known."""
        if not self._amount:
            return []
        told = [f"{self.share * self._amount:,.0f} of {self._amount:,.0f} {self._unit}"]
        per_s = self._speed.per_s
        return told if per_s is None else [*told, format_rate(per_s * self._amount)]

    def left(self) -> str:
        """How long the rest would take at the speed so far; empty where that cannot be told."""
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
    """A progress bar on standard error, with the time left; where that is not a terminal, a line every ten seconds.

        training: 34 %, 81,600 of 240,000 iterations, 1,940 a second, 82 s left, return 101.2

    Use it as a context manager: `with Bar("training") as progress: ...`. Each phase of the work (`in_phase`) has a bar
    of its own.
    """

    def __init__(self, title: str) -> None:
        self._phases = [Phase(title)]
        self._live: Live | None = None
        self._is_over = threading.Event()
        self._told_s = time.monotonic()
        self._telling = threading.Lock()

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(
                get_renderable=self._drawn,
                console=Console(stderr=True),
                # What is printed appears above the bar; a file or a pipe that it goes to gets it as ever.
                redirect_stdout=sys.stdout.isatty(),
            )
            self._live.start()
        else:
            # Work that reports nothing for long is told of too.
            threading.Thread(target=self._look, name="progress", daemon=True).start()
        return self

    def begin(self, title: str, amount: float = 0.0, unit: str = "") -> None:
        """Begin another phase; the one before is done. See `in_phase`."""
        self._phases[-1].end()
        # One of which nothing was said is not shown.
        self._phases = [*(phase for phase in self._phases if phase.was_told), Phase(title, amount, unit)]

    def update(self, done: float, total: float, note: str = "") -> None:
        """Move the bar to `done` of `total`."""
        self._phases[-1].update(done, total, note)
        if self._live is None:
            self._tell()

    def _look(self) -> None:
        while not self._is_over.wait(_LOOK_EVERY_S):
            self._tell()

    def _tell(self) -> None:
        """A line, if the last one is old enough."""
        with self._telling:
            now_s, phase = time.monotonic(), self._phases[-1]
            if now_s - self._told_s < LINE_EVERY_S:
                return
            self._told_s = now_s
            told = [f"{100 * phase.share:.0f} %", *phase.counted(), phase.left(), phase.note]
            print(f"{phase.title}: {', '.join(filter(None, told))}", file=sys.stderr, flush=True)

    def _drawn(self) -> RenderableType:
        """The phases one below the other, and below the last what is known besides, cut to the terminal's width."""
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
        told = ", ".join(filter(None, [*phases[-1].counted(), phases[-1].note]))
        return Group(table, Text(told, no_wrap=True, overflow="ellipsis")) if told else table

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_over.set()
        if self._live is not None:
            self._live.stop()
            self._live = None
