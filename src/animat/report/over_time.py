"""Returns at every recording of a culture: what drift does to policies, with and without shadowing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from animat.report.style import BLACK, BLUE, GREEN, GREY, LIMIT, ORANGE, PURPLE, SKY, new_figure, style_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Course:
    """One condition's returns.

    Attributes:
        name: the condition.
        minutes: of the recordings, shape (recordings,).
        returns: mean return of each policy at each, shape (policies, recordings).
    """

    name: str
    minutes: Float64[np.ndarray, " recordings"]
    returns: Float64[np.ndarray, "policies recordings"]


def draw_over_time(
    courses: Sequence[Course],
    title: str,
    *,
    random: Float64[np.ndarray, " recordings"] | None = None,
    limit: Float64[np.ndarray, " recordings"] | None = None,
    trained_until_min: float | None = None,
) -> Figure:
    """Median over policies of each condition with the range of its quartiles, against the recording's minute.

    Args:
        courses: of one robot, with the same minutes; at most six.
        title: of the figure.
        random, limit: of random actions and the best possible, at the same minutes.
        trained_until_min: end of training on the culture's clock, to be marked.
    """
    figure = new_figure(7.5, 4.2)
    axes = figure.subplots()
    for course, colour in zip(courses, (BLUE, ORANGE, GREEN, PURPLE, SKY, BLACK), strict=False):
        low, middle, high = np.quantile(course.returns, [0.25, 0.5, 0.75], axis=0)
        axes.fill_between(course.minutes, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(course.minutes, middle, color=colour, marker="o", markersize=3, label=course.name)
    minutes = courses[0].minutes
    if limit is not None:
        axes.plot(minutes, limit, color=LIMIT, linestyle="--", linewidth=1.3, label="best possible return")
    if random is not None:
        axes.plot(minutes, random, color=GREY, linestyle=":", linewidth=1.3, label="random actions")
    if trained_until_min is not None:
        axes.axvline(trained_until_min, color=GREY, linewidth=0.8)
        axes.annotate(
            "end of training",
            (trained_until_min, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, 3),
            textcoords="offset points",
            fontsize=8,
            color=GREY,
        )
    style_axes(axes, title, "recording that answers (min)", "return")
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
