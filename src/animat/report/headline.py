"""A study in one figure, a panel for each robot: how each arm does, or each comparison over many cultures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.report.results import OverCultures, Score
from animat.report.style import BLACK, BLUE, GREY, OPTIMUM, SKY, add_common_legend, new_figure, style_axes, wrapped

_NAME_WIDE_IN = 2.3
"""Width of a name beside a panel, of which there are two in a row."""


def draw_headline(rows: Sequence[tuple[Score, Float64[np.ndarray, " policies"]]], *, narrow: bool = False) -> Figure:
    """One panel per robot, one row per arm: the policies with their interval, random actions, the optimal return.

    The axis covers all returns; an interval that extends beyond it ends in an arrow. A narrow figure is as wide as a
    phone, with the panels below each other. Each score comes with the mean return of each policy.
    """
    robots = dict.fromkeys(row.robot for row, _ in rows)
    by_robot = {robot: [each for each in rows if each[0].robot == robot] for robot in robots}
    names = {row.arm: wrapped(row.arm, _NAME_WIDE_IN) for row, _ in rows}
    lines = max(name.count("\n") + 1 for name in names.values())
    height_in, n = 1.2 + max(0.34, 0.18 * lines) * max(map(len, by_robot.values())), len(by_robot)
    figure = new_figure(3.6, height_in * n) if narrow else new_figure(4.6 * n, height_in)
    panels = list(figure.subplots(*((n, 1) if narrow else (1, n)), squeeze=False).flat)
    for axes, (robot, own) in zip(panels, by_robot.items(), strict=True):
        style_axes(axes, wrapped(robot, 2.0), "mean return of an episode", "")
        every = [(row.interquartile_mean, row.random, row.optimum, *policies.tolist()) for row, policies in own]
        known = [value for of_arm in every for value in of_arm if value is not None]
        # All returns, with some room for intervals on either side.
        room = 0.08 * (max(known) - min(known)) or 1.0
        left, right = min(known) - room, max(known) + room
        for place, (row, policies) in enumerate(own):
            if row.random is not None:
                axes.plot(row.random, place, "x", color=GREY, markersize=6, label="random actions")
            if row.optimum is not None:
                axes.plot([row.optimum] * 2, [place - 0.3, place + 0.3], color=OPTIMUM, label="optimal return")
            low, high = row.low_95, row.high_95
            if low is not None and high is not None:
                ends = np.clip([low, high], left, right)
                axes.plot(ends, [place] * 2, color=SKY, linewidth=3, label="95 % interval", zorder=1.5)
                for beyond, end, marker in ((low < left, left, "<"), (high > right, right, ">")):
                    if beyond:
                        axes.plot(end, place, marker, color=SKY, markersize=8, clip_on=False)
            axes.plot(policies, [place + 0.22] * len(policies), "o", color=BLUE, markersize=2.5, label="each policy")
            axes.plot(row.interquartile_mean, place, "o", color=BLUE, markersize=6, label="their interquartile mean")
        axes.set_xlim(left, right)
        axes.set_yticks(range(len(own)), [names[row.arm] for row, _ in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
        axes.grid(axis="x", linewidth=0.4, alpha=0.5)
    add_common_legend(figure, panels, columns=2 if narrow else 3 if n == 1 else 5)
    return figure


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
        axes.set_yticks(range(len(own)), [wrapped(row.comparison, _NAME_WIDE_IN) for row, _ in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
    add_common_legend(figure, panels, columns=3)
    return figure
