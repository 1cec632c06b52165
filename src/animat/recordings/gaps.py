"""Stretches without any event that are too long for chance: before the first one, and between spikes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording

TIMES = 10.0
"""An empty stretch is this many times as long as the next shorter one. Of n like stretches the first is so by chance
once in n^10 / 10! cases."""
LATE_SHARE, LATE_SPIKES = 0.1, 20
"""Of the recording, and the spikes that it must have: less changes no rate by much, and fewer tell nothing."""
SILENT_SHARES, SILENT_S, SILENT_SPIKES = (0.01, 0.5), 1.0, 1000
"""Likewise for silences, from the first spike on; a culture that is silent for most of the time fires in bursts."""
SILENCES = 5
"""So many at most stand out together."""


def late_start(
    spike_time_s: Float64[np.ndarray, " spikes"], stimulus_time_s: Float64[np.ndarray, " stimuli"]
) -> Iterator[Finding]:
    """A finding where a recording that is taken to start at 0, as nobody said when, has its first event much later.

    Args:
        spike_time_s, stimulus_time_s: rising.
    """
    event_s = np.sort(np.concatenate([spike_time_s, stimulus_time_s]))
    if len(spike_time_s) < LATE_SPIKES:
        return
    first_s, last_s, longest_s = float(event_s[0]), float(event_s[-1]), float(np.diff(event_s).max())
    if first_s > max(TIMES * longest_s, LATE_SHARE * last_s):
        message = (
            f"the recording does not say when it starts and is taken to start at 0 s, but the first event is at "
            f"{first_s:.12g} s, and no later two are more than {longest_s:.3g} s apart: if it starts near the first, "
            "rates are too low and bursts are found where there are none; say when it starts "
            "(animat convert --start-s, start_s in NPZ)"
        )
        yield Finding("start-unknown", "warning", message, first_s)


def silences(recording: Recording) -> Iterator[Finding]:
    """A finding where no channel has a spike for far longer than it is else silent on all of them.

    Args:
        recording: with any spikes.
    """
    if len(recording.spike_times_s) < SILENT_SPIKES:
        return
    times_s = np.append(recording.spike_times_s, recording.stop_s)
    length_s = np.diff(times_s)
    longest = np.argsort(-length_s, kind="stable")[: SILENCES + 1]
    of_longest_s = length_s[longest]
    least_s, most_s = (share * float(times_s[-1] - times_s[0]) for share in SILENT_SHARES)
    stands_out = (of_longest_s[:-1] > TIMES * of_longest_s[1:]) & (of_longest_s[:-1] > max(least_s, SILENT_S))
    n = int(np.max(np.flatnonzero(stands_out), initial=-1)) + 1
    total_s = float(of_longest_s[:n].sum())
    if not 0 < total_s < most_s:
        return
    where = ", ".join(f"from {times_s[i]:.12g} to {times_s[i + 1]:.12g} s" for i in sorted(longest[:n].tolist()))
    message = (
        f"no spike on any channel {where} ({total_s:.3g} s), where no other silence is longer than "
        f"{of_longest_s[n]:.2g} s: was nothing recorded there? It counts in rates; if so, cut the recording there"
    )
    yield Finding("silence", "warning", message, total_s)
