"""What single channels tell about a recording: silent ones, and ones that fire as no neurons do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from animat.recordings.findings import Finding
from animat.recordings.recording import Recording

MOSTLY_SILENT = 0.5
FAST_HZ = 100.0
"""On average over a recording: no few neurons near one electrode fire so fast for minutes."""
HOLDS_MOST = 1 / 3
SEVERAL = 8
NAMED = 6


def channel_findings(recording: Recording) -> Iterator[Finding]:
    """Findings on silent channels (`silent-channels`) and noisy ones (`noisy-channels`).

    A channel is silent without a spike. It is noisy if it fires at more than 100 Hz on average, or holds more than a
    third of all spikes of eight or more channels.

    Args:
        recording: with at least one spike.
    """
    channels = recording.channels
    n, n_spikes = len(channels), len(recording.spike_times_s)
    count = np.bincount(recording.spike_channels, minlength=n)
    silent = int(np.count_nonzero(count == 0))
    if silent:
        mostly = silent > MOSTLY_SILENT * n
        message = f"{silent:,} of {n:,} channels are silent; they count in rates per channel"
        message += ": route electrodes where the culture fires" if mostly else ""
        yield Finding("silent-channels", "warning" if mostly else "note", message, float(silent))
    fast = count > FAST_HZ * recording.duration_s if recording.duration_s > 0 else np.zeros(n, dtype=bool)
    most = (count > HOLDS_MOST * n_spikes) if n >= SEVERAL and n_spikes >= 10 * n else np.zeros(n, dtype=bool)
    noisy = np.flatnonzero(fast | most)
    if len(noisy):
        share = float(count[noisy].sum() / n_spikes)
        names = ", ".join(channels.label[noisy[:NAMED]]) + (", ..." if len(noisy) > NAMED else "")
        message = (
            f"{len(noisy):,} of {n:,} channels ({names}) fire as no neurons do and hold {100 * share:.0f} % of all "
            "spikes: they carry noise; raise their threshold or leave them out of the routing"
        )
        yield Finding("noisy-channels", "warning" if share > 0.1 else "note", message, float(len(noisy)))
