"""Spikes for the page: packed, and thinned if there are more than a screen has points."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from animat.closed_loop.log import Record

MOST = 60_000
"""Most spikes sent at once."""


def packed(records: Sequence[Record], from_s: float, to_s: float, n_channels: int) -> tuple[dict[str, Any], list[int]]:
    """The spikes of a span, and their number on each channel."""
    times = [np.empty(0), *(record.spike_times_s for record in records)]
    channels = [np.empty(0, np.int64), *(record.spike_channels for record in records)]
    return packed_spikes(np.concatenate(times), np.concatenate(channels), from_s, to_s, n_channels)


def packed_spikes(
    times_s: Float[np.ndarray, " spikes"], channels: Int[np.ndarray, " spikes"], from_s: float, to_s: float, n: int
) -> tuple[dict[str, Any], list[int]]:
    """The spikes of a span: times as 0 (its start) to 65,535 (its end), and channels, both as base64 of uint16.

    Channels beyond 65,535 are counted but not drawn.
    """
    with np.errstate(invalid="ignore"):
        within = (times_s >= from_s) & (times_s <= to_s) & (channels >= 0) & (channels < n)
    times_s, channels = times_s[within], channels[within]
    counts = np.bincount(channels, minlength=n)
    every = max(1, -(-len(times_s) // MOST))
    drawn = np.flatnonzero(channels < 2**16)[::every]
    ticks = np.rint((times_s[drawn] - from_s) / max(to_s - from_s, 1e-9) * 65535).astype("<u2")
    spikes = {
        "n": len(times_s),
        "every": every,
        "times": base64.b64encode(ticks.tobytes()).decode(),
        "channels": base64.b64encode(channels[drawn].astype("<u2").tobytes()).decode(),
    }
    return spikes, counts.tolist()
