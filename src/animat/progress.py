"""Progress of long work as an object that is handed in: silent, or a bar or lines with an estimate of the time left."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

LINE_EVERY_S = 10.0


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


class Lines:
    """A progress in lines on standard error, for where there is no terminal: one every ten seconds, and no sooner.

        training: 34 %, 80 s left, return 101.2

    The time left is as long as the rest would take at the speed so far; of work whose share falls, as it begins another
    part, from there on.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._started_s = self._told_s = time.monotonic()
        self._first = self._last = 0.0

    def update(self, done: float, total: float, note: str = "") -> None:
        """Tell it, if the last line is old enough."""
        now_s, share = time.monotonic(), done / total
        if share < self._last:
            self._started_s, self._first = now_s, share
        self._last = share
        if now_s - self._told_s < LINE_EVERY_S:
            return
        self._told_s = now_s
        told = [f"{100 * share:.0f} %"]
        if share > self._first:
            left_s = (now_s - self._started_s) * (1 - share) / (share - self._first)
            told.append(f"{left_s:.0f} s left" if left_s < 120 else f"{left_s / 60:.0f} min left")
        print(f"{self._title}: {', '.join([*told, *([note] if note else [])])}", file=sys.stderr, flush=True)


class Bar:
    """A progress bar on standard error, with the time left; where that is not a terminal, a line every ten seconds.

    Use it as a context manager: `with Bar("training") as progress: ...`.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: RichProgress | None = None
        self._lines = Lines(title)

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            self._bar = RichProgress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.percentage:>3.0f} %"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
                console=Console(stderr=True),
                # What is printed appears above the bar; a file or a pipe that it goes to gets it as ever.
                redirect_stdout=sys.stdout.isatty(),
            )
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=1.0, note="")
        return self

    def update(self, done: float, total: float, note: str = "") -> None:
        """Move the bar to `done` of `total`."""
        if self._bar is None:
            self._lines.update(done, total, note)
        else:
            self._bar.update(self._task, completed=done, total=total, note=note)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
