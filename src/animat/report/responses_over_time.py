"""The responses of one condition from recording to recording: fatigue, seen as a shift of the whole distribution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from animat.report.response_histograms import rate_edges
from animat.report.style import MEDIAN, new_figure, style_axes
from animat.responses.responses import Responses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BINS = 24
_MOST_ROWS = 20


def draw_responses_over_time(series: Sequence[Responses], condition: int) -> Figure:
    """Histograms of a condition's non-burst responses, one a recording, the first at the top; a mark at each median.

    At most 20 recordings are drawn, evenly over the series; the title says so.

    Args:
        series: responses of the recordings in the order of time, with the same conditions.
        condition: index of the condition.
    """
    from matplotlib import colormaps

    rows = np.unique(np.linspace(0, len(series) - 1, min(len(series), _MOST_ROWS)).round().astype(int))
    shown = [series[row] for row in rows]
    rates = [responses.rates_of(condition) for responses in shown]
    edges_hz = rate_edges(shown[0], np.concatenate(rates), _BINS)
    figure = new_figure(6.5, 1.4 + 0.34 * len(shown))
    axes = figure.subplots()
    shares = [np.histogram(x, edges_hz)[0] / max(len(x), 1) for x in rates]
    height = 0.92 / max(max(share.max() for share in shares), 1e-9)
    for row, (share, x) in enumerate(zip(shares, rates, strict=True)):
        base, colour = -float(row), colormaps["cividis"](0.88 * row / max(len(shown) - 1, 1))
        axes.stairs(base + height * share, edges_hz, baseline=base, fill=True, color=colour)
        if len(x):
            axes.plot([np.median(x)] * 2, [base, base + 0.92], color=MEDIAN, linewidth=1.6)
    axes.set_yticks([-float(row) for row in range(len(shown))], [f"{r.start_min:g}" for r in shown])
    axes.set_xlim(0, edges_hz[-1])
    axes.set_ylim(-len(shown) + 0.9, 1.0)
    thinned = "" if len(shown) == len(series) else f" ({len(shown)} of {len(series)} recordings)"
    title = f"{shown[0].conditions[condition].label}: non-burst responses over time{thinned}, medians marked"
    style_axes(axes, title, "response x (Hz per channel)", "start of the recording (min)")
    return figure
