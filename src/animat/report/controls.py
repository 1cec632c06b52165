"""Controls beside the trained policies: is it the culture that does the work?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from animat.report.html import with_minus
from animat.report.style import BLUE, GREY, OPTIMUM, ORANGE, Figure, add_common_legend, grid_of_panels, style_axes

_MOST_LETTERS = 36
"""Of a title over a panel."""


@dataclass(frozen=True)
class Controls:
    """The mean returns with one mapping at one recording.

    Attributes:
        title: the mapping and the minute.
        returns: name, mean return and its standard error (None: not known), the trained policies first.
        n_trained: how many of them are trained policies.
        random, optimum: of random actions, and the optimal return; None where not known.
    """

    title: str
    returns: tuple[tuple[str, float, float | None], ...]
    n_trained: int = 1
    random: float | None = None
    optimum: float | None = None


def draw_controls(panels_of: Sequence[Controls], title: str) -> Figure:
    """A panel a mapping and recording: mean returns with their standard errors, random actions and the optimum."""
    most = max(len(controls.returns) for controls in panels_of)
    figure, panels = grid_of_panels(len(panels_of), 2, 4.6, 0.9 + 0.24 * most, title)
    for axes, controls in zip(panels, panels_of, strict=True):
        for place, (_, mean, error) in enumerate(controls.returns):
            colour, name = (BLUE, "trained") if place < controls.n_trained else (ORANGE, "control")
            bar = [error or 0.0]
            axes.errorbar([mean], [-place], xerr=bar, fmt="o", markersize=4, color=colour, capsize=2, label=name)
        names = [with_minus(name) for name, _, _ in controls.returns]
        axes.set_yticks([-i for i in range(len(names))], names)
        axes.set_ylim(-len(controls.returns) + 0.4, 0.6)
        if controls.optimum is not None:
            axes.axvline(controls.optimum, color=OPTIMUM, linewidth=1.2, linestyle="--", label="optimal return")
        if controls.random is not None:
            axes.axvline(controls.random, color=GREY, linewidth=1.2, linestyle=":", label="random actions")
        style_axes(axes, fill(controls.title, _MOST_LETTERS), "mean return and its standard error", "")
        axes.locator_params(axis="x", nbins=5)
        axes.grid(axis="y", linewidth=0.4, alpha=0.5)
    add_common_legend(figure, panels, columns=4)
    return figure
