"""Learning curves: the return, over policies, of the episodes that ended within one whole round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.report.style import BLUE, GREY, OPTIMUM, add_common_legend, grid_of_panels, style_axes, wrapped

_RESAMPLES = 2000
_WIDE_IN = 3.1
"""Width of a panel."""


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """The learning curve of one arm.

    Attributes:
        iterations: done at the end of each chunk of training.
        returns: mean return of the episodes that ended by then (`over_rounds`), NaN if not known.
        random, optimum: return of random actions and optimal return with the simulator in use in each chunk, NaN if not
            known; None if known for no chunk.
    """

    name: str
    iterations: Float64[np.ndarray, " chunks"]
    returns: Float64[np.ndarray, "policies chunks"]
    random: Float64[np.ndarray, " chunks"] | None = None
    optimum: Float64[np.ndarray, " chunks"] | None = None


def draw_learning_curves(curves: Sequence[LearningCurve], title: str) -> Figure:
    """One panel per arm: policies, their mean with its 95 % bootstrap interval, random actions and the optimum."""
    columns = 2 if len(curves) == 4 else min(3, len(curves))
    figure, panels = grid_of_panels(len(curves), columns, _WIDE_IN, 2.4, title, share_x=True, share_y=True)
    for axes, curve in zip(panels, curves, strict=True):
        x = curve.iterations / 1000
        for of_policy in curve.returns:
            ended = np.isfinite(of_policy)
            axes.plot(x[ended], of_policy[ended], color=GREY, linewidth=0.5, alpha=0.6)
        # Parts in which no episode of any policy ended are skipped, not drawn as gaps.
        mean, low, high = mean_with_interval(curve.returns)
        some = np.isfinite(mean)
        label = "95 % interval of the mean"
        axes.fill_between(x[some], low[some], high[some], color=BLUE, alpha=0.3, linewidth=0, label=label)
        single = "o" if np.count_nonzero(some) == 1 else ""
        axes.plot(x[some], mean[some], color=BLUE, linewidth=1.5, marker=single, label="mean of the policies")
        for name, levels, colour, line in (
            ("optimal return", curve.optimum, OPTIMUM, "--"),
            ("random actions", curve.random, GREY, ":"),
        ):
            if levels is not None:
                # A level holds up to the end of its chunk; the first chunk begins at 0.
                steps = np.append(0.0, x), np.append(levels[:1], levels)
                axes.step(*steps, where="pre", color=colour, linestyle=line, linewidth=1.2, label=name)
        style_axes(axes, wrapped(curve.name, _WIDE_IN), "iterations (thousands)", "return")
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
    stay in step.

    Args:
        iterations: done at the end of each chunk, by all environments together.
        episodes, returns: the number of episodes that ended in each chunk, and their mean return.
        longest: iterations of a round: those of the longest possible episode, times the number of environments.

    Returns:
        Mean returns; NaN before the end of the first round. If training is shorter than a round, all of it is one.
    """
    longest_known = min(float(longest), float(iterations[-1]))
    # The number of chunks that ended at least a round before the end of each.
    before = np.searchsorted(iterations, iterations - longest_known, side="right")
    sums = [np.cumsum(of, axis=1) for of in (np.where(episodes > 0, episodes * returns, 0.0), episodes)]
    total, count = (np.concatenate([np.zeros((len(of), 1)), of], axis=1) for of in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (total[:, 1:] - total[:, before]) / (count[:, 1:] - count[:, before])
    return np.where(iterations >= longest_known, means, np.nan)


def mean_with_interval(
    returns: Float64[np.ndarray, "policies chunks"],
) -> tuple[Float64[np.ndarray, " chunks"], Float64[np.ndarray, " chunks"], Float64[np.ndarray, " chunks"]]:
    """The mean over policies in each chunk and its 95 % bootstrap interval; NaN if no episode of any policy ended.

    The same resampled policies are used in all chunks, as each policy is one sample.
    """
    known = np.isfinite(returns)
    filled = np.where(known, returns, 0.0)
    counts = np.random.default_rng(0).multinomial(len(returns), np.full(len(returns), 1 / len(returns)), _RESAMPLES)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=0) / known.sum(axis=0)
        resampled = (counts @ filled) / (counts @ known)
    # Where no episode of the resampled policies ended, the mean replaces theirs.
    low, high = np.quantile(np.where(np.isfinite(resampled), resampled, mean), [0.025, 0.975], axis=0)
    return mean, low, high
