"""Progress of long work as an object that is handed in: silent, or a bar with an estimate of the time left."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Protocol, Self


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


class Bar:
    """A progress bar on standard error, with the time left; nothing is drawn where that is not a terminal.

    Use it as a context manager: `with Bar("training") as progress: ...`.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: object | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            self._rich = RichProgress(
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
            self._rich.start()
            self._task = self._rich.add_task(self._title, total=1.0, note="")
            self._bar = self._rich
        return self

    def update(self, done: float, total: float, note: str = "") -> None:
        """Move the bar to `done` of `total`."""
        if self._bar is not None:
            self._rich.update(self._task, completed=done, total=total, note=note)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._rich.stop()
            self._bar = None
