"""Returns at every recording of a culture: the effect of drift on policies, with and without shadowing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.report.style import GREY, OPTIMUM, PALETTE, add_common_legend, grid_of_panels, style_axes, wrapped

_WIDE_IN = 4.6
"""Width of a panel."""
_MOST = len(PALETTE)
"""The most arms in a panel, as there are no more colours."""


@dataclass(frozen=True, eq=False)
class Courses:
    """The arms of one mapping over time, with their common return of random actions and optimal return.

    Attributes:
        title: the mapping.
        minutes: of the recordings.
        returns: mean return of each policy at each recording, by the arm's name.
        random: return of random actions at each recording.
        optimum: optimal return on a coarse grid at each recording; None if not known.
        fine_optimum: optimal return on a fine grid at some of the minutes.
    """

    title: str
    minutes: Float64[np.ndarray, " recordings"]
    returns: Mapping[str, Float64[np.ndarray, "policies recordings"]]
    random: Float64[np.ndarray, " recordings"]
    optimum: Float64[np.ndarray, " recordings"] | None = None
    fine_optimum: Mapping[float, float] = field(default_factory=dict)


def quartiles(returns: Float64[np.ndarray, "policies recordings"]) -> Float64[np.ndarray, "3 recordings"]:
    """Lower quartile, median and upper quartile over policies at each recording."""
    return np.asarray(np.quantile(returns, [0.25, 0.5, 0.75], axis=0), np.float64)


def draw_over_time(panels_of: Sequence[Courses], title: str, *, trained_until_min: float) -> Figure:
    """One panel per mapping: median and quartiles over policies of each of its first arms; training's end is marked."""
    figure, panels = grid_of_panels(len(panels_of), 2, _WIDE_IN, 3.4, title, share_x=True)
    names = list(dict.fromkeys(name for of in panels_of for name in list(of.returns)[:_MOST]))
    for axes, of in zip(panels, panels_of, strict=True):
        minutes = of.minutes
        for name, returns in list(of.returns.items())[:_MOST]:
            # With more arms than colours over all panels, those of one colour have different markers.
            before, place = divmod(names.index(name), _MOST)
            colour, marker = PALETTE[place], "os^Dv"[before % 5]
            low, middle, high = quartiles(returns)
            axes.fill_between(minutes, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(minutes, middle, color=colour, marker=marker, markersize=3, label=name)
        if of.optimum is not None:
            label = "optimal return, coarse grid"
            axes.plot(minutes, of.optimum, color=OPTIMUM, linestyle="--", linewidth=1.3, label=label)
        if of.fine_optimum:
            points = list(of.fine_optimum), list(of.fine_optimum.values())
            axes.plot(*points, "D", color=OPTIMUM, markersize=4, label="optimal return, fine grid")
        axes.plot(minutes, of.random, color=GREY, linestyle=":", linewidth=1.3, label="random actions")
        axes.axvline(trained_until_min, color=GREY, linewidth=1.0, label="end of training")
        left_out = len(of.returns) - _MOST
        more = f" ({left_out} more arms in the tables)" if left_out > 0 else ""
        style_axes(axes, wrapped(f"{of.title}{more}", _WIDE_IN), "recording (min)", "return")
    add_common_legend(figure, panels, columns=3)
    return figure
