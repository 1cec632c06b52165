"""How a culture changes from recording to recording: percentiles, control, bursts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.lazy import Figure
from animat.report.style import BLACK, GREY, RED, add_legend, condition_colours, new_figure, style_axes
from animat.responses.responses import Responses

PERCENTILES = (10, 25, 50, 75, 90)
"""Percentiles of the responses that are drawn."""
_MOST_CONDITIONS = 12


@dataclass(frozen=True, eq=False)
class Drift:
    """Changes from recording to recording; NaN if there are no responses.

    Attributes:
        minutes: starts of the recordings.
        percentiles_hz: `PERCENTILES` of the pooled non-burst responses.
        shares: P(x >= P50) of each condition.
        bursts: share of the responses that are bursts.
    """

    minutes: Float64[np.ndarray, " recordings"]
    percentiles_hz: Float64[np.ndarray, "recordings percentiles"]
    shares: Float64[np.ndarray, "recordings conditions"]
    bursts: Float64[np.ndarray, " recordings"]


def drift_of(series: Sequence[Responses]) -> Drift:
    """The numbers of the figure, from responses with the same conditions in order of time."""
    pooled = [responses.non_burst_rate_hz for responses in series]
    unknown = np.full(len(PERCENTILES), np.nan)
    return Drift(
        np.array([responses.start_min for responses in series]),
        np.array([np.percentile(x, PERCENTILES) if len(x) else unknown for x in pooled]),
        np.array([responses.shares_above_median() for responses in series]),
        np.array([np.mean(responses.is_burst) if len(responses) else np.nan for responses in series]),
    )


def draw_drift(series: Sequence[Responses]) -> Figure:
    """`drift_of` a series: pooled percentiles, P(x >= P50) of at most 12 conditions, and the share of bursts."""
    drift = drift_of(series)
    minutes, percentiles = drift.minutes, drift.percentiles_hz
    figure = new_figure(7.0, 7.5)
    upper, middle, lower = figure.subplots(3, 1, sharex=True, height_ratios=[1.3, 1.3, 0.7])

    for low, high, alpha in ((0, 4, 0.2), (1, 3, 0.35)):
        label = f"P{PERCENTILES[low]} to P{PERCENTILES[high]}"
        upper.fill_between(minutes, *percentiles.T[[low, high]], color=GREY, alpha=alpha, linewidth=0, label=label)
    upper.plot(minutes, percentiles[:, 2], color=BLACK, marker="o", markersize=3, label="P50")
    upper.set_ylim(0, None)
    style_axes(upper, "percentiles of all non-burst responses", "", "response x (Hz per channel)")
    add_legend(upper, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    conditions = series[0].conditions[:_MOST_CONDITIONS]
    colours = condition_colours([condition.unit for condition in conditions])
    for i, condition in enumerate(conditions):
        line = {"color": colours[i], "marker": "o", "markersize": 3, "clip_on": False}
        middle.plot(minutes, drift.shares[:, i], label=condition.label, **line)
    middle.axhline(0.5, color=GREY, linewidth=0.8, linestyle="--")
    middle.set_ylim(0, 1)
    left_out = len(series[0].conditions) - len(conditions)
    title = "how far conditions differ" + (f"; {left_out} more are not drawn" if left_out else "")
    style_axes(middle, title, "", "P(x ≥ P50)")
    add_legend(middle, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    lower.plot(minutes, drift.bursts, color=RED, marker="o", markersize=3, clip_on=False)
    lower.set_ylim(0, max(0.1, 1.1 * float(np.nan_to_num(drift.bursts).max())))
    style_axes(lower, "responses that are bursts", "start of the recording (min)", "share")
    return figure
