"""Figures of mean returns: of every arm, of comparisons, over many cultures, and of trained policies and controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from animat.lazy import Axes, Figure
from animat.report.colours import BLACK, BLUE, GREY, OPTIMUM, ORANGE, SKY
from animat.report.html import cell, with_minus
from animat.report.results import TRAINED, ComparedReturns, ControlReturns, OverCultures, Score
from animat.report.style import add_common_legend, grid_of_panels, new_figure, style_axes, wrapped

_WIDE_IN, _NARROW_IN = 2.3, 1.2
"""Widths of a name beside a panel, of which there are two in a row, and of an arm's, as two stand under a panel."""


def draw_headline(rows: Sequence[tuple[Score, Float64[np.ndarray, " policies"]]], *, narrow: bool = False) -> Figure:
    """One panel per robot, one row per arm: the policies with their interval, random actions, the optimal return.

    The axis covers all returns; an interval that extends beyond it ends in an arrow. A narrow figure is as wide as a
    phone, with the panels below each other. Each score comes with the mean return of each policy.
    """
    robots = dict.fromkeys(row.robot for row, _ in rows)
    by_robot = {robot: [each for each in rows if each[0].robot == robot] for robot in robots}
    names = {row.arm: wrapped(row.arm, _WIDE_IN) for row, _ in rows}
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
            _draw_score(axes, place, row, policies, left, right)
        axes.set_xlim(left, right)
        axes.set_yticks(range(len(own)), [names[row.arm] for row, _ in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
        axes.grid(axis="x", linewidth=0.4, alpha=0.5)
    add_common_legend(figure, panels, columns=2 if narrow else 3 if n == 1 else 5)
    return figure


def _draw_score(
    axes: Axes, place: int, row: Score, policies: Float64[np.ndarray, " policies"], left: float, right: float
) -> None:
    """A row of the headline, on an axis from left to right; `policies` are their mean returns."""
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
        axes.set_yticks(range(len(own)), [wrapped(row.comparison, _WIDE_IN) for row, _ in own])
        axes.set_ylim(len(own) - 0.5, -0.5)
    add_common_legend(figure, panels, columns=3)
    return figure


class Pair(NamedTuple):
    """A comparison with each policy's mean return, and that of random actions in the first arm if it is known."""

    row: ComparedReturns
    first: Float64[np.ndarray, " policies"]
    second: Float64[np.ndarray, " policies"]
    random_first: float | None


def draw_comparisons(pairs: Sequence[Pair], title: str) -> Figure:
    """One column per comparison: above with random actions (dotted) and the optimal return (dashed), below enlarged.

    `pairs` has at least one comparison, all on one robot.
    """
    figure = new_figure(max(2.7 * len(pairs), 4.5), 6.4, title)
    rows = figure.subplots(2, len(pairs), squeeze=False, height_ratios=[1.0, 0.9])
    for whole, close, pair in zip(*rows, pairs, strict=True):
        row = pair.row
        sides = (
            (pair.first, pair.random_first, row.optimum_first, ORANGE),
            (pair.second, row.random_second, row.optimum_second, BLUE),
        )
        for place, (returns, random, optimum, colour) in enumerate(sides):
            _draw_boxes(whole, returns, place, colour)
            _draw_boxes(close, returns, place, colour)
            ends = [place - 0.42, place + 0.42]
            if random is not None:
                whole.plot(ends, [random] * 2, color=GREY, linewidth=1.3, linestyle=":", label="random actions")
            if optimum is not None:
                whole.plot(ends, [optimum] * 2, color=OPTIMUM, linewidth=1.3, linestyle="--", label="optimal return")
        low, high = whole.get_ylim()
        room = high - low
        whole.plot([0, 0, 1, 1], high + room * np.array([0.03, 0.06, 0.06, 0.03]), color=BLACK, linewidth=0.9)
        p = row.p_holm
        stars = "***" if p < 0.001 else "**" if p < 0.01 else "*" if p < 0.05 else "n.s."
        label = f"{stars}  p corrected = {cell(p)}, U = {row.u:g}"
        whole.text(0.5, high + 0.08 * room, label, ha="center", va="bottom", fontsize=8)
        whole.set_ylim(low, high + 0.2 * room)
        for axes, heading in ((whole, f"at {row.at_min:g} min"), (close, "enlarged")):
            axes.set_xlim(-0.6, 1.6)
            axes.set_xticks([0, 1], [_arm_label(row.first, row.score_first), _arm_label(row.second, row.score_second)])
            style_axes(axes, heading, "", "mean return of a policy")
    add_common_legend(figure, list(rows[0]), columns=2)
    return figure


def _arm_label(arm: str, score: float | None) -> str:
    """The arm on two lines or more, and its score on the last."""
    first, _, rest = arm.partition(" ")
    lines = [wrapped(part, _NARROW_IN) for part in (first, rest)]
    scored = "" if score is None else f"\nscore {score:z.2f}"
    return with_minus("\n".join(lines) + scored)


def _draw_boxes(axes: Axes, returns: Float64[np.ndarray, " policies"], place: int, colour: str) -> None:
    box, median = {"facecolor": colour, "alpha": 0.35, "linewidth": 0.8}, {"color": BLACK, "linewidth": 1.2}
    looks: dict[str, Any] = {"patch_artist": True, "boxprops": box, "medianprops": median}
    axes.boxplot([returns], positions=[place], widths=0.5, showfliers=False, **looks)
    # Spread by rank, not at random, so that the figure is the same each time.
    sideways = np.zeros(len(returns))
    sideways[np.argsort(returns)] = 0.12 * np.resize([-1.0, 1.0, 0.0], len(returns))
    axes.scatter(place + sideways, returns, s=12, color=colour, edgecolors=BLACK, linewidths=0.4, zorder=3)


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
