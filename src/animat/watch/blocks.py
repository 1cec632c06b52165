"""The blocks of all views but that of a closed loop: tables, lists and charts, each with a note on how to read it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from animat.progress import format_duration
from animat.watch.plain import number, text

Width = Literal["third", "half", "two-thirds", "whole"]
Style = Literal["line", "thin", "dashed", "dots", "steps"]


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
    xs, ys = ([number(float(value)) for value in values[::step]] for values in (x, y))
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
