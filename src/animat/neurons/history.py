"""The history state: what neurons remember, as two numbers, and how to compute it from a recording."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from animat.responses.conditions import NO_CONDITION
from animat.responses.responses import Responses

INITIAL_HISTORY = (0.5, 0.5)
"""Trace and load at the start of an episode: its warm-up was presented in random order, as in a recording.

The trace summarises the latest responses, from 0 to 1; the load the stimulation of the last seconds, 0 or more.
"""


class Memory(NamedTuple):
    """How the history state follows from stimuli and responses, and how strongly a response depends on it.

        p' = decay p + (1 - decay) (r + weight m) / (1 + weight)
        p' = decay p + (1 - decay) (r + |weight| (1 - m)) / (1 + |weight|)    with a weight below 0
        l  = exp(-t / load_s) l',    l' = l + c

    The trace p summarises the latest responses: p before a response and p' after it, r the response's rank (the share
    of all responses below it), m the mean rank of its condition; all are in [0, 1]. Ranks are of the response of all
    channels, even with several readouts. With the weight -1 a response counts by how far it is above the mean of its
    condition. After silence the trace is that of r = m = 0. The load l is how much was stimulated in the last seconds:
    it decays during the time t from one trial to the next, and each trial adds c, chosen so that the mean load over the
    recording is 0.5.

    Attributes:
        decay: of the previous trace; 0: only the last trial is remembered.
        weight: of the stimulus relative to the response, from -1; 0: only the response is remembered.
        neighbour_exponent: of n responses, the n^neighbour_exponent with the nearest histories may be drawn; 1: all.
        load_s: the load's time constant, s; 0: no load.
    """

    decay: float
    weight: float
    neighbour_exponent: float
    load_s: float = 0.0

    @property
    def silence(self) -> float:
        """The trace after silence."""
        return float(trace_after_silence(self.weight))


NO_MEMORY = Memory(0.0, 0.0, 1.0)


class Loads(NamedTuple):
    """The load of a recording: at every trial, at each response, and after the trial before that.

    Attributes:
        kept: the share that is left when a trial of each condition comes, shape (conditions,).
        added: by each trial; 0: there is no load.
    """

    every: Float64[np.ndarray, " presentations"]
    at: Float64[np.ndarray, " responses"]
    after: Float64[np.ndarray, " responses"]
    kept: Float64[np.ndarray, " conditions"]
    added: float


class Ranked:
    """Responses by rank, and the history states of all trials of their recording (`Responses.presentations`).

    Attributes:
        sorted_hz: the non-burst responses, rising.
        rank: of each, the share of non-burst responses below it, ties counted half.
        means: the mean rank of each condition's non-burst responses.
        rows: of each condition, the responses that can be drawn.
        rests: whether its trials come after silence, as a rule.
        has_one_frequency: whether all conditions have the same.
    """

    def __init__(self, responses: Responses) -> None:
        self._presented, self._place = responses.presentations
        self.sorted_hz = np.sort(responses.non_burst_rate_hz)
        self.rank = ranks_among(self.sorted_hz, responses.rate_hz)
        conditions = range(len(responses.conditions))
        usable = [np.flatnonzero(~responses.is_burst & (responses.condition == c)) for c in conditions]
        self.means = np.array([self.rank[rows].mean() for rows in usable])
        known = ~np.isnan(responses.last_hz)
        self.rows = [rows[known[rows]] if known[rows].any() else rows for rows in usable]
        rested = [self._presented.is_rested[self._presented.condition == c] for c in conditions]
        self.rests = np.array([len(of) > 0 and 2 * np.count_nonzero(of) > len(of) for of in rested])
        frequencies_hz = [
            frequency_hz for of in responses.conditions for frequency_hz in of.frequencies_hz or (np.nan,)
        ]
        self.has_one_frequency = len(set(frequencies_hz)) == 1 and not np.isnan(frequencies_hz[0])

    def traces(self, memory: Memory) -> Float64[np.ndarray, " responses"]:
        """The trace before each response."""
        return np.asarray(self.recorded(memory)[0][self._place])

    def states(self, memory: Memory) -> Float64[np.ndarray, "responses 2"]:
        """Trace and load before each response."""
        return np.stack([self.traces(memory), self.loads(memory.load_s).at], axis=-1)

    def recorded(
        self, memory: Memory
    ) -> tuple[Float64[np.ndarray, " presentations"], Float64[np.ndarray, " presentations"]]:
        """The trace before each trial, and the increment by its response."""
        presented = self._presented
        # For trials without a condition, the middle rank is as good as any.
        means = np.where(presented.condition == NO_CONDITION, 0.5, self.means[presented.condition])
        left = trace_increment(ranks_among(self.sorted_hz, presented.rate_hz), means, memory)
        trace, traces = memory.silence, []
        trials = (presented.is_rested.tolist(), presented.is_burst.tolist(), left.tolist())
        for is_rested, is_burst, more in zip(*trials, strict=True):
            trace = memory.silence if is_rested else trace
            traces.append(trace)
            # The trace after a burst is not known: the next response is not drawn, and the trace starts again.
            trace = 0.5 if is_burst else memory.decay * trace + more
        return np.array(traces, np.float64), left

    def loads(self, load_s: float) -> Loads:
        """The load before each response."""
        presented = self._presented
        if not load_s or presented.clock_s is None:
            every = np.full(len(presented.rate_hz), 0.5)
            half = every[self._place]
            return Loads(every, half, half, np.ones(len(self.rows)), 0.0)
        since_s = np.diff(presented.clock_s, prepend=-np.inf)
        left, lefts, loads = 0.0, [], []
        for kept in np.exp(-since_s / load_s).tolist():
            lefts.append(left)
            loads.append(kept * left)
            left = loads[-1] + 1
        # The time before the very first trial is infinite.
        of_each = [np.isfinite(since_s) & (presented.condition == c) for c in range(len(self.rows))]
        usual_s = [np.median(since_s[of]) if of.any() else np.inf for of in of_each]
        added = 0.5 / max(float(np.mean(loads)), 1e-9)
        every, after = added * np.array(loads), added * np.array(lefts)[self._place]
        return Loads(every, every[self._place], after, np.exp(-np.array(usual_s) / load_s), added)


def ranks_among(
    sorted_hz: Float64[np.ndarray, " others"], rate_hz: Float64[np.ndarray, " values"]
) -> Float64[np.ndarray, " values"]:
    """The share of sorted responses that lies below each of other responses; ties counted half."""
    below, no_larger = sorted_hz.searchsorted(rate_hz, "left"), sorted_hz.searchsorted(rate_hz, "right")
    return np.asarray((below + no_larger) / (2 * len(sorted_hz)))


def trace_increment(
    rank: Float64[np.ndarray, " responses"], mean: Float64[np.ndarray, "#responses"] | float, memory: Memory
) -> Float64[np.ndarray, " responses"]:
    """What responses add to the trace."""
    weight, stimulus = abs(memory.weight), mean if memory.weight >= 0 else 1 - mean
    return np.asarray((1 - memory.decay) * (rank + weight * stimulus) / (1 + weight))


def trace_after_silence(weight: Any) -> Any:
    """The trace for a weight, a number or an array of any kind, if rank and mean are 0: |w| / (1 + |w|) below 0."""
    return (abs(weight) - weight) / (2 * (1 + abs(weight)))
