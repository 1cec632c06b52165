"""Box plots of comparisons: every policy a point, with random, the optimum and the significance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.report.html import cell, with_minus
from animat.report.style import (
    BLACK,
    BLUE,
    GREY,
    OPTIMUM,
    ORANGE,
    Axes,
    Figure,
    add_common_legend,
    new_figure,
    style_axes,
)


@dataclass(frozen=True, eq=False)
class Group:
    """One side of a comparison.

    Attributes:
        name: the arm.
        returns: each policy's mean return, shape (policies,).
        random, optimum: of random actions, and the optimal return; None where not known.
        score: the normalised score of the policies' mean; None where not known.
    """

    name: str
    returns: Float64[np.ndarray, " policies"]
    random: float | None = None
    optimum: float | None = None
    score: float | None = None


@dataclass(frozen=True, eq=False)
class Pair:
    """A comparison.

    Attributes:
        title: with the minute it was made at.
        p: two-sided, corrected as in the table beside it.
        u: Mann-Whitney's.
    """

    title: str
    first: Group
    second: Group
    p: float
    u: float


def stars(p: float) -> str:
    """The usual marks: * below 0.05, ** below 0.01, *** below 0.001; n.s. from 0.05."""
    return "***" if p < 0.001 else "**" if p < 0.01 else "*" if p < 0.05 else "n.s."


def draw_comparisons(pairs: Sequence[Pair], title: str) -> Figure:
    """A column a comparison: above with random actions (dotted) and the optimal return (dashed), below close up.

    Boxes reach from the first to the third quartile with the median, whiskers to 1.5 times that range; policies are
    points. All pairs are of one robot; at least one is given.
    """
    figure = new_figure(max(2.7 * len(pairs), 4.5), 6.4)
    figure.suptitle(title, fontsize=10)
    rows = figure.subplots(2, len(pairs), squeeze=False, height_ratios=[1.0, 0.9])
    for whole, close, pair in zip(rows[0], rows[1], pairs, strict=True):
        for place, (group, colour) in enumerate(((pair.first, ORANGE), (pair.second, BLUE))):
            _draw_boxes(whole, group, place, colour)
            _draw_references(whole, group, place)
            _draw_boxes(close, group, place, colour)
        low, high = whole.get_ylim()
        room = high - low
        whole.plot([0, 0, 1, 1], high + room * np.array([0.03, 0.06, 0.06, 0.03]), color=BLACK, linewidth=0.9)
        words = f"{stars(pair.p)}  p corrected = {cell(pair.p)}, U = {pair.u:g}"
        whole.text(0.5, high + 0.08 * room, words, ha="center", va="bottom", fontsize=8)
        whole.set_ylim(low, high + 0.2 * room)
        for axes, words in ((whole, pair.title), (close, "close up")):
            axes.set_xlim(-0.6, 1.6)
            axes.set_xticks([0, 1], [_name(group) for group in (pair.first, pair.second)])
            style_axes(axes, words, "", "mean return of a policy")
    add_common_legend(figure, list(rows[0]), columns=2)
    return figure


def _name(group: Group) -> str:
    """The arm in two lines, and its score in a third."""
    name = group.name if " " in group.name else f"{group.name} "
    # Adding 0 takes the sign off a zero.
    score = "" if group.score is None else f"\nscore {round(group.score, 2) + 0.0:.2f}"
    return with_minus(name.replace(" ", "\n", 1) + score)


def _draw_boxes(axes: Axes, group: Group, place: int, colour: str) -> None:
    axes.boxplot(
        [group.returns],
        positions=[place],
        widths=0.5,
        showfliers=False,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.35, "linewidth": 0.8},
        medianprops={"color": BLACK, "linewidth": 1.2},
    )
    # Spread by rank, not at random: the same figure each time.
    sideways = np.zeros(len(group.returns))
    sideways[np.argsort(group.returns)] = 0.12 * np.resize([-1.0, 1.0, 0.0], len(group.returns))
    axes.scatter(place + sideways, group.returns, s=12, color=colour, edgecolors=BLACK, linewidths=0.4, zorder=3)


def _draw_references(axes: Axes, group: Group, place: int) -> None:
    ends = [place - 0.42, place + 0.42]
    if group.random is not None:
        axes.plot(ends, [group.random] * 2, color=GREY, linewidth=1.3, linestyle=":", label="random actions")
    if group.optimum is not None:
        axes.plot(ends, [group.optimum] * 2, color=OPTIMUM, linewidth=1.3, linestyle="--", label="optimal return")
