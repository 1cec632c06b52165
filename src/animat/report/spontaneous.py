"""Activity without stimulation: every spike of the recording, and the rate of all channels with its bursts."""

from __future__ import annotations

import numpy as np

from animat.recordings.recording import Recording
from animat.report.style import BLACK, WINDOW, Figure, add_legend, new_figure, style_axes
from animat.responses.network_bursts import NetworkBursts
from animat.tables import evenly

_MOST_SPIKES = 200_000
_MOST_BINS = 2_000


def draw_spontaneous(recording: Recording, bursts: NetworkBursts) -> Figure:
    """Spikes by channel and the rate per channel, over the whole recording, with the network bursts marked."""
    figure = new_figure(8.0, 7.0)
    upper, lower = figure.subplots(2, 1, height_ratios=[2, 1], sharex=True)
    n = len(recording.spike_times_s)
    shown = evenly(n, _MOST_SPIKES)
    size, spikes = 4.0 if n < 10_000 else 1.0, (recording.spike_times_s[shown], recording.spike_channels[shown])
    upper.scatter(*spikes, s=size, color=BLACK, linewidths=0, rasterized=True)
    upper.set_xlim(recording.start_s, max(recording.stop_s, recording.start_s + 1e-3))
    upper.set_ylim(-1, len(recording.channels))
    thinned = f"{len(shown):,} of " if len(shown) < n else ""
    style_axes(upper, f"{thinned}{n:,} spikes, no stimuli", "", "channel (row)")
    # No more bins than can be told apart; each shows its highest rate, so that a short burst keeps its height.
    together = max(1, -(-len(bursts.count) // _MOST_BINS))
    rows = np.arange(0, len(bursts.count), together)
    width_s = bursts.edges_s[1] - bursts.edges_s[0]
    highest_hz = np.maximum.reduceat(bursts.count, rows) / (width_s * len(recording.channels))
    lower.plot(bursts.edges_s[rows], highest_hz, color=BLACK, linewidth=0.8, label="highest in 50 ms")
    threshold_hz = bursts.threshold / (width_s * len(recording.channels))
    lower.axhline(threshold_hz, color=WINDOW, linewidth=1, label="threshold of network bursts")
    lower.set_ylim(bottom=0)
    style_axes(lower, f"{len(bursts):,} network bursts", "time (s)", "rate (Hz per channel)")
    add_legend(lower, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0)
    return figure
