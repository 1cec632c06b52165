"""What a view is made of where it is no closed loop: tables, lists and charts, each with words on how to read it."""

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
    words: str,
    *,
    marks: Sequence[tuple[float, str]] = (),
    until: float | None = None,
    width: Width = "two-thirds",
) -> dict[str, Any]:
    """Curves over one axis.

    Args:
        title: of the chart.
        x, y: names of the axes, with units.
        series: each made by `curve`.
        words: how to read it, with its main numbers.
        marks: places on the x axis with what is there.
        until: where the x axis ends at least.
        width: on the page.
    """
    told = [[number(at), text(what)] for at, what in marks]
    return {
        "kind": "chart", "title": title, "x": x, "y": y, "series": list(series), "words": text(words, 2000),
        "marks": told, "until": number(until), "width": width,
    }  # fmt: skip


def curve(
    name: str, x: Sequence[float], y: Sequence[float], style: Style, colour: str = "", most: int = 2000
) -> dict[str, Any]:
    """A curve of a chart: its name in the legend (none: not in it), and its points, thinned where they are many."""
    step = max(1, math.ceil(len(x) / most))
    xs, ys = [number(float(each)) for each in x[::step]], [number(float(each)) for each in y[::step]]
    return {"name": text(name), "x": xs, "y": ys, "style": style, "colour": colour}


def table(
    title: str, head: Sequence[str], rows: Sequence[Sequence[Any]], words: str = "", *, width: Width = "half"
) -> dict[str, Any]:
    """Rows of texts and numbers; the page writes the numbers."""
    plain = [[each if each is None or isinstance(each, int | float) else text(each) for each in row] for row in rows]
    cells = [[number(each) if isinstance(each, float) else each for each in row] for row in plain]
    return {
        "kind": "table",
        "title": title,
        "head": list(head),
        "rows": cells,
        "words": text(words, 2000),
        "width": width,
    }


def facts(title: str, rows: Sequence[tuple[str, Any]], words: str = "") -> dict[str, Any]:
    """Names with a value each."""
    told = [[name, number(value) if isinstance(value, int | float) else text(value, 1000)] for name, value in rows]
    return {"kind": "facts", "title": title, "rows": told, "words": text(words, 2000)}


def time_left(seconds: float | None, state: dict[str, Any]) -> str:
    """How long work will still take, as it stands (`animat.watch.held.state_of`)."""
    if state["state"] != "running":
        return "none: it has ended" if state["state"] == "ended" else "none: it does not go on"
    return "not known yet" if (known := number(seconds)) is None else format_duration(known)
