"""Response histograms of every condition at the start and at the end of a series, with P50 of each."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from animat.report.response_histograms import rate_edges
from animat.report.style import GREY, MEDIAN, Figure, add_legend, condition_colours, new_figure, style_axes
from animat.responses.responses import Responses

_BINS = 30
_MOST_PANELS = 12


def draw_first_and_last(series: Sequence[Responses]) -> Figure:
    """Non-burst responses of at most 12 conditions: filled in the first recording, as an outline in the last.

    All recordings, in the order of time, have the same conditions.
    """
    first, last = series[0], series[-1]
    conditions = first.conditions[:_MOST_PANELS]
    figure = new_figure(6.0, 1.0 + 1.3 * max(len(conditions), 1))
    panels = figure.subplots(max(len(conditions), 1), 1, sharex=True, squeeze=False)[:, 0]
    colours = condition_colours([condition.unit for condition in first.conditions])
    edges_hz = rate_edges(first, np.concatenate([first.non_burst_rate_hz, last.non_burst_rate_hz]), _BINS)
    for i, (axes, condition) in enumerate(zip(panels, conditions, strict=False)):
        for responses, filled in ((first, True), (last, False)):
            x = responses.rates_of(i)
            share = np.histogram(x, edges_hz)[0] / max(len(x), 1)
            colour = colours[i] if filled else GREY
            label = f"{responses.start_min:g} min"
            axes.stairs(share, edges_hz, fill=filled, color=colour, linewidth=None if filled else 1.6, label=label)
            if math.isfinite(median_hz := responses.median_rate_hz):
                label, colour = f"P50 at {label}: {median_hz:.1f} Hz", MEDIAN if filled else GREY
                axes.axvline(median_hz, color=colour, linewidth=1.3, linestyle="--", label=None if i else label)
        before, after = (responses.shares_above_median()[i] for responses in (first, last))
        title = f"{condition.label}: P(x ≥ P50) {before:.2f} in the first, {after:.2f} in the last recording"
        style_axes(axes, title, "", "fraction")
        if i == 0:
            add_legend(axes, loc="upper right")
    left_out = len(first.conditions) - len(conditions)
    more = f"; {left_out} more conditions are not drawn" if left_out else ""
    figure.supxlabel(f"response x (Hz per channel){more}", fontsize=9)
    return figure
