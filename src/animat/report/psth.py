"""The post-stimulus time histogram, with the response window."""

from __future__ import annotations

import numpy as np

from animat.errors import counted
from animat.lazy import Figure
from animat.report.style import BLUE, GREY, RED, WINDOW, add_legend, new_figure, style_axes
from animat.responses.psth import PostStimulusHistogram

_ARTEFACT_MS = 5.0
"""Bins closer to the stimulus do not set the height of the axis if they would dwarf all others."""


def draw_psth(
    histogram: PostStimulusHistogram, window_ms: tuple[float, float], spontaneous_hz: float | None = None
) -> Figure:
    """Mean rate per channel against the time from the stimulus; a stretch lost in the artefact is empty.

    The response window is marked, and the spontaneous rate per channel is a line.
    """
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
