"""What a device did otherwise than planned while it was recorded, as findings of the recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from animat.cultures.observed import Observed
from animat.recordings.findings import Finding
from animat.stimulation.schedule import Block

LATE_S, LATE_PART = 0.001, 0.05
"""Stimuli that come later than planned by more than this, and than this part of their interval, are counted."""
_LEAST_UNOBSERVED_S = 0.0005
"""Less would be reported as 0 ms."""
LATE_SHARE, LOST_SHARE = 0.1, 0.01
"""Shares of the stimuli, and of the frames or spikes, above which there is a warning."""


def shortfall_findings(
    parts: Sequence[tuple[Block, Observed]], left_out: Mapping[str, int], unobserved_s: float, rate_hz: float
) -> Iterator[Finding]:
    """Findings on what a recording lacks (`left-out`), and on stimuli that came late (`late-stimuli`).

    Args:
        parts: what was planned, and what was observed.
        left_out: counts of what the device reported, or should have, and the recording lacks, by description.
        unobserved_s: duration of the gaps between stretches.
        rate_hz: frames per second.
    """
    lacks = [f"{count:,} {what}" for what, count in left_out.items()]
    if unobserved_s >= _LEAST_UNOBSERVED_S:
        lacks.append(f"{1000 * unobserved_s:.0f} ms between stretches")
    if lacks:
        n_frames = rate_hz * sum(observed.duration_s for _, observed in parts)
        n_spikes = sum(len(observed.spikes.time_s) for _, observed in parts)
        lost_frames = sum(count for what, count in left_out.items() if what.startswith("frames"))
        lost_spikes = sum(left_out.values()) - lost_frames
        share_of_frames = (lost_frames + rate_hz * unobserved_s) / n_frames
        share = max(share_of_frames, lost_spikes / max(1, lost_spikes + n_spikes))
        message = f"the device reported, or should have, what the recording lacks: {', '.join(lacks)}"
        yield Finding("left-out", "warning" if share > LOST_SHARE else "note", message, share)
    delays_s = [observed.stimulus_time_s - block.stimuli.time_s for block, observed in parts]
    later_s = np.concatenate([np.diff(delay_s, prepend=0.0) for delay_s in delays_s])
    planned_s = np.concatenate([np.diff(block.stimuli.time_s, prepend=0.0) for block, _ in parts])
    late_s = later_s[later_s > np.maximum(LATE_S, LATE_PART * planned_s)]
    if len(late_s):
        share = len(late_s) / len(later_s)
        by = f"{1000 * np.median(late_s):.3g} ms (median, at most {1000 * late_s.max():.3g})"
        message = (
            f"{len(late_s):,} of {len(later_s):,} stimuli ({100 * share:.0f} %) came later after the one before than "
            f"planned, by more than {1000 * LATE_S:g} ms and {100 * LATE_PART:g} % of the interval: by {by}, so their "
            "frequency is lower than stated"
        )
        remedy = "; present lower frequencies, and run nothing else on the machine" if share > LATE_SHARE else ""
        yield Finding("late-stimuli", "warning" if remedy else "note", message + remedy, share)
