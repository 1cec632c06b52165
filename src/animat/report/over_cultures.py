"""What comparisons came to on each culture, and over all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from animat.report.style import BLACK, BLUE, GREY, Figure, add_common_legend, new_figure, style_axes


@dataclass(frozen=True)
class Compared:
    """A comparison on a robot.

    Attributes:
        differences: of each culture, second arm less first.
        mean, low, high: over cultures, with the interval; None of one culture.
    """

    name: str
    robot: str
    differences: tuple[float, ...]
    mean: float
    low: float | None
    high: float | None


def draw_over_cultures(rows: Sequence[Compared]) -> Figure:
    """A panel a robot, a line a comparison: a point for each culture, their mean with its interval."""
    robots = list(dict.fromkeys(row.robot for row in rows))
    figure = new_figure(4.4 * len(robots), 1.5 + 0.5 * max(sum(row.robot == robot for row in rows) for robot in robots))
    panels = figure.subplots(1, len(robots), squeeze=False)[0]
    for axes, robot in zip(panels, robots, strict=True):
        own = [row for row in rows if row.robot == robot]
        style_axes(axes, robot, "difference of the mean returns,\nsecond arm less first", "")
        axes.axvline(0, color=GREY, linewidth=0.8)
        for place, row in enumerate(own):
            places = [place + 0.16] * len(row.differences)
            axes.plot(row.differences, places, "o", color=BLUE, alpha=0.6, markersize=4, label="a culture")
            if row.low is not None and row.high is not None:
                axes.plot([row.low, row.high], [place - 0.12] * 2, color=BLACK, linewidth=1.6, label="95 % interval")
            axes.plot(row.mean, place - 0.12, "D", color=BLACK, markersize=5, label="mean over cultures")
        axes.set_yticks(range(len(own)), [row.name for row in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
    add_common_legend(figure, panels, columns=3)
    return figure
