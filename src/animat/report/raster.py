"""The raster: every spike as a dot, over a stretch of the recording and around its stimuli."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from animat.recordings.recording import Recording
from animat.report.style import BLACK, RED, WINDOW, add_legend, condition_colours, new_figure, style_axes
from animat.responses.responses import Responses
from animat.responses.windows import spikes_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_STIMULI = 300
_MOST_LABELS = 12


def draw_raster(
    recording: Recording, responses: Responses, from_ms: float = -20.0, to_ms: float | None = None
) -> Figure:
    """Spikes by channel in a stretch of the recording, and by stimulus around it, sorted by condition.

    Args:
        recording: the spikes.
        responses: the responses, made from this recording.
        from_ms, to_ms: the span around a stimulus; to_ms is by default 50 ms, or twice the window's end if that is
            later.
    """
    to_ms = max(50.0, 2 * responses.window_ms[1]) if to_ms is None else to_ms
    figure = new_figure(8.0, 7.0)
    upper, lower = figure.subplots(2, 1, height_ratios=[1, 1.25])
    _draw_stretch(upper, recording)
    _draw_stimuli(lower, recording, responses, from_ms, to_ms)
    return figure


def _draw_stretch(axes: Axes, recording: Recording) -> None:
    """All channels over the time of the recording's middle six stimuli; without any, over the whole recording."""
    times_s = recording.stimuli.time_s
    from_s, to_s = recording.start_s, max(recording.stop_s, recording.start_s + 1e-3)
    if len(times_s):
        middle = times_s[max(0, len(times_s) // 2 - 3) : len(times_s) // 2 + 3]
        margin_s = max(0.05, 0.1 * (middle[-1] - middle[0]))
        from_s, to_s = middle[0] - margin_s, middle[-1] + margin_s
    _, spike = spikes_in(recording, np.array([from_s]), np.array([to_s]))
    axes.scatter(
        recording.spike_times_s[spike],
        recording.spike_channels[spike],
        s=4,
        color=BLACK,
        linewidths=0,
        rasterized=True,
    )
    shown = times_s[(times_s >= from_s) & (times_s <= to_s)]
    for i, time_s in enumerate(shown):
        axes.axvline(time_s, color=RED, linewidth=1, label="stimulus" if i == 0 else None)
    axes.set_xlim(from_s, to_s)
    axes.set_ylim(-1, len(recording.channels))
    style_axes(axes, f"{len(shown)} stimuli in the middle of the recording", "time (s)", "channel (row)")
    if len(shown):
        add_legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0)


def _draw_stimuli(axes: Axes, recording: Recording, responses: Responses, from_ms: float, to_ms: float) -> None:
    """Stimuli as rows, sorted by condition and then in time; evenly thinned where there are too many to see."""
    start_ms, end_ms = responses.window_ms
    times_s = np.empty(0) if responses.time_s is None else responses.time_s
    chosen = np.unique(np.linspace(0, len(times_s) - 1, min(len(times_s), _MOST_STIMULI)).round().astype(np.int64))
    chosen = chosen[np.argsort(responses.condition[chosen], kind="stable")]
    row, spike = spikes_in(recording, times_s[chosen] + from_ms * 1e-3, times_s[chosen] + to_ms * 1e-3)
    condition = responses.condition[chosen]
    axes.axvspan(start_ms, end_ms, color=WINDOW, alpha=0.25, linewidth=0, label=f"window {start_ms:g}-{end_ms:g} ms")
    for edge_ms in (start_ms, end_ms):
        # On top of the dots, which can hide the band.
        axes.axvline(edge_ms, color=WINDOW, linewidth=1.2, zorder=3)
    axes.axvline(0, color=RED, linewidth=1, label="stimulus")
    drawn = np.unique(condition).tolist()
    for i, colour in zip(drawn, condition_colours([responses.conditions[i].unit for i in drawn]), strict=True):
        of = condition[row] == i
        lag_ms = 1e3 * (recording.spike_times_s[spike[of]] - times_s[chosen[row[of]]])
        axes.scatter(
            lag_ms,
            row[of],
            s=2.5,
            color=colour,
            linewidths=0,
            rasterized=True,
            label=responses.conditions[i].label if i in drawn[:_MOST_LABELS] else None,
        )
    if len(drawn) > _MOST_LABELS:
        axes.plot([], [], " ", label=f"and {len(drawn) - _MOST_LABELS} more")
    axes.set_xlim(from_ms, to_ms)
    axes.set_ylim(-1, max(len(chosen), 1))
    thinned = "" if len(chosen) == len(times_s) else f"{len(chosen)} of "
    title = f"{thinned}{len(times_s):,} stimuli, sorted by condition, all {len(recording.channels):,} channels"
    style_axes(axes, title, "time from stimulus (ms)", "stimulus (row)")
    add_legend(axes, loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=4)
