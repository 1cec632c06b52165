"""Spikes for the page: packed, and thinned if there are more than a screen has points."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from jaxtyping import Float, Int

MOST = 60_000
"""Most spikes sent at once."""


def packed(
    times_s: Float[np.ndarray, " spikes"], channels: Int[np.ndarray, " spikes"], from_s: float, to_s: float, n: int
) -> tuple[dict[str, Any], list[int]]:
    """The spikes of a span on n channels, and their number on each.

    Times are 0 (the span's start) to 65,535 (its end); times and channels are uint16 in base64. Channels beyond 65,535
    are counted but not drawn.
    """
    with np.errstate(invalid="ignore"):
        within = (times_s >= from_s) & (times_s <= to_s) & (channels >= 0) & (channels < n)
    times_s, channels = times_s[within], channels[within]
    every = max(1, -(-len(times_s) // MOST))
    drawn = np.flatnonzero(channels < 2**16)[::every]
    ticks = np.rint((times_s[drawn] - from_s) / max(to_s - from_s, 1e-9) * 65535).astype("<u2")
    spikes = {
        "n": len(times_s),
        "every": every,
        "times": base64.b64encode(ticks.tobytes()).decode(),
        "channels": base64.b64encode(channels[drawn].astype("<u2").tobytes()).decode(),
    }
    return spikes, np.bincount(channels, minlength=n).tolist()
