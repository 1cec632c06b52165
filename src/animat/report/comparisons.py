"""Box plots of comparisons: every policy a point, with random, the limit and the significance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from animat.report.style import BLACK, BLUE, GREY, LIMIT, ORANGE, grid_of_panels, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Group:
    """One side of a comparison.

    Attributes:
        name: the condition.
        returns: each policy's mean return, shape (policies,).
        random, limit: of random actions, and the best possible; None where not known.
    """

    name: str
    returns: Float64[np.ndarray, " policies"]
    random: float | None = None
    limit: float | None = None


@dataclass(frozen=True, eq=False)
class Pair:
    """A comparison.

    Attributes:
        title: with the minute it was made at.
        p: two-sided.
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
    """A panel a comparison: boxes from the first to the third quartile with the median, whiskers to 1.5 times that
    range, policies as points; random as a dotted line, the best possible return as a dashed one.

    Args:
        pairs: on one robot.
        title: of the whole figure.
    """
    figure, panels = grid_of_panels(len(pairs), 4, 2.7, 3.4, title)
    for axes, pair in zip(panels, pairs, strict=True):
        for place, (group, colour) in enumerate(((pair.first, ORANGE), (pair.second, BLUE))):
            _draw_group(axes, group, place, colour, label=place == 0)
        low, high = axes.get_ylim()
        room = high - low
        axes.plot([0, 0, 1, 1], high + room * np.array([0.03, 0.06, 0.06, 0.03]), color=BLACK, linewidth=0.9)
        words = f"{stars(pair.p)}  p = {pair.p:.3g}, U = {pair.u:g}"
        axes.text(0.5, high + 0.08 * room, words, ha="center", va="bottom", fontsize=8)
        axes.set_ylim(low, high + 0.2 * room)
        axes.set_xlim(-0.6, 1.6)
        axes.set_xticks([0, 1], [pair.first.name.replace(" ", "\n", 1), pair.second.name.replace(" ", "\n", 1)])
        style_axes(axes, pair.title, "", "mean return of a policy")
    if any(group.limit is not None for pair in pairs for group in (pair.first, pair.second)):
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _draw_group(axes: Axes, group: Group, place: int, colour: str, *, label: bool) -> None:
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
    ends = [place - 0.42, place + 0.42]
    if group.random is not None:
        name = "random actions" if label else None
        axes.plot(ends, [group.random] * 2, color=GREY, linewidth=1.3, linestyle=":", label=name)
    if group.limit is not None:
        name = "best possible return" if label else None
        axes.plot(ends, [group.limit] * 2, color=LIMIT, linewidth=1.3, linestyle="--", label=name)
