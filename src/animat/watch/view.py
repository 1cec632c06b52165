"""The view of a watched folder, of which each kind has its own, and the blocks that most views are made of."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal

from animat.errors import InvalidArgument, InvalidFile, first_line
from animat.folders import MARKERS, FolderKind
from animat.progress import Speed, format_duration
from animat.watch.discovery import changed_s
from animat.watch.files import json_of, number, text

_MOST_SPAN_S = 60.0
"""Longest span shown at once."""

Width = Literal["third", "half", "two-thirds", "whole"]
Style = Literal["line", "thin", "dashed", "dots", "steps"]


class View(abc.ABC):
    """A folder of one `kind` that is viewed repeatedly; `file` identifies it."""

    kind: ClassVar[FolderKind]
    speed_over_s: ClassVar[float] = 60.0
    """Longest time over which the speed of work is measured."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / MARKERS[self.kind][0]
        self._speed = Speed(self.speed_over_s)
        self._read: dict[Path, tuple[float, Any]] = {}
        """When each file last changed, and its content."""

    def about(self) -> dict[str, Any]:
        """What does not change while work goes on; errors are those of `view`."""
        with self._reading():
            return self._about()

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The current view, of the seconds before a time (None: now, or the end); most views have no clock.

        Raises InvalidFile if the folder's files cannot be read, or hold something else.
        """
        if not 0 < span_s <= _MOST_SPAN_S:
            raise InvalidArgument(f"span: expected above 0 and at most {_MOST_SPAN_S:g} s, got {span_s:g}")
        with self._reading():
            return self._view(to_s, span_s)

    def close(self) -> None:  # noqa: B027 - most keep nothing open
        """Close files."""

    def _about(self) -> dict[str, Any]:
        return {"generation": 0, "title": self._title()}

    @abc.abstractmethod
    def _title(self) -> str: ...

    @abc.abstractmethod
    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]: ...

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Raise InvalidFile for any other error: anything may be in a file."""
        try:
            yield
        except InvalidFile:
            raise
        except Exception as error:
            raise InvalidFile(f"{self.file}: cannot be shown: {first_line(error)}") from error

    def _cached_content(self, path: Path, read: Callable[[Path], Any]) -> Any:
        """The content of a file, read again only if it changed; None if there is none."""
        time_s = changed_s(path)
        if time_s is None:
            return None
        if self._read.get(path, (None,))[0] != time_s:
            self._read[path] = time_s, read(path)
        return self._read[path][1]

    def _manifest(self) -> dict[str, Any]:
        """The content of the file that describes the folder."""
        content = json_of(self.file)
        if not content:
            raise InvalidFile(f"{self.file}: expected the description of a {self.kind}, got none")
        return content


def in_blocks(state: dict[str, Any], blocks: Sequence[dict[str, Any]], damage: str = "") -> dict[str, Any]:
    """A view made of blocks, with the state of the work."""
    return {"generation": 0, **state, "damage": damage, "blocks": list(blocks)}


def chart(
    title: str,
    x: str,
    y: str,
    series: Sequence[dict[str, Any]],
    note: str,
    *,
    marks: Sequence[tuple[float, str]] = (),
    until: float | None = None,
    width: Width = "two-thirds",
) -> dict[str, Any]:
    """Curves (`curve`) over one axis, which reaches to `until` at least; `marks` are places on it with their labels."""
    labelled = [[number(at), text(label)] for at, label in marks]
    return {
        "kind": "chart", "title": title, "x": x, "y": y, "series": list(series), "words": text(note, 2000),
        "marks": labelled, "until": number(until), "width": width,
    }  # fmt: skip


def curve(name: str, x: Sequence[float], y: Sequence[float], style: Style, colour: str) -> dict[str, Any]:
    """A curve of a chart: its name in the legend (empty: none), and its points, thinned if there are many."""
    step = max(1, math.ceil(len(x) / 2000))
    # The last point is always shown.
    shown = sorted({*range(0, len(x), step), max(0, len(x) - 1)}) if len(x) else []
    xs, ys = ([number(float(values[i])) for i in shown] for values in (x, y))
    return {"name": text(name), "x": xs, "y": ys, "style": style, "colour": colour}


def table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[Any]], note: str = "", *, width: Width = "half"
) -> dict[str, Any]:
    """Rows of texts and numbers; the page formats the numbers."""
    cells = [[_cell(value) for value in row] for row in rows]
    return {
        "kind": "table", "title": title, "head": list(head), "rows": cells, "words": text(note, 2000), "width": width,
    }  # fmt: skip


def facts(title: str, rows: Sequence[tuple[str, Any]], note: str = "") -> dict[str, Any]:
    """Names with one value each."""
    pairs = [[name, _cell(value, 1000)] for name, value in rows]
    return {"kind": "facts", "title": title, "rows": pairs, "words": text(note, 2000)}


def _cell(value: Any, most: int = 300) -> Any:
    return number(value) if value is None or isinstance(value, int | float) else text(value, most)


def time_left(seconds: float | None, state: dict[str, Any]) -> str:
    """The remaining time of work in a state (`animat.watch.discovery.state_of`)."""
    if state["state"] != "running":
        return "none: it has ended" if state["state"] == "ended" else "none: it is not running"
    return "not known yet" if (known := number(seconds)) is None else format_duration(known)


def short(value: Any) -> str:
    """A setting in a few characters."""
    known = number(value)
    if known is None:
        return text(value, 60)
    return f"{known:,}" if isinstance(known, int) else f"{known:.4g}"


def settings(values: dict[str, Any]) -> str:
    """Settings by name, in a few characters each."""
    return ", ".join(f"{text(name, 40)} {short(value)}" for name, value in values.items())
