"""How far the adaptive thresholds of a loop will be off, estimated from the recording that calibrates it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import ArrayLike
from scipy.special import ndtri

from animat.closed_loop.adaptive import AdaptiveThresholds
from animat.closed_loop.loop import SETTLING_ROUNDS, SETTLINGS
from animat.coding.mapping import N_PERCENTILES
from animat.neurons.expected_rank import ExpectedRank
from animat.neurons.history import ranks_among
from animat.responses.responses import Responses

_EPISODE = 100
"""Trials, after which thresholds move: about as many as an episode has."""
_APART = 10
"""Trials, at least: what neurons remember of single ones is over by then."""
_FEWEST = 20
"""Hundreds, at least: of ten the square of an error of 0.03 is known to about half of itself."""
_RANKS = np.linspace(0.0, 1.0, N_PERCENTILES)


def threshold_error(
    responses: Responses, percentiles: ArrayLike, expected: ExpectedRank, before: ExpectedRank | None
) -> float:
    """What the errors of a loop's adaptive thresholds have in common: its standard deviation, as a share of responses.

    The thresholds of a loop follow its newest responses. They are off by chance, and they come late when the culture's
    responses rise or fall. In a simulator they are never off. So a recording is taken for a loop: adaptive thresholds
    begin with those of the recording before it, settle for as many trials as a loop does, and then move after every
    hundred trials. Let r be how far a response is above the expected rank, and o the mean of how much too high P10 to
    P90 are at that time, in ranks. Then

        error^2 = mean of (r_i - o_i) (r_j - o_j)

    over all i and j of one hundred that are ten or more apart, and 0 where that is negative. With an error of 0.03 the
    median is at P47 or P53. From 5,000 responses an error of 0.03 is known to about 0.004.

    Args:
        responses: of the recording, in the order of time.
        percentiles: P0, P10, ..., P100 of its simulator, in Hz, shape (11,), or (readouts, 11).
        expected: of them.
        before: of the recording before it; None where there is none.

    Returns:
        From 0 to 1; of several readouts the root of their mean square. 0 too where it cannot be known: of the first
        recording, of one in blocks, or with fewer than 2,000 trials after those for settling.
    """
    settled = SETTLINGS * SETTLING_ROUNDS * len(responses.conditions)
    hundreds = (len(responses) - settled) // _EPISODE
    if before is None or responses.is_blocked or hundreds < _FEWEST:
        return 0.0
    those = slice(settled, settled + hundreds * _EPISODE)
    usable = (~responses.is_burst)[those].reshape(hundreds, _EPISODE)
    off = _off(responses, percentiles, before, settled, hundreds)
    products, pairs = 0.0, 0
    for readout, beyond in enumerate(expected.along(responses).T):
        common = np.where(usable, beyond[those].reshape(hundreds, _EPISODE) - off[:, None, readout], 0.0)
        for lag in range(_APART, _EPISODE):
            products += float(np.sum(common[:, lag:] * common[:, :-lag]))
            pairs += int(np.sum(usable[:, lag:] & usable[:, :-lag]))
    return float(np.sqrt(max(0.0, products / max(pairs, 1))))


def _off(
    responses: Responses, percentiles: ArrayLike, before: ExpectedRank, settled: int, hundreds: int
) -> Float64[np.ndarray, "hundreds readouts"]:
    """How much too high adaptive thresholds are in each hundred, in ranks: the mean over P10 to P90.

    Beside the simulator's, so that ties are ties in both.
    """
    usable, beyond = ~responses.is_burst, before.along(responses)
    adaptive = AdaptiveThresholds(before)
    own_hz = np.sort(responses.read_hz[usable], axis=0).reshape(int(usable.sum()), -1).T
    right = _ranks(own_hz, percentiles)
    off, done = [], 0
    for hundred in range(hundreds):
        for trial in range(done, done := settled + hundred * _EPISODE):
            if usable[trial]:
                adaptive.add(int(responses.condition[trial]), beyond[trial])
        off.append((_ranks(own_hz, adaptive.percentiles()) - right)[:, 1:-1].mean(axis=1))
    return np.array(off)


def _ranks(
    own_hz: Float64[np.ndarray, "readouts responses"], percentiles: ArrayLike
) -> Float64[np.ndarray, "readouts percentiles"]:
    """The ranks of percentiles among a recording's own responses, which are sorted."""
    each = zip(own_hz, np.atleast_2d(np.asarray(percentiles, np.float64)), strict=True)
    return np.array([ranks_among(own, of) for own, of in each])


def errors_of(error: float, number: int) -> Float64[np.ndarray, " number"]:
    """So many equally likely errors of a normal distribution with mean 0, scaled to its standard deviation.

    Args:
        error: the standard deviation, as a share of responses.
        number: how many; one alone is 0.
    """
    quantiles = ndtri((np.arange(number) + 0.5) / number)
    return np.asarray(error * quantiles / max(float(np.sqrt(np.mean(quantiles**2))), 1e-9))


def with_thresholds_off(
    percentiles: Float[np.ndarray, "*readouts percentiles"], error: float
) -> Float[np.ndarray, "*readouts percentiles"]:
    """Percentiles of a larger share of the responses: with an error of 0.1 P20 in place of P10.

    Args:
        percentiles: P0, P10, ..., P100, in Hz; between two of them it is a straight line.
        error: the share of the responses that is added, the same for all readouts. Nothing is above P100 or below P0.
    """
    moved = np.clip(_RANKS + error, 0.0, 1.0)
    of = np.asarray(percentiles, np.float32)
    flat = [np.interp(moved, _RANKS, each) for each in of.reshape(-1, N_PERCENTILES)]
    return np.asarray(flat, np.float32).reshape(of.shape)
