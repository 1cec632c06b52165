"""How far a loop's thresholds will be off.

Oracles: closed forms of the sampling error of percentiles, and of what responses have in common that rise and fall.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.neurons.memory import fit_memory
from animat.neurons.simulator import fit_empirical
from animat.neurons.synthetic import LABELS
from animat.reality_gap.threshold_error import errors_of, threshold_error, with_thresholds_off
from animat.responses.condition import Condition
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses

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
    for seed in range(6):
        before, responses = presented(drawn(100 + seed, 500)), presented(drawn(seed, 60_000))
        squares.append(threshold_error(responses, fit_empirical(responses), before) ** 2)
    # Three standard errors: a square is known to 3e-5, by as many hundreds.
    assert np.mean(squares) == pytest.approx(of_percentiles(500) ** 2, abs=3 * 3e-5)


def test_what_a_hundred_responses_have_in_common_is_part_of_it() -> None:
    rng = np.random.default_rng(4)
    moved = 0.05 * rng.choice([-1, 1], 600)
    before, responses = presented(drawn(5, 500)), presented(drawn(6, 60_000) + np.repeat(moved, 100))
    # Thresholds hold the five hundreds before, which are by chance higher or lower, too.
    expected = np.sqrt(0.05**2 * (1 + 1 / 5) + of_percentiles(500) ** 2)
    assert threshold_error(responses, fit_empirical(responses), before) == pytest.approx(expected, rel=0.1)


def test_what_the_simulator_knows_is_no_part_of_it() -> None:
    """Each response is higher after a high one: a simulator without memory does not know that, but it is soon over."""
    rng = np.random.default_rng(7)
    latent = [0.0]
    for step in rng.normal(size=19_999):
        latent.append(0.6 * latent[-1] + 0.8 * float(step))
    responses = presented(np.exp(np.array(latent)))
    with_memory, without = (threshold_error(responses, fit(responses)) for fit in (fit_memory, fit_empirical))
    # Percentiles of such responses are surer or less sure than of independent ones by the sum of the correlations.
    sampling = of_percentiles(500) * np.sqrt((1 + 0.6) / (1 - 0.6))
    assert with_memory == pytest.approx(sampling, rel=0.25) and without == pytest.approx(sampling, rel=0.25)


def test_of_two_readouts_it_is_the_mean_square() -> None:
    moved = np.repeat(np.random.default_rng(12).normal(size=50), 100)
    left, right = drawn(8, 5_000) + 0.1 * moved, drawn(9, 5_000) - 0.2 * moved
    both = presented(left + right, readout_hz=np.stack([left, right], axis=1))
    alone = [threshold_error(each, fit_empirical(each)) for each in map(presented, (left, right))]
    assert threshold_error(both, fit_empirical(both)) == pytest.approx(np.sqrt(np.mean(np.square(alone))))


def test_of_few_responses_none_is_told() -> None:
    responses = presented(drawn(10, 99))
    assert threshold_error(responses, fit_empirical(responses)) == 0.0


@given(error=st.floats(0, 0.3), number=st.integers(2, 40))
def test_errors_have_the_standard_deviation_that_was_asked_for(error: float, number: int) -> None:
    errors = errors_of(error, number)
    assert np.mean(errors) == pytest.approx(0, abs=1e-9) and np.std(errors) == pytest.approx(error, abs=1e-9)
    assert np.all(np.diff(errors) >= 0)


def shapes() -> Iterator[tuple[int, ...]]:
    yield (11,)
    yield (2, 11)


@pytest.mark.parametrize("shape", shapes())
def test_thresholds_that_are_off_by_a_tenth_are_the_next_percentiles(shape: tuple[int, ...]) -> None:
    rising = np.cumsum(np.random.default_rng(11).random(shape), axis=-1).astype(np.float32)
    higher, lower = (with_thresholds_off(rising, error) for error in (0.1, -0.1))
    np.testing.assert_allclose(higher[..., :-1], rising[..., 1:], rtol=1e-6)
    np.testing.assert_allclose(lower[..., 1:], rising[..., :-1], rtol=1e-6)
    assert np.array_equal(higher[..., -1], rising[..., -1]) and np.array_equal(lower[..., 0], rising[..., 0])
    np.testing.assert_array_equal(with_thresholds_off(rising, 0.0), rising)
    np.testing.assert_allclose(with_thresholds_off(rising, 0.05)[..., 4], rising[..., 4:6].mean(axis=-1), rtol=1e-5)
