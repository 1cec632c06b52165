"""Gaps without any event that are too long to be chance: before the first event, and between spikes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording

TIMES = 10.0
"""A gap must be so many times as long as the next shorter one: the first of n similar ones is in n^10 / 10! cases."""
LATE_SHARE, LATE_SPIKES = 0.1, 20
"""Smallest share of the recording, as less hardly changes rates; and fewest spikes, as fewer are not conclusive."""
SILENT_SHARES, SILENT_S, SILENT_SPIKES = (0.01, 0.5), 1.0, 1000
"""Likewise for silences, from the first spike on; a culture that is silent most of the time fires in bursts."""
SILENCES = 5
"""Most silences that are reported together."""


def late_start(
    spike_time_s: Float64[np.ndarray, " spikes"], stimulus_time_s: Float64[np.ndarray, " stimuli"]
) -> Iterator[Finding]:
    """A finding if a recording with an unknown start, assumed to be 0, has its first event much later."""
    event_s = np.sort(np.concatenate([spike_time_s, stimulus_time_s]))
    if len(spike_time_s) < LATE_SPIKES:
        return
    first_s, last_s, longest_s = float(event_s[0]), float(event_s[-1]), float(np.diff(event_s).max())
    if first_s > max(TIMES * longest_s, LATE_SHARE * last_s):
        message = (
            f"the start is not stated and assumed to be 0 s, but the first event is at {first_s:.12g} s and later ones "
            f"are at most {longest_s:.3g} s apart: if it starts near the first, rates are too low and bursts are found "
            "where there are none; state the start (animat convert --start-s, start_s in NPZ)"
        )
        yield Finding("start-unknown", "warning", message, first_s)


def silences(recording: Recording) -> Iterator[Finding]:
    """A finding if all channels are silent for far longer than at any other time."""
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
        f"no spike on any channel {where} ({total_s:.3g} s), while no other silence is longer than "
        f"{of_longest_s[n]:.2g} s: was recording interrupted? If so, cut the recording there, as it counts in rates"
    )
    yield Finding("silence", "warning", message, total_s)
