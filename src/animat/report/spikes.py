"""Figures of spikes: the raster, around stimuli or over all of a recording, and the post-stimulus time histogram."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import counted
from animat.lazy import Axes, Figure
from animat.recordings.recording import Recording
from animat.report.colours import BLACK, BLUE, GREY, RED, WINDOW, condition_colours
from animat.report.style import add_common_legend, add_legend, new_figure, style_axes
from animat.responses.bursts import NetworkBursts
from animat.responses.psth import PostStimulusHistogram
from animat.responses.responses import Responses
from animat.responses.windows import HALF_NS_S, spikes_in
from animat.tables import evenly

_MOST_STIMULI = 300
_MOST_LABELS = 12
_MOST_DOTS = 3000
"""The most spikes around stimuli that can be told apart as dots."""
_MOST_BINS = 100
_MOST_SPIKES = 200_000
_MOST_POINTS = 2_000
_ARTEFACT_MS = 5.0
"""Bins closer to the stimulus do not set the height of the histogram's axis if they would dwarf all others."""


def draw_raster(recording: Recording, responses: Responses) -> Figure:
    """Spikes by channel in a stretch of the recording, and around each stimulus, sorted by condition."""
    to_ms = max(50.0, 2 * responses.window_ms[1])
    figure = new_figure(8.0, 7.0)
    upper, lower = figure.subplots(2, 1, height_ratios=[1, 1.25])
    _draw_stretch(upper, recording)
    _draw_stimuli(lower, recording, responses, -20.0, to_ms)
    add_common_legend(figure, [lower], columns=2)
    return figure


def draw_spontaneous(recording: Recording, bursts: NetworkBursts) -> Figure:
    """Spikes by channel and the rate per channel, over the whole recording, with the network bursts marked."""
    figure = new_figure(8.0, 7.0)
    upper, lower = figure.subplots(2, 1, height_ratios=[2, 1], sharex=True)
    n = len(recording.spike_times_s)
    shown = evenly(n, _MOST_SPIKES)
    _draw_spikes(upper, recording, shown, 4.0 if n < 10_000 else 1.0)
    upper.set_xlim(recording.start_s, max(recording.stop_s, recording.start_s + 1e-3))
    thinned = f"{len(shown):,} of " if len(shown) < n else ""
    style_axes(upper, f"{thinned}{counted(n, 'spike')}, no stimuli", "", "channel (row)")
    # No more bins than can be told apart; each shows its highest rate, so that a short burst keeps its height.
    together = max(1, -(-len(bursts.count) // _MOST_POINTS))
    rows = np.arange(0, len(bursts.count), together)
    width_s = bursts.edges_s[1] - bursts.edges_s[0]
    highest_hz = np.maximum.reduceat(bursts.count, rows) / (width_s * len(recording.channels))
    lower.plot(bursts.edges_s[rows], highest_hz, color=BLACK, linewidth=0.8, label="highest in 50 ms")
    threshold_hz = bursts.threshold / (width_s * len(recording.channels))
    lower.axhline(threshold_hz, color=WINDOW, linewidth=1, label="threshold of network bursts")
    lower.set_ylim(bottom=0)
    style_axes(lower, counted(len(bursts), "network burst"), "time (s)", "rate (Hz per channel)")
    add_legend(lower, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0)
    return figure


def draw_psth(
    histogram: PostStimulusHistogram, window_ms: tuple[float, float], spontaneous_hz: float | None = None
) -> Figure:
    """Mean rate per channel by time from the stimulus, empty where it was lost, with window and spontaneous rate."""
    figure = new_figure(7.5, 3.8)
    axes = figure.subplots()
    rate_hz = np.nan_to_num(histogram.rate_hz)
    label = f"window {window_ms[0]:g}-{window_ms[1]:g} ms"
    axes.axvspan(*window_ms, color=WINDOW, alpha=0.25, linewidth=0, label=label)
    axes.stairs(rate_hz, histogram.edges_ms, fill=True, color=BLUE)
    axes.axvline(0, color=RED, linewidth=1, label="stimulus")
    if spontaneous_hz is not None and np.isfinite(spontaneous_hz):
        axes.axhline(spontaneous_hz, color=GREY, linewidth=1, linestyle="--", label="spontaneous rate")
    axes.set_xlim(histogram.edges_ms[0], histogram.edges_ms[-1])
    width_ms = histogram.edges_ms[1] - histogram.edges_ms[0]
    of = f"{counted(histogram.n_stimuli, 'stimulus', 'stimuli')}, {counted(histogram.n_channels, 'channel')}"
    title = f"{of}, bins of {width_ms:g} ms"
    centres_ms = 0.5 * (histogram.edges_ms[1:] + histogram.edges_ms[:-1])
    # Bins inside the response window always count, however close to the stimulus they are.
    inside = (histogram.edges_ms[:-1] >= window_ms[0] - 1e-9) & (histogram.edges_ms[1:] <= window_ms[1] + 1e-9)
    clear = (np.abs(centres_ms) > _ARTEFACT_MS) | inside
    highest_hz = 1.1 * float(max(rate_hz[clear].max(initial=0.0), 2 * np.nan_to_num(spontaneous_hz or 0.0)))
    if highest_hz and rate_hz.max() > 1.5 * highest_hz:
        title += f"; the artefact, up to {rate_hz.max():.3g} Hz, is cut off"
        axes.set_ylim(0, highest_hz)
    else:
        axes.set_ylim(0, None)
    style_axes(axes, title, "time from stimulus (ms)", "firing rate (Hz per channel)")
    add_legend(axes, loc="upper right")
    return figure


def _draw_spikes(axes: Axes, recording: Recording, spikes: Int64[np.ndarray, " spikes"], size: float) -> None:
    times_s, channels = recording.spike_times_s[spikes], recording.spike_channels[spikes]
    axes.scatter(times_s, channels, s=size, color=BLACK, linewidths=0, rasterized=True)
    axes.set_ylim(-1, len(recording.channels))


def _draw_stretch(axes: Axes, recording: Recording) -> None:
    """All channels during the middle six stimuli of the recording; without stimuli, during the whole recording."""
    from matplotlib.ticker import MaxNLocator

    times_s = recording.stimuli.time_s[~recording.stimuli.is_rest]
    from_s, to_s = recording.start_s, max(recording.stop_s, recording.start_s + 1e-3)
    shown = times_s[max(0, len(times_s) // 2 - 3) : len(times_s) // 2 + 3]
    if len(shown):
        margin_s = 0.4 * float(np.min(np.diff(shown))) if len(shown) > 1 else 0.05
        from_s, to_s = shown[0] - margin_s, shown[-1] + max(margin_s, 0.02)
    _, spike = spikes_in(recording, np.array([from_s]), np.array([to_s]))
    _draw_spikes(axes, recording, spike, 4.0)
    # Other stimuli can fall into the stretch.
    inside = times_s[(times_s >= from_s) & (times_s <= to_s)]
    for time_s in inside:
        axes.axvline(time_s, color=RED, linewidth=1)
    axes.set_xlim(from_s, to_s)
    title = "every spike"
    if len(inside):
        title = f"{counted(len(inside), 'stimulus', 'stimuli')} in the middle of the recording, each spike a dot"
    axes.yaxis.set_major_locator(MaxNLocator("auto", integer=True))
    style_axes(axes, title, "time (s)", "channel (row)")


def _draw_stimuli(axes: Axes, recording: Recording, responses: Responses, from_ms: float, to_ms: float) -> None:
    """One row per stimulus, sorted by condition and then in time; evenly thinned if there are too many to see."""
    start_ms, end_ms = responses.window_ms
    times_s = np.empty(0) if responses.time_s is None else responses.time_s
    chosen = evenly(len(times_s), _MOST_STIMULI)
    chosen = chosen[np.argsort(responses.condition[chosen], kind="stable")]
    from_s, to_s = from_ms * 1e-3 - HALF_NS_S, to_ms * 1e-3 - HALF_NS_S
    row, spike = spikes_in(recording, times_s[chosen] + from_s, times_s[chosen] + to_s)
    lag_ms = 1e3 * (recording.spike_times_s[spike] - times_s[chosen[row]])
    condition = responses.condition[chosen]
    are_dots = len(spike) <= _MOST_DOTS
    band = 0.25 if are_dots else 0.12
    axes.axvspan(start_ms, end_ms, color=WINDOW, alpha=band, linewidth=0, label=f"window {start_ms:g}-{end_ms:g} ms")
    for edge_ms in (start_ms, end_ms):
        # Drawn over the spikes, which can hide the band.
        axes.axvline(edge_ms, color=WINDOW, linewidth=1.2, zorder=3)
    axes.axvline(0, color=RED, linewidth=1, label="stimulus", zorder=3)
    drawn = np.unique(condition).tolist()
    colours = condition_colours([responses.conditions[i].unit for i in drawn])
    if are_dots:
        axes.scatter(lag_ms, row, s=2.5, c=[colours[drawn.index(i)] for i in condition[row]], linewidths=0)
        each = "each spike a dot"
    else:
        edges_ms = np.linspace(from_ms, to_ms, 1 + min(_MOST_BINS, round(to_ms - from_ms)))
        count, *_ = np.histogram2d(row, lag_ms, bins=[np.arange(len(chosen) + 1) - 0.5, edges_ms - 1e3 * HALF_NS_S])
        _draw_rates(axes, 1e3 * count / len(recording.channels) / (edges_ms[1] - edges_ms[0]), from_ms, to_ms)
        each = f"all {len(recording.channels):,} channels together"
    first = np.searchsorted(condition, drawn)
    middle = [(a + b - 1) / 2 for a, b in pairwise([*first, len(chosen)])]
    every = max(1, -(-len(drawn) // _MOST_LABELS))
    axes.set_yticks(middle[::every], [responses.conditions[i].label for i in drawn[::every]])
    for edge in first[1:].tolist():
        # Not black, which would look like the row of a burst.
        axes.axhline(edge - 0.5, color=BLUE, linewidth=0.8)
    axes.set_xlim(from_ms, to_ms)
    axes.set_ylim(-0.5, max(len(chosen), 1) - 0.5)
    thinned = "" if len(chosen) == len(times_s) else f"{len(chosen)} of "
    title = f"{thinned}{counted(len(times_s), 'stimulus', 'stimuli')}, one row each; {each}"
    style_axes(axes, title, "time from stimulus (ms)", "stimulus (row)")


def _draw_rates(axes: Axes, rate_hz: Float64[np.ndarray, "rows bins"], from_ms: float, to_ms: float) -> None:
    """The rate in each row and bin as a shade, as so many dots would merge."""
    looks: dict[str, Any] = {"cmap": "Greys", "aspect": "auto", "origin": "lower", "interpolation": "nearest"}
    # A burst in a row or two must not leave all others pale.
    highest_hz = max(float(np.quantile(rate_hz, 0.95)), 1e-9)
    extent = (from_ms, to_ms, -0.5, len(rate_hz) - 0.5)
    drawn = axes.imshow(rate_hz, vmin=0, vmax=highest_hz, extent=extent, **looks)
    bar = axes.figure.colorbar(drawn, ax=axes, extend="max", pad=0.02, shrink=0.6, anchor=(0.0, 0.0))
    bar.set_label("firing rate (Hz per channel)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
