"""Histograms of responses: to each condition, from which the neuron simulator draws, over time, and of bursts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from animat.errors import counted
from animat.lazy import Axes, Figure
from animat.report.colours import BLACK, BLUE, MEDIAN, RED, condition_colours
from animat.report.style import add_legend, new_figure, style_axes, wrapped
from animat.responses.responses import Responses
from animat.tables import evenly

_MOST_PANELS, _BINS = 16, 30
_WIDE_IN = 4.3
"""Width of a panel."""
_RATE = "response x (Hz per channel)"
_RATIO = "ratio of active channels (fraction)"
_NONE = "no response is set apart as a burst"
_MOST_ROWS, _MOST_COLUMNS, _BINS_OVER_TIME = 20, 8, 24
"""Of the figure over time: recordings, conditions, and bins of each histogram."""


def draw_response_histograms(responses: Responses, last: Responses | None = None) -> Figure:
    """Non-burst responses to every condition on a common axis, with P50, the median of all of them.

    At most 16 conditions are drawn, those with the most responses, up to 1.5 times the 99th percentile of all
    responses; the title states what is left out. `last`, with the same conditions, is outlined.
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
    edges_hz, beyond = _edges_of_most(responses, np.concatenate(rates_hz), _BINS)
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
    figure.supxlabel(_RATE, fontsize=9)
    more = len(n) - len(drawn)
    few = f"the {len(drawn)} conditions with the most responses; {more} more are not drawn" if more else ""
    if few or beyond:
        figure.suptitle("\n".join(filter(None, [few, beyond])), fontsize=9)
    return figure


def draw_responses_over_time(series: Sequence[Responses]) -> Figure:
    """One column per condition, one row per recording, the first at the top: non-burst responses and their median.

    At most 20 recordings, evenly over the series, and 8 conditions are drawn, up to 1.5 times the 99th percentile of
    all responses; the title states what is left out. Recordings are in order of time and have the same conditions.
    """
    shown = [series[row] for row in evenly(len(series), _MOST_ROWS)]
    conditions = shown[0].conditions[:_MOST_COLUMNS]
    rates = [[responses.rates_of(i) for responses in shown] for i in range(len(conditions))]
    all_hz = np.concatenate([x for of in rates for x in of])
    edges_hz, beyond = _edges_of_most(shown[0], all_hz, _BINS_OVER_TIME)
    columns = len(conditions) if len(conditions) <= 5 else 4
    down = -(-len(conditions) // columns)
    wide_in = 2.2 if columns <= 4 else 1.9
    titles = [wrapped(condition.label, wide_in) for condition in conditions]
    more_lines = max([title.count("\n") for title in titles], default=0)
    figure = new_figure(1.0 + wide_in * columns, 0.6 + down * (0.7 + 0.17 * more_lines + 0.3 * len(shown)))
    panels = figure.subplots(down, columns, sharex=True, squeeze=False).reshape(-1)
    colours = condition_colours([condition.unit for condition in shown[0].conditions])
    for i, (axes, title, of) in enumerate(zip(panels, titles, rates, strict=False)):
        shares = [np.histogram(x, edges_hz)[0] / max(len(x), 1) for x in of]
        # All recordings of a condition have the same scale.
        height = 0.92 / max(max(share.max() for share in shares), 1e-9)
        for row, (share, x) in enumerate(zip(shares, of, strict=True)):
            base = -float(row)
            axes.stairs(base + height * share, edges_hz, baseline=base, fill=True, color=colours[i])
            if len(x):
                axes.plot([np.median(x)] * 2, [base, base + 0.92], color=MEDIAN, linewidth=1.6)
        at = [f"{responses.start_min:g}" for responses in shown]
        axes.set_yticks([-float(row) for row in range(len(shown))], at if i % columns == 0 else [""] * len(at))
        axes.set_xlim(0, edges_hz[-1])
        axes.set_ylim(-len(shown) + 0.9, 1.0)
        axes.tick_params(labelbottom=True)
        style_axes(axes, title, "", "start (min)" if i % columns == 0 else "")
    for axes in panels[len(conditions) :]:
        axes.set_visible(False)
    numbers = ("recordings", len(shown), len(series)), ("conditions", len(conditions), len(shown[0].conditions))
    left_out = [f"{n} of {every} {what}" for what, n, every in numbers if n < every]
    if left_out or beyond:
        figure.suptitle(", ".join(filter(None, [*left_out, beyond])), fontsize=10)
    figure.supxlabel(f"{_RATE}; the line is the median", fontsize=9)
    return figure


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
        _scatter(labelled, responses, ~responses.is_burst, BLUE, f"non-burst ({len(responses) - n_bursts:,})")
        _scatter(labelled, responses, responses.is_burst, RED, f"burst ({n_bursts:,})")
        style_axes(labelled, "bursts set apart", _RATIO, _RATE)
    for axes in (ratios, *more) if n_bursts else ():
        # Between the largest ratio that is not a burst and the next possible one.
        label = f"threshold {responses.threshold:.3f}"
        axes.axvline(responses.threshold + 0.5 / n_channels, color=BLACK, linestyle="--", linewidth=1, label=label)
        add_legend(axes, loc="best", markerscale=2)
        for handle in axes.get_legend().legend_handles:
            handle.set_alpha(1)
    return figure


def _edges_of_most(
    responses: Responses, rates_hz: Float64[np.ndarray, " n"], n_bins: int
) -> tuple[Float64[np.ndarray, " edges"], str]:
    """Edges of bins up to 1.5 times the 99th percentile, and in words how many rates are larger; "" if none is."""
    # A few bursts that were not separated must not squeeze all others into one bin.
    reach_hz = 1.5 * float(np.quantile(rates_hz, 0.99)) if len(rates_hz) else 0.0
    edges_hz = rate_edges(responses, rates_hz[rates_hz <= reach_hz], n_bins)
    beyond = int(np.count_nonzero(rates_hz > edges_hz[-1]))
    said = f"{beyond:,} of {len(rates_hz):,} responses are larger than {edges_hz[-1]:.3g} Hz and not drawn"
    return edges_hz, said if beyond else ""


def _scatter(axes: Axes, responses: Responses, which: np.ndarray | slice, colour: str, label: str | None) -> None:
    x, y, alpha = responses.active_ratio[which], responses.rate_hz[which], 0.6 if len(responses) > 300 else 0.9
    axes.scatter(x, y, s=9, alpha=alpha, color=colour, linewidths=0, label=label, rasterized=True)


def rate_edges(responses: Responses, rates_hz: Float64[np.ndarray, " n"], n_bins: int) -> Float64[np.ndarray, " edges"]:
    """Edges of at most n_bins bins that each contain equally many of the possible rates.

    x is an integer number of spikes over (window x channels). Bins of any other width would contain varying numbers of
    its possible values, and show a comb that is not in the data.
    """
    start_ms, end_ms = responses.window_ms
    return even_edges(rates_hz, 1 / ((end_ms - start_ms) * 1e-3 * responses.n_channels), n_bins)


def even_edges(values: Float64[np.ndarray, " n"], step: float, n_bins: int) -> Float64[np.ndarray, " edges"]:
    """Edges of at most n_bins bins that each contain equally many multiples of `step`, as all values are."""
    most = round(float(values.max()) / step) if len(values) else 1
    per_bin = max(1, math.ceil((most + 1) / n_bins))
    return (np.arange(0, most + 1 + per_bin, per_bin) - 0.5) * step
