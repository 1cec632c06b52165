"""Returns at every recording of a culture: the effect of drift on policies, with and without shadowing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.report.style import GREY, OPTIMUM, PALETTE, Figure, add_common_legend, grid_of_panels, style_axes

_MOST = len(PALETTE)
"""The most arms in a panel, as there are no more colours."""


@dataclass(frozen=True, eq=False)
class Course:
    """The returns of one arm: the mean return of each policy at each recording, with the recordings' minutes."""

    name: str
    minutes: Float64[np.ndarray, " recordings"]
    returns: Float64[np.ndarray, "policies recordings"]

    @property
    def quartiles(self) -> Float64[np.ndarray, "3 recordings"]:
        """Lower quartile, median and upper quartile over policies at each recording."""
        return np.asarray(np.quantile(self.returns, [0.25, 0.5, 0.75], axis=0), np.float64)


@dataclass(frozen=True, eq=False)
class Courses:
    """The arms of one mapping, with their common return of random actions and optimal return.

    Attributes:
        title: the mapping.
        courses: of the arms, with the same minutes.
        random: return of random actions at these minutes.
        optimum: optimal return on a coarse grid at these minutes; None if not known.
        fine_optimum: pairs of a minute and the optimal return on a fine grid, for some minutes.
    """

    title: str
    courses: tuple[Course, ...]
    random: Float64[np.ndarray, " recordings"]
    optimum: Float64[np.ndarray, " recordings"] | None = None
    fine_optimum: tuple[tuple[float, float], ...] = ()


def draw_over_time(panels_of: Sequence[Courses], title: str, *, trained_until_min: float) -> Figure:
    """One panel per mapping: median and quartiles over policies of each of its first arms, against the minute.

    The end of training on the culture's clock is marked.
    """
    figure, panels = grid_of_panels(len(panels_of), 2, 4.6, 3.4, title, share_x=True)
    names = list(dict.fromkeys(course.name for of in panels_of for course in of.courses[:_MOST]))
    for axes, of in zip(panels, panels_of, strict=True):
        for course in of.courses[:_MOST]:
            colour = PALETTE[names.index(course.name) % _MOST]
            low, middle, high = course.quartiles
            axes.fill_between(course.minutes, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(course.minutes, middle, color=colour, marker="o", markersize=3, label=course.name)
        minutes = of.courses[0].minutes
        if of.optimum is not None:
            name = "optimal return, coarse grid"
            axes.plot(minutes, of.optimum, color=OPTIMUM, linestyle="--", linewidth=1.3, label=name)
        if of.fine_optimum:
            points = zip(*of.fine_optimum, strict=True)
            axes.plot(*points, "D", color=OPTIMUM, markersize=4, label="optimal return, fine grid")
        axes.plot(minutes, of.random, color=GREY, linestyle=":", linewidth=1.3, label="random actions")
        axes.axvline(trained_until_min, color=GREY, linewidth=1.0, label="end of training")
        left_out = len(of.courses) - _MOST
        more = f" ({left_out} more arms in the tables)" if left_out > 0 else ""
        style_axes(axes, f"{of.title}{more}", "recording (min)", "return")
    add_common_legend(figure, panels, columns=3)
    return figure
