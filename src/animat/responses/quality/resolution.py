"""Whether spike times are fine enough for the response window."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording

COARSE = 0.25
"""Share of the window above which a step of the times is too coarse."""
ENOUGH_SPIKES, ENOUGH_STEPS = 1000, 20
WHOLE, NEARLY_ALL = 0.01, 0.99
"""How close intervals must be to a whole number of steps, and the share of intervals that must be."""


def resolution_findings(recording: Recording, window_ms: tuple[float, float]) -> Iterator[Finding]:
    """A finding on spike times that come in steps of more than a quarter of the window (`coarse-times`).

    The step is the shortest interval between different spike times, if nearly all intervals are whole multiples of it.
    Only the later half is examined, as times in single precision grow coarser.
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
        f"spike times come in steps of {1e3 * step_s:.3g} ms, too coarse for a window of {width_ms:g} ms: which spikes "
        "it holds is chance; supply times in double precision (float64, more decimals), or use a longer window"
    )
    yield Finding("coarse-times", "warning", message, 1e3 * step_s)
