"""The style of all figures, and writing them to files."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from animat.errors import InvalidArgument
from animat.lazy import Axes, Figure
from animat.writing import atomic_write

FORMATS = ("png", "svg", "pdf")
PNG_DPI = 160

# Text stays text in an SVG. Without the salt, element names are random, and the same figure gives different files.
_SAVING: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "animat"}
_SAVING_LOCK = threading.Lock()
"""matplotlib's settings are those of all threads, such as the workers of an executor."""


def new_figure(width_in: float, height_in: float, title: str = "") -> Figure:
    """An empty figure of a size in inches, which needs no display; its title is wrapped and keeps its dollar signs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(wrapped(title, width_in), fontsize=10, parse_math=False)
    return figure


def style_axes(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Set title and labels (with units), and hide the upper and right frame."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def wrapped(title: str, width_in: float) -> str:
    """A title of a panel of this width, on as many lines as it needs; sets of electrodes break between electrodes."""
    return fill(title.replace("+", "+ "), max(8, int(width_in / 0.082))).replace("+ ", "+")


def add_legend(axes: Axes, **place: Any) -> None:
    """Add a legend without a frame; `place` as for `Axes.legend`."""
    axes.legend(fontsize=8, frameon=False, **place)


def add_common_legend(figure: Figure, panels: Sequence[Axes], *, columns: int) -> None:
    """Add one legend under a figure for all its panels: each label once, in as many columns as fit."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        handles, labels = list(entries.values()), list(entries)
        while columns > 1 and _legend_width_in(labels, columns) > figure.get_figwidth():
            columns -= 1
        figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=columns)


def _legend_width_in(labels: Sequence[str], columns: int) -> float:
    """The approximate width of a legend in 8-point type, in inches: each column has a sample and its longest label."""
    parts = np.array_split(np.array([len(label) for label in labels]), columns)
    return sum(0.53 + 0.062 * float(part.max()) for part in parts if len(part))


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure atomically as PNG, SVG or PDF, by the path's suffix.

    Raises InvalidArgument for another suffix, and InvalidFile if the file cannot be written.
    """
    import matplotlib

    path = Path(path)
    kind = path.suffix[1:].lower()
    if kind not in FORMATS:
        raise InvalidArgument(f"{path}: expected a figure's name to end in .png, .svg or .pdf, got {path.suffix!r}")
    # With a date, the same figure would give different files; PNG has none.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with atomic_write(path) as beside, _SAVING_LOCK, matplotlib.rc_context(_SAVING):
        figure.savefig(beside, format=kind, dpi=PNG_DPI, metadata=metadata)
    return path


def save_formats(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure in every format, the PNG first, with whose layout it stays; returns the files."""
    first, *others = (folder / f"{name}.{ending}" for ending in FORMATS)
    saved = [save_figure(figure, first)]
    # Its layout takes a quarter of the time, and those of other formats differ by fractions of a point.
    figure.set_layout_engine("none")
    return saved + [save_figure(figure, path) for path in others]


def grid_of_panels(
    n: int, columns: int, width_in: float, height_in: float, title: str, *, share_x: bool = False, share_y: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure with n panels in rows, each of a size in inches, and the panels."""
    columns = min(columns, max(n, 1))
    rows = max(1, -(-n // columns))
    figure = new_figure(max(width_in * columns, 4.5), height_in * rows + 0.35, title)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=share_x, sharey=share_y).reshape(-1)
    for axes in panels[n:]:
        axes.set_visible(False)
    for axes in panels[:n]:
        # Numbers at every panel, although axes are shared.
        axes.tick_params(labelbottom=True, labelleft=True)
    return figure, list(panels[:n])
