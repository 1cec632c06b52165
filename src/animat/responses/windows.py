"""Counting spikes in windows of time after stimuli."""

from __future__ import annotations

import math
from collections.abc import Sized
from numbers import Real
from typing import Protocol, TypeAlias

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument, expect_several, shown

Window: TypeAlias = tuple[float, float]
"""Start and end after a stimulus, in milliseconds."""
DEFAULT_WINDOW_MS = (2.0, 10.0)
"""The paper's window: the first 2 ms after a stimulus are lost in its artefact."""
HALF_NS_S = 0.5e-9
"""Histograms of lags begin each bin this much earlier, as if lags were rounded to a nanosecond: otherwise rounding
errors would decide about lags on an edge, which are common with times on a sampling grid."""

PerWindow: TypeAlias = Float64[np.ndarray, " windows"]


class Spiking(Protocol):
    """Spikes on channels, in the order of time: a `Recording`, or the piece of one that a closed loop has just seen."""

    @property
    def spike_times_s(self) -> Float64[np.ndarray, " spikes"]: ...
    @property
    def spike_channels(self) -> Int64[np.ndarray, " spikes"]: ...
    @property
    def channels(self) -> Sized: ...


def read_windows(recording: Spiking, after_s: PerWindow, window_ms: Window) -> tuple[PerWindow, PerWindow]:
    """The response in a window after each pulse: its rate x and its ratio of active channels.

        x = S / (T N)

    This function defines a response, both offline and in a closed loop. For the same times the result is the same to
    the bit, from a piece of a recording as from the whole. Times of the pulses are on the clock of the spikes.
    """
    from_s, to_s = after_s + window_ms[0] * 1e-3, after_s + window_ms[1] * 1e-3
    n_channels = len(recording.channels)
    first, spikes = _first_and_count(recording, from_s, to_s)
    rate_hz = spikes / ((window_ms[1] - window_ms[0]) * 1e-3 * n_channels)
    active = np.zeros(len(spikes))
    for window, (start, count) in enumerate(zip(first.tolist(), spikes.tolist(), strict=True)):
        is_active = np.zeros(n_channels, np.bool_)
        is_active[recording.spike_channels[start : start + count]] = True
        active[window] = np.count_nonzero(is_active)
    return rate_hz, active / n_channels


def check_window(window_ms: Window) -> Window:
    """The window, as a tuple; raises InvalidArgument unless it is a stretch of time after the stimulus."""
    words = "two numbers of milliseconds, start and end"
    several = expect_several("window_ms", window_ms, Real, words)
    if len(several) != 2:
        raise InvalidArgument(f"window_ms: expected {words}, got {shown(window_ms)}")
    start_ms, end_ms = map(float, several)
    if not 0 <= start_ms < end_ms < math.inf:
        raise InvalidArgument(
            f"window_ms: expected 0 <= start < end in milliseconds after the stimulus, got {start_ms:g} to {end_ms:g}"
        )
    return start_ms, end_ms


def count_spikes(recording: Spiking, from_s: PerWindow, to_s: PerWindow) -> Int64[np.ndarray, " windows"]:
    """The number of spikes with from_s <= time < to_s, on all channels together.

    Windows are half-open, so that adjacent windows share no spike. Times are compared in double precision. Those on a
    sampling grid can lie exactly on an edge; there the rounding of the sum of stimulus time and window edge decides,
    one sample (0.05 ms at 20 kHz) either way.
    """
    return _first_and_count(recording, from_s, to_s)[1]


def spikes_in(
    recording: Spiking, from_s: PerWindow, to_s: PerWindow
) -> tuple[Int64[np.ndarray, " pairs"], Int64[np.ndarray, " pairs"]]:
    """All pairs of a window and a spike in it, as rows of both; edges and arguments as in `count_spikes`."""
    first, counts = _first_and_count(recording, from_s, to_s)
    # The spikes of window i are first[i], first[i] + 1, ...: count up over all, restarting at each window.
    spike = np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts)
    return np.repeat(np.arange(len(counts)), counts), spike


def _first_and_count(
    recording: Spiking, from_s: PerWindow, to_s: PerWindow
) -> tuple[Int64[np.ndarray, " windows"], Int64[np.ndarray, " windows"]]:
    """The index of the first spike of each window, and the number of spikes; edges as in `count_spikes`."""
    first = recording.spike_times_s.searchsorted(from_s)
    return first, recording.spike_times_s.searchsorted(to_s) - first
