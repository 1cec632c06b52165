"""How a culture changes from recording to recording: percentiles, control, bursts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from animat.neurons.responses import Responses
from animat.report.style import BLACK, BURST, GREY, add_legend, condition_colours, new_figure, style_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PERCENTILES = (10, 25, 50, 75, 90)
_MOST_CONDITIONS = 12


def draw_drift(series: Sequence[Responses]) -> Figure:
    """Against the minutes: the pooled percentiles, P(x >= P50) of each condition, and the share of bursts.

    Args:
        series: responses of the recordings in the order of time, with the same conditions. At most 12 conditions
            are drawn.
    """
    minutes = np.array([responses.start_min for responses in series])
    pooled = [responses.non_burst_rate_hz for responses in series]
    percentiles = np.array(
        [np.percentile(x, _PERCENTILES) if len(x) else np.full(len(_PERCENTILES), np.nan) for x in pooled]
    )
    shares = np.array([responses.shares_above_median() for responses in series])
    bursts = np.array([np.mean(r.is_burst) if len(r) else np.nan for r in series])
    figure = new_figure(7.0, 7.5)
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=[1.3, 1.3, 0.7])

    for low, high, alpha in ((0, 4, 0.2), (1, 3, 0.35)):
        upper.fill_between(
            minutes,
            percentiles[:, low],
            percentiles[:, high],
            color=GREY,
            alpha=alpha,
            linewidth=0,
            label=f"P{_PERCENTILES[low]} to P{_PERCENTILES[high]}",
        )
    upper.plot(minutes, percentiles[:, 2], color=BLACK, marker="o", markersize=3, label="P50")
    upper.set_ylim(0, None)
    style_axes(upper, "percentiles of all non-burst responses", "", "response x (Hz per channel)")
    add_legend(upper, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    conditions = series[0].conditions[:_MOST_CONDITIONS]
    colours = condition_colours([condition.unit for condition in series[0].conditions])
    for i, condition in enumerate(conditions):
        middle.plot(minutes, shares[:, i], color=colours[i], marker="o", markersize=3, label=condition.label)
    middle.axhline(0.5, color=GREY, linewidth=0.8, linestyle="--")
    middle.set_ylim(0, 1)
    left_out = len(series[0].conditions) - len(conditions)
    title = "how far conditions differ" + (f"; {left_out} more are not drawn" if left_out else "")
    style_axes(middle, title, "", "P(x ≥ P50)")
    add_legend(middle, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    lower.plot(minutes, bursts, color=BURST, marker="o", markersize=3)
    lower.set_ylim(0, max(0.1, 1.1 * float(np.nan_to_num(bursts).max())))
    style_axes(lower, "responses that are bursts", "start of the recording (min)", "share")
    return figure
