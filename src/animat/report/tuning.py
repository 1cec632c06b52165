"""A search: its history, with the return and training of every trial, and the importance of each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate

from animat.lazy import Figure
from animat.report.style import BLACK, BLUE, GREY, ORANGE, PURPLE, RED, SKY, add_common_legend, new_figure, style_axes

_MARKERS = "ov^sDP"


def draw_history(
    trials: Sequence[tuple[int, Sequence[int], Sequence[float]]],
    rungs: Sequence[int],
    best: tuple[int, float, float | None],
    own: tuple[float, float | None] | None,
    title: str,
) -> Figure:
    """One point per trial at its last mean return, by how far it was trained; the best full training so far; finals.

    Args:
        trials: number of each, and for each rung that it reached the chunks done and the mean return; none if diverged.
        rungs: chunks done at the end of each rung; the last is the full training.
        best: number of the best trial, its mean return when retrained, and the standard error.
        own: mean return and standard error of the initial settings, retrained; None if they diverged.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(7.0, 3.8)
    axes = figure.subplots()
    colours = (GREY, SKY, ORANGE, PURPLE, BLACK)[: len(rungs) - 1]
    whole = []
    for rung, (chunks, colour) in enumerate(zip(rungs, (*colours, BLUE), strict=True)):
        ended = [(number, means[-1]) for number, done, means in trials if done and done[-1] == chunks]
        is_whole = chunks == rungs[-1]
        if ended:
            label = "fully trained" if is_whole else f"stopped at {100 * chunks / rungs[-1]:.0f} %"
            marker, size = _MARKERS[len(rungs) - 1 - rung], 6 if is_whole else 4
            axes.plot(*zip(*ended, strict=True), marker, color=colour, markersize=size, label=label)
        whole = ended
    if whole:
        so_far = list(accumulate((mean for _, mean in whole), max))
        last = max(number for number, _, _ in trials)
        x = [*(number for number, _ in whole), last]
        axes.step(x, [*so_far, so_far[-1]], where="post", color=BLUE, linewidth=1.2, label="best fully trained so far")
    if diverged := [number for number, done, _ in trials if not done]:
        low = axes.get_ylim()[0]
        axes.plot(diverged, [low] * len(diverged), "x", color=RED, label="diverged")
    if own is not None:
        axes.axhline(own[0], color=BLACK, linestyle="--", linewidth=1, label="own settings, retrained")
    number, mean, error = best
    label = "best, retrained"
    axes.errorbar([number], [mean], yerr=[error or 0.0], fmt="*", color=RED, markersize=11, capsize=3, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style_axes(axes, title, "trial", "mean return of an episode")
    add_common_legend(figure, [axes], columns=3)
    return figure


def draw_importance(shares: Mapping[str, float], title: str) -> Figure:
    """One bar per setting; `shares` are in descending order and sum to 1."""
    figure = new_figure(6.0, 1.1 + 0.27 * len(shares))
    axes = figure.subplots()
    places = range(0, -len(shares), -1)
    percent = [100 * share for share in shares.values()]
    axes.barh(places, percent, height=0.65, color=BLUE)
    for place, share in zip(places, percent, strict=True):
        axes.annotate(f"{share:.0f}", (share, place), (3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, list(shares))
    axes.set_xlim(0, max(1.0, 1.1 * max(percent)))
    style_axes(axes, title, "importance (%)", "")
    return figure
