"""Histograms of the responses to each condition, from which the neuron simulator draws."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from animat.report.style import BLACK, MEDIAN, Figure, add_legend, condition_colours, new_figure, style_axes, wrapped
from animat.responses.responses import Responses

_MOST_PANELS = 16
_BINS = 30
_WIDE_IN = 4.3
"""Width of a panel."""


def draw_response_histograms(responses: Responses, last: Responses | None = None) -> Figure:
    """Non-burst responses to every condition on a common axis, with P50, the median of all of them.

    At most 16 conditions are drawn, those with the most responses; the title says so. The last recording of a series,
    which has the same conditions, is drawn as outlines.
    """
    n = [len(responses.rates_of(i)) for i in range(len(responses.conditions))]
    drawn = sorted(sorted(range(len(n)), key=lambda i: -n[i])[:_MOST_PANELS])
    columns = 1 if len(drawn) <= 5 else 2
    rows = max(1, math.ceil(len(drawn) / columns))
    shares, titles = responses.shares_above_median(), {}
    for i in drawn:
        label, numbers = responses.conditions[i].label, f"n = {n[i]:,}"
        numbers += f", P(x ≥ P50) = {shares[i]:.2f}" if n[i] else ""
        titles[i] = wrapped(f"{label}: {numbers}", _WIDE_IN)
        if "\n" in titles[i]:
            titles[i] = f"{wrapped(label, _WIDE_IN)}:\n{numbers}"
    more_lines = max([title.count("\n") for title in titles.values()], default=0)
    figure = new_figure(5.0 * columns, 0.9 + (1.25 + 0.17 * more_lines) * rows if rows > 1 else 3.2)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False).T.reshape(-1)
    colours = condition_colours([condition.unit for condition in responses.conditions])
    rates_hz = [each.non_burst_rate_hz for each in (responses, last) if each is not None]
    edges_hz = rate_edges(responses, np.concatenate(rates_hz), _BINS)
    for axes, i in zip(panels, drawn, strict=False):
        x = responses.rates_of(i)
        weights, alpha = np.full(len(x), 1 / max(len(x), 1)), None if last is None else 0.7
        axes.hist(x, bins=edges_hz.tolist(), weights=weights, color=colours[i], alpha=alpha)
        style_axes(axes, titles[i], "", "fraction")
        if math.isfinite(responses.median_rate_hz):
            label = f"P50 = {responses.median_rate_hz:.3g} Hz"
            axes.axvline(responses.median_rate_hz, color=MEDIAN, linewidth=1.2, linestyle="--", label=label)
        if last is not None and math.isfinite(last.median_rate_hz):
            x = last.rates_of(i)
            axes.stairs(np.histogram(x, edges_hz)[0] / max(len(x), 1), edges_hz, color=BLACK, linewidth=1.2)
            label = f"P50 at {last.start_min:g} min = {last.median_rate_hz:.3g} Hz"
            axes.axvline(last.median_rate_hz, color=BLACK, linewidth=1.2, linestyle=":", label=label)
        if i == drawn[0] and axes.lines:
            add_legend(axes, loc="best")
    for axes in panels[len(drawn) :]:
        axes.set_visible(False)
    for column in range(columns):
        # The lowest panel has labels even if its column is not full.
        panels[min((column + 1) * rows, max(len(drawn), 1)) - 1].tick_params(labelbottom=True)
    figure.supxlabel("response x (Hz per channel)", fontsize=9)
    if left_out := len(n) - len(drawn):
        title = f"the {len(drawn)} conditions with the most responses; {left_out} more are not drawn"
        figure.suptitle(title, fontsize=9)
    return figure


def rate_edges(
    responses: Responses, rates_hz: Float64[np.ndarray, " some"], n_bins: int
) -> Float64[np.ndarray, " edges"]:
    """Edges of at most n_bins bins that each contain equally many of the possible rates.

    x is an integer number of spikes over (window x channels). Bins of any other width would contain varying numbers of
    its possible values, and show a comb that is not in the data.
    """
    start_ms, end_ms = responses.window_ms
    return even_edges(rates_hz, 1 / ((end_ms - start_ms) * 1e-3 * responses.n_channels), n_bins)


def even_edges(values: Float64[np.ndarray, " some"], step: float, n_bins: int) -> Float64[np.ndarray, " edges"]:
    """Edges of at most n_bins bins that each contain equally many multiples of `step`, as all values are."""
    most = round(float(values.max()) / step) if len(values) else 1
    per_bin = max(1, math.ceil((most + 1) / n_bins))
    return (np.arange(0, most + 1 + per_bin, per_bin) - 0.5) * step
