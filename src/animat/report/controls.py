"""Controls and trained policies: is it the culture that does the work?"""

from __future__ import annotations

from collections.abc import Sequence

from animat.lazy import Figure
from animat.report.html import with_minus
from animat.report.results import TRAINED, ControlReturns
from animat.report.style import BLUE, GREY, OPTIMUM, ORANGE, add_common_legend, grid_of_panels, style_axes, wrapped


def draw_controls(panels_of: Sequence[tuple[str, Sequence[ControlReturns]]], title: str) -> Figure:
    """A titled panel per mapping and recording: returns of trained policies and controls, random ones, the optimum."""
    most = max(len(rows) for _, rows in panels_of)
    figure, panels = grid_of_panels(len(panels_of), 2, 4.6, 0.9 + 0.24 * most, title)
    for axes, (through, rows) in zip(panels, panels_of, strict=True):
        for place, row in enumerate(rows):
            colour, name = (BLUE, "trained") if row.control.startswith(TRAINED) else (ORANGE, "control")
            mean, error = [row.mean_return], [row.standard_error or 0.0]
            axes.errorbar(mean, [-place], xerr=error, fmt="o", markersize=4, color=colour, capsize=2, label=name)
        axes.set_yticks([-i for i in range(len(rows))], [with_minus(row.control) for row in rows])
        axes.set_ylim(-len(rows) + 0.4, 0.6)
        # Rows whose choices have no effect have none.
        if (optimum := next((row.optimum for row in rows if row.optimum is not None), None)) is not None:
            axes.axvline(optimum, color=OPTIMUM, linewidth=1.2, linestyle="--", label="optimal return")
        if rows[0].random is not None:
            axes.axvline(rows[0].random, color=GREY, linewidth=1.2, linestyle=":", label="random actions")
        # Narrower than the panel, as it begins right of the names of the rows.
        style_axes(axes, wrapped(through, 3.0), "mean return and its standard error", "")
        axes.locator_params(axis="x", nbins=5)
        axes.grid(axis="y", linewidth=0.4, alpha=0.5)
    add_common_legend(figure, panels, columns=4)
    return figure
