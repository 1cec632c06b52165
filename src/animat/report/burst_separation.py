"""Four panels that show whether bursts are separate from other responses."""

from __future__ import annotations

import numpy as np

from animat.errors import counted
from animat.lazy import Axes, Figure
from animat.report.response_histograms import even_edges, rate_edges
from animat.report.style import BLACK, BLUE, BURST, NON_BURST, add_legend, new_figure, style_axes
from animat.responses.responses import Responses

_RATE = "response x (Hz per channel)"
_RATIO = "ratio of active channels (fraction)"
_NONE = "no response is set apart as a burst"


def draw_burst_separation(responses: Responses) -> Figure:
    """Panels: all x; x against the ratio of active channels; that ratio with the threshold; x against it, labelled.

    If no response is a burst, there is no threshold and no fourth panel.
    """
    n_bursts, n_channels = int(np.count_nonzero(responses.is_burst)), responses.n_channels
    figure = new_figure(9.0, 6.8) if n_bursts else new_figure(12.0, 3.6)
    all_x, plain, ratios, *more = figure.subplots(2, 2).flat if n_bursts else figure.subplots(1, 3)
    all_x.hist(responses.rate_hz, bins=rate_edges(responses, responses.rate_hz, 40).tolist(), color=BLUE)
    style_axes(all_x, counted(len(responses), "response"), _RATE, "responses (count)")
    _scatter(plain, responses, slice(None), BLUE, None)
    style_axes(plain, "response against active channels", _RATIO, _RATE)
    # One bar for every possible ratio, k/N, up to 40 bars.
    ratios.hist(responses.active_ratio, even_edges(responses.active_ratio, 1 / n_channels, 40).tolist(), color=BLUE)
    style_axes(ratios, f"separability {responses.separability:.2f}" if n_bursts else _NONE, _RATIO, "responses (count)")
    for labelled in more:
        _scatter(labelled, responses, ~responses.is_burst, NON_BURST, f"non-burst ({len(responses) - n_bursts:,})")
        _scatter(labelled, responses, responses.is_burst, BURST, f"burst ({n_bursts:,})")
        style_axes(labelled, "bursts set apart", _RATIO, _RATE)
    for axes in (ratios, *more) if n_bursts else ():
        # Between the largest ratio that is not a burst and the next possible one.
        label = f"threshold {responses.threshold:.3f}"
        axes.axvline(responses.threshold + 0.5 / n_channels, color=BLACK, linestyle="--", linewidth=1, label=label)
        add_legend(axes, loc="best", markerscale=2)
        for handle in axes.get_legend().legend_handles:
            handle.set_alpha(1)
    return figure


def _scatter(axes: Axes, responses: Responses, which: np.ndarray | slice, colour: str, label: str | None) -> None:
    x, y, alpha = responses.active_ratio[which], responses.rate_hz[which], 0.6 if len(responses) > 300 else 0.9
    axes.scatter(x, y, s=9, alpha=alpha, color=colour, linewidths=0, label=label, rasterized=True)
