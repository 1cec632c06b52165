"""Adaptive thresholds: the percentiles of a recording as it would be now, not of a past hour."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from animat.coding.mapping import N_PERCENTILES
from animat.neurons.remembering import Remembered, Remembering

MOST_COUNTED = 100
"""Of a condition, as many as the paper's recording holds: of a longer one the newest, as older ones adapt late."""
LEVEL_TRIALS = 200
"""What the level is a mean over, about: settled on virtual cultures 4 and 5, tried in closed loop on 1 to 5."""


class Trial(NamedTuple):
    """What was presented and answered.

    Attributes:
        condition: that was delivered.
        x_hz: the response of all readouts, shape (), or (readouts,).
        rate_hz: that of all channels.
        first_s, at_s: its first and its last pulse.
        is_burst: whether the response was a burst.
        counts: whether thresholds may adapt to it.
    """

    condition: int
    x_hz: Float64[np.ndarray, "*readouts"]
    rate_hz: float
    first_s: float
    at_s: float
    is_burst: bool
    counts: bool


class FixedThresholds:
    """Whatever is answered, they stay as they are; what adapts builds on that.

    Attributes:
        seen: how many trials they have adapted to, or will have when they are asked for.
    """

    seen = 0

    def see(self, trial: Trial) -> None:
        """The next trial of a session."""

    def adapt(self) -> None:
        """Adapt to what was seen: when there is time for it, and not while a trial is answered."""

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """P0, P10, ..., P100 as they are now, in Hz, shape (11,), or (readouts, 11), once any trial was seen."""
        raise NotImplementedError


class LevelThresholds(FixedThresholds):
    """The percentiles of a recording, times how large responses are now beside what its simulator expects.

        level = m / e;    m' = m + (x - m) / 200;    e' = e + (E - e) / 200

    E is what a simulator with memory answers on average after the same history; m and e begin as the mean response of
    the recording. So the level is about 1 as long as the culture is the one that was recorded, whatever an agent likes
    to choose, and within some hundred trials it follows one that drifts, tires or recovers.

    Args:
        responses_hz: non-burst responses of each condition, shape (responses,), or (responses, readouts).
        remembering: of the same recording, with what is expected.
    """

    def __init__(self, responses_hz: Sequence[Float64[np.ndarray, "responses *readouts"]], remembering: Remembering):
        self._recorded_hz = _percentiles([each.tolist() for each in responses_hz])
        self._remembering, self._remembered = remembering, Remembered()
        self._mean_hz = self._expected_hz = np.concatenate(responses_hz).mean(axis=0)
        self._trials: list[Trial] = []

    def see(self, trial: Trial) -> None:
        """The next trial, also one that does not count: it is part of the next one's history."""
        self._trials.append(trial)
        self.seen += trial.counts

    def adapt(self) -> None:
        """Adapt to what was seen: some 40 us a trial."""
        for condition, x_hz, rate_hz, first_s, at_s, is_burst, counts in self._trials:
            before = self._remembered
            if counts:
                expected_hz = self._remembering.expected_hz(before, condition, first_s, at_s).reshape(np.shape(x_hz))
                self._mean_hz = self._mean_hz + (x_hz - self._mean_hz) / LEVEL_TRIALS
                self._expected_hz = self._expected_hz + (expected_hz - self._expected_hz) / LEVEL_TRIALS
            self._remembered = self._remembering.after(before, condition, rate_hz, first_s, at_s, is_burst=is_burst)
        self._trials.clear()

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """Those of the recording, times the level."""
        self.adapt()
        level = self._mean_hz / np.maximum(self._expected_hz, 1e-9)
        return np.asarray(np.expand_dims(level, -1) * self._recorded_hz, np.float32)


class AdaptiveThresholds(FixedThresholds):
    """The newest responses of each condition, and the percentiles of all of them together: without memory.

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

    def see(self, trial: Trial) -> None:
        """The next trial of a session."""
        if trial.counts:
            self.add(trial.condition, trial.x_hz)

    def add(self, condition: int, rate_hz: Float64[np.ndarray, "*readouts"]) -> None:
        """A new non-burst response to a condition, of all readouts."""
        self._newest[condition].append(rate_hz)
        self.seen += 1

    def percentiles(self) -> Float32[np.ndarray, "*readouts percentiles"]:
        """Of all together."""
        return _percentiles(self._newest)


def _percentiles(responses_hz: Sequence[Sequence[Any]]) -> Float32[np.ndarray, "*readouts percentiles"]:
    pooled = np.concatenate([np.array(each) for each in responses_hz])
    return np.asarray(np.percentile(pooled, np.linspace(0, 100, N_PERCENTILES), axis=0).T, np.float32)


def thresholds_of(
    responses_hz: Sequence[Float64[np.ndarray, "responses *readouts"]] | None, remembering: Remembering | None
) -> FixedThresholds:
    """Thresholds that adapt to a recording's responses to start from, and fixed ones where none are given."""
    if responses_hz is None:
        return FixedThresholds()
    if remembering is None or remembering.expected is None:
        return AdaptiveThresholds(responses_hz)
    return LevelThresholds(responses_hz, remembering)
