"""Returns over time: learning curves, and returns at every recording of a culture, with and without shadowing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from animat.evaluation.statistics import CONFIDENCE
from animat.lazy import Figure
from animat.report.colours import BLUE, GREY, OPTIMUM, PALETTE
from animat.report.style import add_common_legend, grid_of_panels, style_axes, wrapped

_NARROW_IN, _WIDE_IN = 3.1, 4.6
"""Widths of a panel with a learning curve, and of one with returns at every recording."""
_MOST_ARMS = len(PALETTE)
"""The most arms in a panel, as there are no more colours."""


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """The learning curve of one arm.

    Attributes:
        iterations: done at the end of each chunk of training.
        returns: mean return of the episodes that ended by then (`over_rounds`), NaN if not known.
        random, optimum: random and optimal return with the simulator in use in each chunk, NaN if not known.
        within: the lowest and the highest possible return, which limit intervals.
    """

    name: str
    iterations: Float64[np.ndarray, " chunks"]
    returns: Float64[np.ndarray, "policies chunks"]
    random: Float64[np.ndarray, " chunks"]
    optimum: Float64[np.ndarray, " chunks"]
    within: tuple[float, float] = (-np.inf, np.inf)

    def mean_with_interval(self) -> Float64[np.ndarray, "3 chunks"]:
        """The mean over policies in each chunk and its 95 % interval by Student's t, NaN where too few have one."""
        from scipy.special import stdtrit

        known, (lowest, highest) = np.isfinite(self.returns), self.within
        n = known.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(known, self.returns, 0.0).sum(axis=0) / n
            variance = (np.where(known, self.returns - mean, 0.0) ** 2).sum(axis=0) / (n - 1)
            half = stdtrit(n - 1, (1 + CONFIDENCE) / 2) * np.sqrt(variance / n)
        return np.stack([mean, np.maximum(mean - half, lowest), np.minimum(mean + half, highest)])


def draw_learning_curves(curves: Sequence[LearningCurve], title: str) -> Figure:
    """One panel per arm: policies, their mean with its 95 % interval, random actions and the optimum."""
    columns = 2 if len(curves) == 4 else min(3, len(curves))
    figure, panels = grid_of_panels(len(curves), columns, _NARROW_IN, 2.4, title, share_x=True, share_y=True)
    for axes, curve in zip(panels, curves, strict=True):
        x = curve.iterations / 1000
        for of_policy in curve.returns:
            ended = np.isfinite(of_policy)
            axes.plot(x[ended], of_policy[ended], color=GREY, linewidth=0.5, alpha=0.6)
        # Parts in which no episode of any policy ended are skipped, not drawn as gaps.
        mean, low, high = curve.mean_with_interval()
        some = np.isfinite(mean)
        if np.isfinite(low).any():
            label = "95 % interval of the mean"
            axes.fill_between(x[some], low[some], high[some], color=BLUE, alpha=0.3, linewidth=0, label=label)
        single = "o" if np.count_nonzero(some) == 1 else ""
        axes.plot(x[some], mean[some], color=BLUE, linewidth=1.5, marker=single, label="mean of the policies")
        for name, levels, colour, line in (
            ("optimal return", curve.optimum, OPTIMUM, "--"),
            ("random actions", curve.random, GREY, ":"),
        ):
            if np.isfinite(levels).any():
                # A level holds up to the end of its chunk; the first chunk begins at 0.
                steps = np.append(0.0, x), np.append(levels[:1], levels)
                axes.step(*steps, where="pre", color=colour, linestyle=line, linewidth=1.2, label=name)
        style_axes(axes, wrapped(curve.name, _NARROW_IN), "iterations (thousands)", "return")
        axes.set_xlim(0, None)
    add_common_legend(figure, panels, columns=4 if columns == 3 else 2)
    return figure


def over_rounds(
    iterations: Float64[np.ndarray, " chunks"],
    episodes: Float64[np.ndarray, "policies chunks"],
    returns: Float64[np.ndarray, "policies chunks"],
    longest: int,
) -> Float64[np.ndarray, "policies chunks"]:
    """The mean return of the episodes that ended within the round before the end of each chunk.

    In a round every environment ends at least one episode. The episodes that end in a shorter time are a biased sample:
    first the short ones, which succeeded or failed early, and later the long ones, as environments that begin together
    stay in step. Before the end of the first round it is NaN; a training shorter than a round is one round.

    `iterations` are done at the end of each chunk, by all environments together; `episodes` end in each chunk, with the
    mean `returns`; `longest` are the iterations of a round: of the longest episode, times the number of environments.
    """
    longest_known = min(float(longest), float(iterations[-1]))
    # The number of chunks that ended at least a round before the end of each.
    before = np.searchsorted(iterations, iterations - longest_known, side="right")
    sums = [np.cumsum(of, axis=1) for of in (np.where(episodes > 0, episodes * returns, 0.0), episodes)]
    total, count = (np.concatenate([np.zeros((len(of), 1)), of], axis=1) for of in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (total[:, 1:] - total[:, before]) / (count[:, 1:] - count[:, before])
    return np.where(iterations >= longest_known, means, np.nan)


@dataclass(frozen=True, eq=False)
class Courses:
    """The mean returns of one mapping's policies at every recording, by arm, with random actions and the optimum.

    The optimum is on a coarse grid, NaN if it is not known; `fine_optimum` is on a fine grid at some of the minutes.
    """

    title: str
    minutes: Float64[np.ndarray, " recordings"]
    returns: Mapping[str, Float64[np.ndarray, "policies recordings"]]
    random: Float64[np.ndarray, " recordings"]
    optimum: Float64[np.ndarray, " recordings"]
    fine_optimum: Mapping[float, float] = field(default_factory=dict)

    def quartiles(self, arm: str) -> Float64[np.ndarray, "3 recordings"]:
        """Lower quartile, median and upper quartile over an arm's policies at each recording."""
        return np.asarray(np.quantile(self.returns[arm], [0.25, 0.5, 0.75], axis=0), np.float64)


def draw_returns_over_time(panels_of: Sequence[Courses], title: str, *, trained_until_min: float) -> Figure:
    """One panel per mapping: median and quartiles over policies of each of its first arms; training's end is marked."""
    figure, panels = grid_of_panels(len(panels_of), 2, _WIDE_IN, 3.4, title, share_x=True)
    names = list(dict.fromkeys(name for of in panels_of for name in list(of.returns)[:_MOST_ARMS]))
    for axes, of in zip(panels, panels_of, strict=True):
        minutes = of.minutes
        for name in list(of.returns)[:_MOST_ARMS]:
            # With more arms than colours over all panels, those of one colour have different markers.
            before, place = divmod(names.index(name), _MOST_ARMS)
            colour, marker = PALETTE[place], "os^Dv"[before % 5]
            low, middle, high = of.quartiles(name)
            axes.fill_between(minutes, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(minutes, middle, color=colour, marker=marker, markersize=3, label=name)
        if np.isfinite(of.optimum).any():
            label = "optimal return, coarse grid"
            axes.plot(minutes, of.optimum, color=OPTIMUM, linestyle="--", linewidth=1.3, label=label)
        if of.fine_optimum:
            points = list(of.fine_optimum), list(of.fine_optimum.values())
            axes.plot(*points, "D", color=OPTIMUM, markersize=4, label="optimal return, fine grid")
        axes.plot(minutes, of.random, color=GREY, linestyle=":", linewidth=1.3, label="random actions")
        axes.axvline(trained_until_min, color=GREY, linewidth=1.0, label="end of training")
        left_out = len(of.returns) - _MOST_ARMS
        more = f" ({left_out} more arms in the tables)" if left_out > 0 else ""
        style_axes(axes, wrapped(f"{of.title}{more}", _WIDE_IN), "recording (min)", "return")
    add_common_legend(figure, panels, columns=3)
    return figure
