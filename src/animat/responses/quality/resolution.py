"""Whether times of spikes are fine enough for the window that responses are read in."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording

COARSE = 0.25
"""Of the window, above which a step of the times is too coarse for it."""
ENOUGH_SPIKES, ENOUGH_STEPS = 1000, 20
WHOLE, NEARLY_ALL = 0.01, 0.99
"""How near to whole numbers of steps intervals are, and which share of them."""


def resolution_findings(recording: Recording, window_ms: tuple[float, float]) -> Iterator[Finding]:
    """A finding on times of spikes that come in steps of more than a quarter of the window (`coarse-times`).

    The step is the shortest interval between spikes of different times, if nearly all intervals are whole multiples of
    it. Only the later half is looked at, as times in single precision grow coarser.

    Args:
        recording: with any spikes.
        window_ms: of the responses.
    """
    time_s = np.unique(recording.spike_times_s[len(recording.spike_times_s) // 2 :])
    if len(recording.spike_times_s) < ENOUGH_SPIKES or len(time_s) <= ENOUGH_STEPS:
        return
    interval_s = np.diff(time_s)
    step_s = float(interval_s.min())
    multiple = interval_s / step_s
    width_ms = window_ms[1] - window_ms[0]
    is_grid = np.mean(np.abs(multiple - np.rint(multiple)) < WHOLE) > NEARLY_ALL
    if not is_grid or 1e3 * step_s <= COARSE * width_ms:
        return
    message = (
        f"times of spikes come in steps of {1e3 * step_s:.3g} ms, too coarse for a window of {width_ms:g} ms: which "
        "spikes it holds is chance; bring times in double precision (float64, more decimals), or use a longer window"
    )
    yield Finding("coarse-times", "warning", message, 1e3 * step_s)
