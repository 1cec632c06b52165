"""Adaptive thresholds: the percentiles of the culture's newest responses, not of a past hour."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from animat.coding.mapping import N_PERCENTILES

MOST_COUNTED = 100
"""Of a condition, as many as the paper's recording holds: of a longer one the newest, as older ones adapt late."""


class AdaptiveThresholds:
    """The newest responses of each condition, and the percentiles of all of them together.

    A culture drifts and tires: minutes after a recording its responses to all conditions are smaller, and more of them
    stay under the recording's median. So each new response takes the place of the oldest one of its condition. Every
    condition keeps the share that it has in the recording, however often it is chosen: percentiles are of what a
    recording would hold now, and not of what a policy likes to choose.

    Args:
        responses_hz: non-burst responses of each condition, in the order of time, shape (responses,), or (responses,
            readouts). Where a condition has more than `MOST_COUNTED`, the newest count, of all conditions the same
            part.
    """

    def __init__(self, responses_hz: Sequence[Float64[np.ndarray, "responses *readouts"]]) -> None:
        part = min(1.0, MOST_COUNTED / max(len(each) for each in responses_hz))
        self._newest = [deque(each, maxlen=max(1, round(part * len(each)))) for each in responses_hz]
        self.seen = 0

    def add(self, condition: int, rate_hz: Float64[np.ndarray, "*readouts"]) -> None:
        """A new non-burst response to a condition, of all readouts."""
        self._newest[condition].append(rate_hz)
        self.seen += 1

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """P0, P10, ..., P100 of all together, in Hz, shape (11,), or (readouts, 11)."""
        pooled = np.concatenate([np.array(each) for each in self._newest])
        return np.asarray(np.percentile(pooled, np.linspace(0, 100, N_PERCENTILES), axis=0).T, np.float32)
