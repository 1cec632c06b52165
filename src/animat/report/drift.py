"""How a culture changes from recording to recording: percentiles, control, bursts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.report.colours import BLACK, GREY, RED, condition_colours
from animat.report.style import add_legend, new_figure, style_axes
from animat.responses.responses import Responses

PERCENTILES = (10, 25, 50, 75, 90)
"""Percentiles of the responses that are drawn."""
_MOST_CONDITIONS = 12


def drift_of(series: Sequence[Responses]) -> Float64[np.ndarray, "recordings columns"]:
    """A row per recording: its start (min), `PERCENTILES` of its non-burst responses (Hz), and the share of bursts.

    Without responses they are NaN. The responses are in order of time, with the same conditions.
    """
    rows = []
    for responses in series:
        x, bursts = responses.non_burst_rate_hz, responses.is_burst
        percentiles = np.percentile(x, PERCENTILES) if len(x) else [np.nan] * len(PERCENTILES)
        rows.append([responses.start_min, *percentiles, np.mean(bursts) if len(bursts) else np.nan])
    return np.array(rows, np.float64)


def draw_drift(series: Sequence[Responses]) -> Figure:
    """`drift_of` a series: pooled percentiles, P(x >= P50) of at most 12 conditions, and the share of bursts."""
    minutes, *percentiles, bursts = drift_of(series).T
    shares = np.array([responses.shares_above_median() for responses in series])
    figure = new_figure(7.0, 7.5)
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=[1.3, 1.3, 0.7])

    for low, high, alpha in ((0, 4, 0.2), (1, 3, 0.35)):
        ends, label = (percentiles[low], percentiles[high]), f"P{PERCENTILES[low]} to P{PERCENTILES[high]}"
        upper.fill_between(minutes, *ends, color=GREY, alpha=alpha, linewidth=0, label=label)
    upper.plot(minutes, percentiles[2], color=BLACK, marker="o", markersize=3, label="P50")
    upper.set_ylim(0, None)
    style_axes(upper, "percentiles of all non-burst responses", "", "response x (Hz per channel)")
    add_legend(upper, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    conditions = series[0].conditions[:_MOST_CONDITIONS]
    colours = condition_colours([condition.unit for condition in conditions])
    for i, condition in enumerate(conditions):
        line = {"color": colours[i], "marker": "o", "markersize": 3, "clip_on": False}
        middle.plot(minutes, shares[:, i], label=condition.label, **line)
    middle.axhline(0.5, color=GREY, linewidth=0.8, linestyle="--")
    middle.set_ylim(0, 1)
    left_out = len(series[0].conditions) - len(conditions)
    title = "how far conditions differ" + (f"; {left_out} more are not drawn" if left_out else "")
    style_axes(middle, title, "", "P(x ≥ P50)")
    add_legend(middle, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    lower.plot(minutes, bursts, color=RED, marker="o", markersize=3, clip_on=False)
    lower.set_ylim(0, max(0.1, 1.1 * float(np.nan_to_num(bursts).max())))
    style_axes(lower, "responses that are bursts", "start of the recording (min)", "share")
    return figure
