"""The study in one figure: how each arm does on each robot, between random actions and the optimal return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from animat.report.style import BLUE, GREY, OPTIMUM, SKY, Figure, add_common_legend, new_figure, style_axes


@dataclass(frozen=True)
class ArmReturns:
    """How an arm does on a robot.

    Attributes:
        mean: interquartile mean over policies of their mean returns.
        low, high: of its 95 % interval; None of few policies.
        policies: the mean return of each.
        random, optimum: of random actions, and the optimal return; None where not known.
    """

    robot: str
    arm: str
    mean: float
    low: float | None
    high: float | None
    random: float | None
    optimum: float | None
    policies: tuple[float, ...] = ()


def draw_headline(rows: Sequence[ArmReturns], *, narrow: bool = False) -> Figure:
    """A panel a robot, a line an arm: the policies with their interval, random actions, the optimal return.

    The axis reaches as far as returns do; an interval that goes on beyond it ends in an arrow. A narrow figure is as
    wide as a telephone, with the panels below each other.
    """
    robots = list(dict.fromkeys(row.robot for row in rows))
    most = max(sum(row.robot == robot for row in rows) for robot in robots)
    height_in = 1.2 + 0.34 * most
    figure = new_figure(3.6, height_in * len(robots)) if narrow else new_figure(4.6 * len(robots), height_in)
    shape = (len(robots), 1) if narrow else (1, len(robots))
    panels = list(figure.subplots(*shape, squeeze=False).flat)
    for axes, robot in zip(panels, robots, strict=True):
        own = [row for row in rows if row.robot == robot]
        style_axes(axes, robot, "mean return of an episode", "")
        every = [value for row in own for value in (row.mean, row.random, row.optimum, *row.policies)]
        known = [value for value in every if value is not None]
        # Every return, with some room for intervals on either side.
        room = 0.08 * (max(known) - min(known)) or 1.0
        left, right = min(known) - room, max(known) + room
        for place, row in enumerate(own):
            if row.random is not None:
                axes.plot(row.random, place, "x", color=GREY, markersize=6, label="random actions")
            if row.optimum is not None:
                axes.plot([row.optimum] * 2, [place - 0.3, place + 0.3], color=OPTIMUM, label="optimal return")
            if row.low is not None and row.high is not None:
                ends = np.clip([row.low, row.high], left, right)
                axes.plot(ends, [place] * 2, color=SKY, linewidth=3, label="95 % interval", zorder=1.5)
                for beyond, end, marker in ((row.low < left, left, "<"), (row.high > right, right, ">")):
                    if beyond:
                        axes.plot(end, place, marker, color=SKY, markersize=8, clip_on=False)
            axes.plot(
                row.policies, [place + 0.22] * len(row.policies), "o", color=BLUE, markersize=2.5, label="each policy"
            )
            axes.plot(row.mean, place, "o", color=BLUE, markersize=6, label="their interquartile mean")
        axes.set_xlim(left, right)
        axes.set_yticks(range(len(own)), [row.arm for row in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
        axes.grid(axis="x", linewidth=0.4, alpha=0.5)
    add_common_legend(figure, panels, columns=2 if narrow else 3 if len(robots) == 1 else 5)
    return figure
