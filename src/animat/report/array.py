"""The array from above: recording sites with their activity, and stimulated electrodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.errors import counted
from animat.lazy import Axes, Figure
from animat.recordings.recording import Recording
from animat.report.colours import GREY, RED
from animat.report.style import add_legend, new_figure, style_axes
from animat.stimulation.selection import Selection
from animat.tables import UNKNOWN

_MOST_LABELS = 64


def draw_array(recording: Recording) -> Figure:
    """Recording sites coloured by their firing rate, and the electrodes that were stimulated.

    A stimulated electrode is drawn if a channel reads it; the title counts the others, and channels without position.
    """
    channels, stimuli = recording.channels, recording.stimuli
    rate_hz = rates_of_sites(recording)
    known = np.isfinite(channels.x_um) & np.isfinite(channels.y_um)
    # The figure has the array's aspect ratio, with room for title, legend and colour bar.
    places_um = channels.x_um[known], channels.y_um[known]
    width_um, height_um = (max(float(np.ptp(along)), 1.0) if len(along) else 1.0 for along in places_um)
    shape = float(np.clip(width_um / height_um, 0.4, 2.5))
    across_in, down_in = (6.5, 6.5 / shape) if shape > 1.5 else (4.2 * shape, 4.2)
    figure = new_figure(max(across_in + 1.8, 5.0), down_in + 1.4)
    axes = figure.subplots()
    # A few channels with a very high rate must not leave all others dark.
    highest_hz = float(np.quantile(rate_hz[known], 0.98)) if np.any(known) else 1.0
    colours: dict[str, Any] = {"c": rate_hz[known], "vmin": 0, "vmax": max(highest_hz, 1e-9), "cmap": "cividis"}
    drawn = axes.scatter(*places_um, s=9, linewidths=0, **colours)
    # Sites in a row, or in a column, would have axes without a width.
    margin_um = max(width_um, height_um) / 20
    if np.any(known) and min(width_um, height_um) < margin_um:
        (left, right), (bottom, top) = ((of.min() - margin_um, of.max() + margin_um) for of in places_um)
        axes.set(xlim=(left, right), ylim=(bottom, top))
    included = ", stimulated time included" if len(stimuli) else ""
    bar = figure.colorbar(drawn, ax=axes, shrink=0.7, extend="max")
    bar.set_label(f"firing rate{included} (Hz)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    stimulated = np.unique(stimuli.electrodes[stimuli.electrodes != UNKNOWN])
    place = {int(e): i for i, e in enumerate(channels.electrode.tolist()) if e != UNKNOWN and known[i]}
    rows = [place[e] for e in stimulated.tolist() if e in place]
    _ring(axes, channels.x_um[rows], channels.y_um[rows], counted(len(rows), "stimulated electrode"))
    title = f"{counted(int(np.count_nonzero(known)), 'recording site')} at {recording.start_min:g} min"
    if np.any(~known):
        title += f"\n{np.count_nonzero(~known):,} channels at unknown positions are not drawn"
    if unplaced := len(stimulated) - len(rows):
        title += f"\n{unplaced} stimulated electrodes that no channel reads are not drawn"
    _finish(axes, title)
    return figure


def rates_of_sites(recording: Recording) -> Float64[np.ndarray, " channels"]:
    """Spikes per second on each channel over the whole recording, including stimulation."""
    counts = np.bincount(recording.spike_channels, minlength=len(recording.channels))
    return np.asarray(counts / max(recording.duration_s, 1e-9), np.float64)


def draw_selection(selection: Selection) -> Figure:
    """The whole array with the recording sites, the stimulation sites with their numbers, and the first pattern."""
    array = selection.array
    figure = new_figure(8.5, 5.2)
    axes = figure.subplots()
    x_um, y_um = array.position_um(selection.recording)
    axes.scatter(x_um, y_um, s=7, color=GREY, linewidths=0, label=f"{len(selection.recording):,} recording sites")
    x_um, y_um = array.position_um(selection.stimulation)
    _ring(axes, x_um, y_um, f"{len(selection.stimulation)} stimulation sites")
    if len(selection.stimulation) <= _MOST_LABELS:
        for electrode, x, y in zip(selection.stimulation.tolist(), x_um.tolist(), y_um.tolist(), strict=True):
            axes.annotate(str(electrode), (x, y), xytext=(4, 3), textcoords="offset points", fontsize=6)
    if len(selection.patterns):
        x_um, y_um = array.position_um(selection.patterns[0])
        axes.scatter(x_um, y_um, s=26, color=RED, linewidths=0, label=f"pattern 0 of {len(selection.patterns)}")
    axes.set_xlim(-2 * array.pitch_um, (array.columns + 1) * array.pitch_um)
    _finish(axes, f"{array.name}: {selection.passed:,} of {selection.scanned:,} scanned electrodes passed")
    return figure


def _ring(axes: Axes, x_um: np.ndarray, y_um: np.ndarray, label: str) -> None:
    if len(x_um):
        axes.scatter(x_um, y_um, s=55, facecolors="none", edgecolors=RED, linewidths=1.2, label=label)


def _finish(axes: Axes, title: str) -> None:
    axes.set_aspect("equal")
    # Rows are counted from the top, as on the chip.
    axes.invert_yaxis()
    style_axes(axes, "", "x (µm)", "y (µm)")
    # A title of the whole figure, as narrow axes would cut it off.
    axes.figure.suptitle(title, fontsize=10, x=0.02, ha="left")
    if axes.get_legend_handles_labels()[0]:
        add_legend(axes, loc="upper left", bbox_to_anchor=(0, -0.14), ncols=3)
