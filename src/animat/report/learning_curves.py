"""Learning curves: the return of the episodes that ended within one whole round of them, over the policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.report.style import BLUE, GREY, OPTIMUM, Figure, add_common_legend, grid_of_panels, style_axes

_RESAMPLES = 2000


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """One arm's.

    Attributes:
        name: the arm.
        iterations: done at the end of each part of training, shape (parts,).
        returns: mean return of the episodes that ended by then (`over_rounds`), NaN where not known, shape
            (policies, parts).
        random, optimum: of random actions and optimal with the simulator in use in each part, NaN where not
            known, shape (parts,); None where known of none.
    """

    name: str
    iterations: Float64[np.ndarray, " parts"]
    returns: Float64[np.ndarray, "policies parts"]
    random: Float64[np.ndarray, " parts"] | None = None
    optimum: Float64[np.ndarray, " parts"] | None = None


def draw_learning_curves(curves: Sequence[LearningCurve], title: str) -> Figure:
    """A panel for each arm: every policy thin, their mean with its 95 % bootstrap interval, random and the optimum."""
    columns = 2 if len(curves) == 4 else min(3, len(curves))
    figure, panels = grid_of_panels(len(curves), columns, 3.1, 2.4, title, share_x=True, share_y=True)
    for axes, curve in zip(panels, curves, strict=True):
        x = curve.iterations / 1000
        for of_policy in curve.returns:
            ended = np.isfinite(of_policy)
            axes.plot(x[ended], of_policy[ended], color=GREY, linewidth=0.5, alpha=0.6)
        # Parts in which no episode of any policy ended are passed over, not drawn as gaps.
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
                # A part goes up to its end, the first one from 0.
                steps = np.append(0.0, x), np.append(levels[:1], levels)
                axes.step(*steps, where="pre", color=colour, linestyle=line, linewidth=1.2, label=name)
        style_axes(axes, curve.name, "iterations (thousands)", "return")
        axes.set_xlim(0, None)
    add_common_legend(figure, panels, columns=4 if columns == 3 else 2)
    return figure


def over_rounds(
    iterations: Float64[np.ndarray, " parts"],
    episodes: Float64[np.ndarray, "policies parts"],
    returns: Float64[np.ndarray, "policies parts"],
    longest: int,
) -> Float64[np.ndarray, "policies parts"]:
    """The mean return of the episodes that ended in the parts before and with each that make up a round.

    In a round every environment ends at least one episode. The episodes that end in less are no fair sample: first the
    short ones, which have reached what they were to reach or have failed, and in turn the long ones, as environments
    that begin together go on in step.

    Args:
        iterations: done at the end of each part, of all environments together.
        episodes: that ended in each.
        returns: their mean; NaN where none did.
        longest: iterations in which every environment ends an episode: those of the longest one, times environments.

    Returns:
        NaN before the first whole round; where training is no longer than that, all of it is one.
    """
    longest_known = min(float(longest), float(iterations[-1]))
    # Parts that ended at least a round before the end of each.
    before = np.searchsorted(iterations, iterations - longest_known, side="right")
    sums = [np.cumsum(of, axis=1) for of in (np.where(episodes > 0, episodes * returns, 0.0), episodes)]
    total, count = (np.concatenate([np.zeros((len(of), 1)), of], axis=1) for of in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = (total[:, 1:] - total[:, before]) / (count[:, 1:] - count[:, before])
    return np.where(iterations >= longest_known, means, np.nan)


def mean_with_interval(
    returns: Float64[np.ndarray, "policies parts"],
) -> tuple[Float64[np.ndarray, " parts"], Float64[np.ndarray, " parts"], Float64[np.ndarray, " parts"]]:
    """The mean over policies in each part and its 95 % bootstrap interval; NaN where no episode of any ended.

    Policies are drawn again with the same luck in all parts, as each is one sample.
    """
    known = np.isfinite(returns)
    filled = np.where(known, returns, 0.0)
    often = np.random.default_rng(0).multinomial(len(returns), np.full(len(returns), 1 / len(returns)), _RESAMPLES)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=0) / known.sum(axis=0)
        resampled = (often @ filled) / (often @ known)
    some = np.isfinite(resampled)
    # A part in which no episode of the drawn policies ended says nothing; the mean stands for it.
    any_ended = np.isfinite(mean)
    low, high = np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    drawn = np.where(some, resampled, mean)[:, any_ended]
    low[any_ended], high[any_ended] = np.quantile(drawn, [0.025, 0.975], axis=0)
    return mean, low, high
