"""Counting spikes in windows of time after stimuli."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument
from animat.recordings.recording import Recording

DEFAULT_WINDOW_MS = (2.0, 10.0)
"""The paper's window: the first 2 ms after a stimulus are lost in its artefact."""

_BLOCK = 1 << 26


def check_window(window_ms: tuple[float, float]) -> None:
    """Refuse a window that is not a stretch of time after the stimulus.

    Raises:
        InvalidArgument: unless 0 <= start < end, both finite.
    """
    start_ms, end_ms = window_ms
    if not (math.isfinite(start_ms) and math.isfinite(end_ms) and 0 <= start_ms < end_ms):
        raise InvalidArgument(
            f"window_ms: expected 0 <= start < end in milliseconds after the stimulus, got {start_ms:g} to {end_ms:g}"
        )


def count_spikes(
    recording: Recording, from_s: Float64[np.ndarray, " windows"], to_s: Float64[np.ndarray, " windows"]
) -> Int64[np.ndarray, " windows"]:
    """The number of spikes with from_s <= time < to_s, on all channels together.

    Windows are half-open, so that windows that touch share no spike. The comparison is the plain one of double
    precision numbers. Times on a sampling grid can lie exactly on an edge; there the rounding of the sum of the
    stimulus' time and the window's edge decides, one sample (0.05 ms at 20 kHz) either way.

    Args:
        recording: the spikes.
        from_s, to_s: the windows, in seconds on the recording's clock, shape (windows,).
    """
    times_s = recording.spike_times_s
    return np.searchsorted(times_s, to_s, side="left") - np.searchsorted(times_s, from_s, side="left")


def count_active_channels(
    recording: Recording, from_s: Float64[np.ndarray, " windows"], to_s: Float64[np.ndarray, " windows"]
) -> Int64[np.ndarray, " windows"]:
    """The number of channels with at least one spike in each window; edges and arguments as in `count_spikes`."""
    n_channels = len(recording.channels)
    active = np.zeros(len(from_s), dtype=np.int64)
    # One mark a window and channel, in blocks of windows so that a long recording does not fill the memory.
    block = max(1, _BLOCK // max(n_channels, 1))
    for start in range(0, len(from_s), block):
        rows = slice(start, start + block)
        window, spike = spikes_in(recording, from_s[rows], to_s[rows])
        marked = np.zeros((len(from_s[rows]), n_channels), dtype=bool)
        marked[window, recording.spike_channels[spike]] = True
        active[rows] = marked.sum(axis=1)
    return active


def spikes_in(
    recording: Recording, from_s: Float64[np.ndarray, " windows"], to_s: Float64[np.ndarray, " windows"]
) -> tuple[Int64[np.ndarray, " pairs"], Int64[np.ndarray, " pairs"]]:
    """All pairs of a window and a spike in it, as rows of both; edges and arguments as in `count_spikes`."""
    first = np.searchsorted(recording.spike_times_s, from_s, side="left")
    counts = np.searchsorted(recording.spike_times_s, to_s, side="left") - first
    # The spikes of window i are first[i], first[i] + 1, ...: count up over all, restarting at each window.
    spike = np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts)
    return np.repeat(np.arange(len(counts)), counts), spike
