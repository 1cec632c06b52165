"""How far the adaptive thresholds of a loop will be off, as told by the recording that calibrates it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import ndtri

from animat.closed_loop.adaptive import AdaptiveThresholds
from animat.coding.mapping import N_PERCENTILES
from animat.neurons.history import Ranked, ranks_among
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import NeuronSimulator
from animat.responses.responses import Responses

_EPISODE = 100
"""Trials, after which thresholds move: about as many as an episode has."""
_APART = 10
"""Trials, at least: what neurons remember of single ones is over by then."""
_RANKS = np.linspace(0.0, 1.0, N_PERCENTILES)


def threshold_error(responses: Responses, simulator: NeuronSimulator, before: Responses | None = None) -> float:
    """The standard deviation of the error of adaptive thresholds, in ranks: 0.1 is from P50 to P60.

    The thresholds of a loop are percentiles of its newest responses. They are off by chance, and as they come late when
    the culture's responses rise or fall. To a simulator, whose percentiles are those of its own responses, neither
    happens. So a loop's thresholds are led through the recording, and move after every hundred trials. With r the rank
    of a response beyond what the simulator expects, and o how far thresholds are off then, the error is what the r - o
    of a hundred trials have in common: the square root of the mean product of two that are ten or more apart, 0 where
    that is negative.

    Args:
        responses: of the recording, in the order of time.
        simulator: made of them.
        before: the recording before it, where thresholds begin; None: with its own responses.
    """
    episodes = len(responses) // _EPISODE
    if not episodes:
        return 0.0
    usable, columns = ~responses.is_burst, responses.read_hz.reshape(len(responses), -1)
    known = [np.ones(len(responses))]
    if isinstance(simulator, MemorySimulator):
        ranked = Ranked(responses)
        known += [ranked.traces(simulator.memory), ranked.loads(simulator.memory.load_s).at]
    off = _off(responses, before or responses).reshape(len(responses), -1)
    products, pairs = 0.0, 0
    for column, error in zip(columns.T, off.T, strict=True):
        beyond = ranks_among(np.sort(column[usable]), column)
        for condition in range(len(responses.conditions)):
            rows = usable & (responses.condition == condition)
            history = np.stack([each[rows] for each in known], axis=1)
            beyond[rows] -= history @ np.linalg.lstsq(history, beyond[rows], rcond=None)[0]
        in_one = np.where(usable, beyond - error, 0.0)[: episodes * _EPISODE].reshape(episodes, _EPISODE)
        for lag in range(_APART, _EPISODE):
            products += float(np.sum(in_one[:, lag:] * in_one[:, :-lag]))
            pairs += episodes * (_EPISODE - lag)
    return float(np.sqrt(max(0.0, products / pairs)))


def _off(responses: Responses, before: Responses) -> Float64[np.ndarray, "responses *readouts"]:
    """How far a loop's thresholds would be too high at each response, in ranks: the mean over P10 to P90."""
    adaptive = AdaptiveThresholds([before.read_of(i) for i in range(len(before.conditions))])
    own_hz = np.sort(responses.read_hz[~responses.is_burst], axis=0)
    off, now = [], np.zeros(own_hz.shape[1:])
    for number, (condition, x_hz, is_burst) in enumerate(
        zip(responses.condition.tolist(), responses.read_hz, responses.is_burst.tolist(), strict=True)
    ):
        if number % _EPISODE == 0:
            percentiles = np.atleast_2d(np.asarray(adaptive.percentiles(), np.float64))
            each = zip(own_hz.reshape(len(own_hz), -1).T, percentiles, strict=True)
            now = np.array([np.mean(ranks_among(own, of[1:-1]) - _RANKS[1:-1]) for own, of in each])
            now = now.reshape(own_hz.shape[1:])
        off.append(now)
        if not is_burst:
            adaptive.add(condition, x_hz)
    return np.array(off)


def errors_of(error: float, number: int) -> Float64[np.ndarray, " number"]:
    """So many equally likely errors with mean 0 and this standard deviation, of a normal distribution."""
    ranks = ndtri((np.arange(number) + 0.5) / number)
    return np.asarray(error * ranks / max(float(np.sqrt(np.mean(ranks**2))), 1e-9))


def with_thresholds_off(
    percentiles: Float[np.ndarray, "*readouts percentiles"], error: float
) -> Float[np.ndarray, "*readouts percentiles"]:
    """The percentiles by so many ranks higher, straight between two of them; never below P0 or above P100."""
    moved = np.clip(_RANKS + error, 0.0, 1.0)
    of = np.asarray(percentiles, np.float32)
    flat = [np.interp(moved, _RANKS, each) for each in of.reshape(-1, N_PERCENTILES)]
    return np.asarray(flat, np.float32).reshape(of.shape)
