"""Whether what a backend answers can be: a closed loop believes nothing that it did not look at."""

from __future__ import annotations

from math import isfinite

import numpy as np
from jaxtyping import Float64

from animat.cultures.failing import in_words
from animat.cultures.observed import Observed


def wrong_with(
    observed: Observed,
    *,
    asked_s: Float64[np.ndarray, " stimuli"],
    duration_s: float,
    since_s: float,
    from_s: float,
    sample_s: float,
    n_channels: int,
) -> str | None:
    """What is wrong with an answer, in a sentence; None for one that can be.

    Args:
        observed: the answer.
        asked_s: times of the stimuli, counted from `since_s`: none can begin before.
        duration_s: that was asked for: it is seen up to then at least.
        since_s: when it was asked for, on the culture's clock.
        from_s: the soonest time on the culture's clock that it can begin at.
        sample_s: of the culture; times may be rounded to whole ones.
        n_channels: of the culture.
    """
    try:
        times_s, channel = observed.spikes
        pulses_s, start_s, seen_s = observed.stimulus_time_s, observed.start_s, observed.duration_s
        if len(times_s) != len(channel):
            return f"the culture answered {len(times_s)} spike times for {len(channel)} channels"
        if pulses_s.shape != asked_s.shape:
            return f"the culture answered {pulses_s.shape} stimulus times for {len(asked_s)} stimuli"
        if start_s < from_s - 1.5 * sample_s:
            return f"the culture's clock went back to {start_s} s"
        if not (isfinite(start_s) and isfinite(seen_s) and start_s + seen_s >= since_s + duration_s - 1e-6):
            asked = f"{duration_s} s from {since_s} s"
            return f"the culture answered a stretch of {seen_s} s from {start_s} s where {asked} were asked"
        for name, given_s in (("spike", times_s), ("stimulus", pulses_s)):
            # Not (a <= b): a NaN fails it too.
            if len(given_s) and not (given_s[0] >= -1e-9 and given_s[-1] <= seen_s + 1e-9):
                return f"the culture answered {name} times outside of the {seen_s:g} s that were seen"
            if not bool((given_s[1:] >= given_s[:-1]).all()):
                return f"the culture answered {name} times that are no rising numbers"
        # From when the answer starts.
        asked_s = asked_s - (start_s - since_s)
        if bool((pulses_s < asked_s - 1.5 * sample_s).any()):
            early_ms = 1000 * float((asked_s - pulses_s).max())
            return f"the culture answered that a stimulus came {early_ms:.3g} ms before it was asked for"
        if channel.dtype.kind not in "iu":
            return f"the culture answered channels that are no whole numbers ({channel.dtype})"
        if len(channel) and not (channel.min() >= 0 and channel.max() < n_channels):
            return f"the culture answered channel {int(channel.max())} of {n_channels}"
    except Exception as error:
        return f"the culture answered something that cannot be read: {in_words(error)}"
    return None
