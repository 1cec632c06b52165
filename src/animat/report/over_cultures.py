"""The results of comparisons on each culture, and over all of them."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

from animat.lazy import Figure
from animat.report.results import OverCultures
from animat.report.style import BLACK, BLUE, GREY, NAME_WIDTH, add_common_legend, new_figure, style_axes, wrapped


def draw_over_cultures(rows: Sequence[tuple[OverCultures, Sequence[float]]]) -> Figure:
    """One panel per robot, one row per comparison: a point for each culture, and their mean with its interval.

    Each comparison comes with its difference on every culture, second arm minus first.
    """
    robots = dict.fromkeys(row.robot for row, _ in rows)
    by_robot = {robot: [each for each in rows if each[0].robot == robot] for robot in robots}
    figure = new_figure(4.4 * len(by_robot), 1.5 + 0.5 * max(map(len, by_robot.values())))
    panels = figure.subplots(1, len(by_robot), squeeze=False)[0]
    for axes, (robot, own) in zip(panels, by_robot.items(), strict=True):
        style_axes(axes, wrapped(robot, 2.0), "difference of the mean returns,\nsecond arm minus first", "")
        axes.axvline(0, color=GREY, linewidth=0.8)
        for place, (row, differences) in enumerate(own):
            places = [place + 0.16] * len(differences)
            axes.plot(differences, places, "o", color=BLUE, alpha=0.6, markersize=4, label="a culture")
            low, high = row.low_95, row.high_95
            if low is not None and high is not None:
                axes.plot([low, high], [place - 0.12] * 2, color=BLACK, linewidth=1.6, label="95 % interval")
            axes.plot(row.difference, place - 0.12, "D", color=BLACK, markersize=5, label="mean over cultures")
        axes.set_yticks(range(len(own)), [fill(row.comparison, NAME_WIDTH) for row, _ in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
    add_common_legend(figure, panels, columns=3)
    return figure
