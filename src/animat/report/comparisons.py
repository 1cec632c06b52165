"""Box plots of comparisons, with one point per policy, random actions, the optimum and the significance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from animat.lazy import Axes, Figure
from animat.report.html import cell, with_minus
from animat.report.results import ComparedReturns
from animat.report.style import BLACK, BLUE, GREY, OPTIMUM, ORANGE, add_common_legend, new_figure, style_axes, wrapped

_NAME_WIDE_IN = 1.2
"""Width of an arm's name, as two stand side by side under a panel."""


class Pair(NamedTuple):
    """A comparison with each policy's mean return, and that of random actions in the first arm if it is known."""

    row: ComparedReturns
    first: Float64[np.ndarray, " policies"]
    second: Float64[np.ndarray, " policies"]
    random_first: float | None


def stars(p: float) -> str:
    """The usual marks: * below 0.05, ** below 0.01, *** below 0.001; otherwise n.s."""
    return "***" if p < 0.001 else "**" if p < 0.01 else "*" if p < 0.05 else "n.s."


def draw_comparisons(pairs: Sequence[Pair], title: str) -> Figure:
    """One column per comparison: above with random actions (dotted) and the optimal return (dashed), below enlarged.

    Boxes reach from the first to the third quartile with the median, whiskers to 1.5 times that range; points are
    policies. `pairs` has at least one comparison, all on one robot.
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
            _draw_references(whole, random, optimum, place)
            _draw_boxes(close, returns, place, colour)
        low, high = whole.get_ylim()
        room = high - low
        whole.plot([0, 0, 1, 1], high + room * np.array([0.03, 0.06, 0.06, 0.03]), color=BLACK, linewidth=0.9)
        label = f"{stars(row.p_holm)}  p corrected = {cell(row.p_holm)}, U = {row.u:g}"
        whole.text(0.5, high + 0.08 * room, label, ha="center", va="bottom", fontsize=8)
        whole.set_ylim(low, high + 0.2 * room)
        for axes, heading in ((whole, f"at {row.at_min:g} min"), (close, "enlarged")):
            axes.set_xlim(-0.6, 1.6)
            axes.set_xticks([0, 1], [_name(row.first, row.score_first), _name(row.second, row.score_second)])
            style_axes(axes, heading, "", "mean return of a policy")
    add_common_legend(figure, list(rows[0]), columns=2)
    return figure


def _name(arm: str, score: float | None) -> str:
    """The arm on two lines or more, and its score on the last."""
    first, _, rest = arm.partition(" ")
    lines = [wrapped(part, _NAME_WIDE_IN) for part in (first, rest)]
    # Adding 0 turns -0 into 0.
    scored = "" if score is None else f"\nscore {round(score, 2) + 0.0:.2f}"
    return with_minus("\n".join(lines) + scored)


def _draw_boxes(axes: Axes, returns: Float64[np.ndarray, " policies"], place: int, colour: str) -> None:
    axes.boxplot(
        [returns],
        positions=[place],
        widths=0.5,
        showfliers=False,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.35, "linewidth": 0.8},
        medianprops={"color": BLACK, "linewidth": 1.2},
    )
    # Spread by rank, not at random, so that the figure is the same each time.
    sideways = np.zeros(len(returns))
    sideways[np.argsort(returns)] = 0.12 * np.resize([-1.0, 1.0, 0.0], len(returns))
    axes.scatter(place + sideways, returns, s=12, color=colour, edgecolors=BLACK, linewidths=0.4, zorder=3)


def _draw_references(axes: Axes, random: float | None, optimum: float | None, place: int) -> None:
    ends = [place - 0.42, place + 0.42]
    if random is not None:
        axes.plot(ends, [random] * 2, color=GREY, linewidth=1.3, linestyle=":", label="random actions")
    if optimum is not None:
        axes.plot(ends, [optimum] * 2, color=OPTIMUM, linewidth=1.3, linestyle="--", label="optimal return")
