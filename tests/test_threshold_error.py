"""How far a loop's thresholds will be off.

Oracles: closed forms of the sampling error of percentiles, and of what responses have in common that rise and fall.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.neurons.history import NO_MEMORY
from animat.neurons.memory import fit_memory
from animat.neurons.simulator import fit_empirical
from animat.neurons.synthetic import LABELS
from animat.reality_gap.threshold_error import errors_of, threshold_error, with_thresholds_off
from animat.responses.condition import Condition
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation

CONDITIONS = tuple(Condition(label, float(i)) for i, label in enumerate(LABELS))


def presented(rate_hz: np.ndarray, seed: int = 1, *, readout_hz: np.ndarray | None = None) -> Responses:
    """Responses to conditions that are shuffled a round at a time."""
    rng = np.random.default_rng(seed)
    n, k = len(rate_hz), len(CONDITIONS)
    condition = np.concatenate([rng.permutation(k) for _ in range(-(-n // k))])[:n]
    half = np.full(n, 0.5)
    made = Responses(condition, rate_hz, half, np.zeros(n, bool), CONDITIONS, (10.0, 20.0), 60, 1.0, np.nan)
    if readout_hz is None:
        return made
    sides = Readouts(("left", "right"), ((1,), (2,)))
    return replace(made, readouts=sides, readout_hz=readout_hz)


def drawn(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).random(n)


def of_percentiles(n: int) -> float:
    """The standard deviation of the mean rank of P10 to P90 of n independent responses."""
    p = np.arange(1, 10) / 10
    return float(np.sqrt(np.mean(np.minimum.outer(p, p) - np.outer(p, p)) / n))


def test_of_independent_responses_it_is_the_sampling_error_of_percentiles() -> None:
    # A hundred newest of each of five conditions.
    squares = []
    for seed in range(4):
        before, responses = presented(drawn(100 + seed, 5_000)), presented(drawn(seed, 60_000))
        squares.append(threshold_error(responses, fit_empirical(responses), before) ** 2)
    # Three standard errors: a square is known to 3.6e-5, by as many hundreds.
    assert np.mean(squares) == pytest.approx(of_percentiles(500) ** 2, abs=3 * 3.6e-5)


@pytest.mark.parametrize("period", [1_000, 2_000])
def test_thresholds_come_late_by_the_five_hundreds_that_they_hold(period: int) -> None:
    trials = np.arange(40_000)
    risen = 0.07 * np.sin(2 * np.pi * trials / period)
    before, responses = presented(drawn(5, 5_000)), presented(drawn(6, 40_000) + risen)
    hundreds = risen.reshape(-1, 100).mean(axis=1)
    held = np.convolve(hundreds, np.ones(5) / 5)[: len(hundreds)]
    late = (hundreds[5:] - held[4:-1]) ** 2
    # Ranks rise by a twentieth less, as the smallest and the largest responses cannot.
    expected = np.sqrt(0.95**2 * late.mean() + of_percentiles(500) ** 2)
    assert threshold_error(responses, fit_empirical(responses), before) == pytest.approx(expected, rel=0.1)


def test_thresholds_begin_with_the_recording_before_and_settle_for_300_trials() -> None:
    squares = []
    for seed in range(20):
        before, responses = presented(drawn(seed, 5_000) + 0.5), presented(drawn(50 + seed, 5_000))
        squares.append(threshold_error(responses, fit_empirical(responses), before) ** 2)
    # Two fifths of it, then one, are held in the first two of 47 hundreds, and P10 to P90 are then too high.
    held = [np.concatenate([np.linspace(0, 1, 1001) + 0.5] * k + [np.linspace(0, 1, 1001)] * (5 - k)) for k in (2, 1)]
    too_high = [
        np.mean(np.clip(np.percentile(each, range(10, 100, 10)), 0, 1) - np.arange(1, 10) / 10) for each in held
    ]
    expected = np.sum(np.square(too_high)) / 47 + of_percentiles(500) ** 2
    assert np.mean(squares) == pytest.approx(expected, rel=0.2)


def test_bursts_are_left_out() -> None:
    risen = np.repeat(0.05 * np.random.default_rng(4).choice([-1, 1], 400), 100)
    rate_hz, is_burst = drawn(6, 40_000) + risen, np.random.default_rng(13).random(40_000) < 0.4
    before = presented(drawn(5, 5_000))
    without, with_bursts = presented(rate_hz), presented(np.where(is_burst, 50.0, rate_hz))
    with_bursts = replace(with_bursts, is_burst=is_burst)
    found = [threshold_error(each, fit_empirical(each), before) for each in (without, with_bursts)]
    # The five hundreds that are held are by chance higher or lower, too.
    assert found[0] == pytest.approx(np.sqrt(0.05**2 * (1 + 1 / 5) + of_percentiles(500) ** 2), rel=0.1)
    # Of fewer responses in a hundred more hundreds are held.
    assert found[1] == pytest.approx(np.sqrt(0.05**2 * (1 + 1 / 9) + of_percentiles(500) ** 2), rel=0.1)


def test_ties_are_no_error() -> None:
    """Where most responses are alike, thresholds on the same number are right."""
    rng = np.random.default_rng(14)
    before, responses = (presented(rng.choice([0.0, 10.0], n, p=[0.96, 0.04])) for n in (5_000, 20_000))
    assert threshold_error(responses, fit_empirical(responses), before) < 0.01


def test_what_the_simulator_knows_is_no_part_of_it() -> None:
    """Responses are alike for some dozen trials, which a simulator with memory knows of the response before."""
    latent = [0.0]
    for step in np.random.default_rng(7).normal(size=19_999):
        latent.append(0.9 * latent[-1] + np.sqrt(1 - 0.9**2) * float(step))
    before, responses = presented(drawn(15, 5_000)), presented(np.exp(np.array(latent)))
    with_memory, without = (threshold_error(responses, fit(responses), before) for fit in (fit_memory, fit_empirical))
    assert with_memory < 0.7 * without
    forgetful = fit_memory(responses, memory=NO_MEMORY)
    assert threshold_error(responses, forgetful, before) == without


def test_of_two_readouts_it_is_the_mean_square() -> None:
    moved = np.repeat(np.random.default_rng(12).normal(size=50), 100)
    left, right = drawn(8, 5_000) + 0.1 * moved, drawn(9, 5_000) - 0.2 * moved
    both, *alone = (presented(left + right, readout_hz=np.stack([left, right], axis=1)), *map(presented, (left, right)))
    each = [threshold_error(one, fit_empirical(one), one) for one in alone]
    assert threshold_error(both, fit_empirical(both), both) == pytest.approx(np.sqrt(np.mean(np.square(each))))


def test_where_it_cannot_be_known_it_is_none() -> None:
    moved = np.repeat(np.random.default_rng(12).normal(size=50), 100)
    responses = presented(drawn(8, 5_000) + 0.1 * moved)
    simulator = fit_empirical(responses)
    assert threshold_error(responses, simulator, responses) > 0.05
    assert threshold_error(responses, simulator, None) == 0.0
    blocked = replace(responses, presentation=Presentation("blocked", 1))
    assert threshold_error(blocked, simulator, responses) == 0.0
    few = presented(drawn(8, 2_200) + 0.1 * moved[:2_200])
    assert threshold_error(few, fit_empirical(few), responses) == 0.0


@given(error=st.floats(0, 0.3), number=st.integers(2, 40))
def test_errors_have_the_standard_deviation_that_was_asked_for(error: float, number: int) -> None:
    errors = errors_of(error, number)
    assert np.mean(errors) == pytest.approx(0, abs=1e-9) and np.std(errors) == pytest.approx(error, abs=1e-9)
    assert np.all(np.diff(errors) >= 0)


@pytest.mark.parametrize("shape", [(11,), (2, 11)])
def test_thresholds_that_are_off_by_a_tenth_are_the_next_percentiles(shape: tuple[int, ...]) -> None:
    rising = np.cumsum(np.random.default_rng(11).random(shape), axis=-1).astype(np.float32)
    higher, lower = (with_thresholds_off(rising, error) for error in (0.1, -0.1))
    np.testing.assert_allclose(higher[..., :-1], rising[..., 1:], rtol=1e-6)
    np.testing.assert_allclose(lower[..., 1:], rising[..., :-1], rtol=1e-6)
    assert np.array_equal(higher[..., -1], rising[..., -1]) and np.array_equal(lower[..., 0], rising[..., 0])
    np.testing.assert_array_equal(with_thresholds_off(rising, 0.0), rising)
    np.testing.assert_allclose(with_thresholds_off(rising, 0.05)[..., 4], rising[..., 4:6].mean(axis=-1), rtol=1e-5)
