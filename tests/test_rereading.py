"""A recording as adaptive thresholds read it: what this removes, what it keeps, and which predictions use it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, percentileofscore, spearmanr

from animat.coding.mapping import Linear
from animat.neurons.history import Memory, Ranked
from animat.neurons.history_tracker import AdjustedRanks
from animat.neurons.memory import MemorySimulator, fit_memory
from animat.neurons.simulator import fit_empirical
from animat.reality_gap import Calibration
from animat.reality_gap.calibration import reread
from animat.responses.extraction import extract_responses
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.stimulation.protocol import Presentation
from fake_culture import FakeCulture
from test_adaptive_thresholds import MEMORY, PROTOCOL, Answered, newest_after, responses_of
from test_reality_gap import policy_of


def mixed(rng: np.random.Generator, n: int, rises: np.ndarray | float = 0.0) -> Responses:
    """Five conditions in random order, log-normal about their means, all of which rise and fall together."""
    condition = rng.permutation(np.repeat(np.arange(5), n // 5))
    return responses_of(condition, np.exp(0.3 * condition + 0.5 * (rng.normal(size=n) + rises)))


def read(responses: Responses) -> Responses:
    return reread(responses, AdjustedRanks.of(responses, fit_empirical(responses)))


def in_common(responses: Responses) -> float:
    """What ranks 10 to 80 trials apart have in common in addition to their condition: the root of the mean product."""
    rank = np.argsort(np.argsort(responses.rate_hz)) / len(responses)
    for condition in range(5):
        rank[responses.condition == condition] -= rank[responses.condition == condition].mean()
    product = float(np.mean([np.mean(rank[lag:] * rank[:-lag]) for lag in range(10, 80)]))
    return float(np.sqrt(max(product, 0.0)))


def test_changes_over_minutes_are_removed() -> None:
    rng, n = np.random.default_rng(1), 5_000
    rising = mixed(rng, n, np.sin(2 * np.pi * np.arange(n) / 400))
    left = read(rising)
    assert in_common(rising) > 0.1
    assert in_common(left) < 0.05
    # The responses of a condition spread less by that, and conditions differ as before.
    for condition in range(5):
        was, now = (np.std(np.log(each.rates_of(condition))) for each in (rising, left))
        assert now < 0.92 * was
    shares = [[np.mean(each.rates_of(c) >= each.median_rate_hz) for c in range(5)] for each in (rising, left)]
    assert np.ptp(shares[1]) > np.ptp(shares[0])
    assert left.median_rate_hz == pytest.approx(rising.median_rate_hz, rel=0.02)


def test_independent_responses_stay_nearly_as_they_are() -> None:
    independent = mixed(np.random.default_rng(2), 5_000)
    left = read(independent)
    # Thresholds from so few of the latest responses have a random error: 1 / sqrt(45) of a standard deviation.
    assert spearmanr(independent.rate_hz, left.rate_hz).statistic > 0.975
    assert np.corrcoef(np.log(independent.rate_hz), np.log(left.rate_hz))[0, 1] > 0.97


@pytest.mark.oracle
def test_each_response_is_at_the_rank_that_it_has_for_the_thresholds_before_it() -> None:
    """Computed again with SciPy's ranks, and with trace and load as a recording has them."""
    with FakeCulture() as culture:
        recorded = extract_responses(culture.record(PROTOCOL, 0), burst_threshold=0.95)
    adjusted = AdjustedRanks.of(recorded, fit_memory(recorded, memory=MEMORY))
    left, ranked = reread(recorded, adjusted), Ranked(recorded)
    history = np.stack([ranked.traces(MEMORY), ranked.loads(MEMORY.load_s).at], axis=1)
    explained, everything = history @ adjusted.slopes[:, 0], np.sort(np.concatenate(adjusted.responses_hz))
    answered: list[Answered] = []
    for trial in range(len(recorded)):
        x, ranks = recorded.rate_hz[trial], list(adjusted.ranks)
        pooled, by = newest_after(list(adjusted.responses_hz), answered, among=everything, recorded_ranks=ranks)
        rank = norm.cdf(norm.ppf(percentileofscore(pooled, x, kind="mean") / 100) - by)
        assert left.rate_hz[trial] == pytest.approx(np.quantile(everything, rank), rel=1e-5)
        if not recorded.is_burst[trial]:
            answered.append((int(recorded.condition[trial]), float(x), float(explained[trial])))
    presented, place = left.presentations
    np.testing.assert_array_equal(presented.rate_hz[place], left.rate_hz)


def test_of_readouts_each_is_read_by_its_own_and_bursts_move_nothing() -> None:
    rng = np.random.default_rng(4)
    one, other = mixed(rng, 500, 1.0), mixed(rng, 500)
    other = replace(other, condition=one.condition)
    both_hz = np.stack([one.rate_hz, other.rate_hz], axis=1)
    both = replace(one, readouts=Readouts(("a", "b"), ((1,), (2,))), readout_hz=both_hz)
    left = read(both)
    np.testing.assert_array_equal(left.rate_hz, one.rate_hz)
    assert left.readout_hz is not None
    for column, alone in zip(left.readout_hz.T, (one, other), strict=True):
        np.testing.assert_allclose(column, read(alone).rate_hz)

    is_burst = np.arange(500) % 25 == 0
    bursts = replace(one, is_burst=is_burst)
    far = replace(bursts, rate_hz=np.where(is_burst, 1e6, one.rate_hz))
    np.testing.assert_array_equal(read(bursts).rate_hz[~is_burst], read(far).rate_hz[~is_burst])


@pytest.mark.oracle
def test_which_predictions_use_it() -> None:
    rng = np.random.default_rng(5)
    responses = replace(mixed(rng, 1_000, np.sin(np.arange(1_000) / 60)), presentation=Presentation("mixed", 1))
    adaptive, fixed = (Calibration.of_series([responses], adaptive=each, kind="empirical") for each in (True, False))
    blocked = replace(responses, presentation=Presentation("blocked", 1))
    of_blocks = Calibration.of_series([blocked], kind="empirical")
    for found, wanted in ((adaptive, read(responses)), (fixed, responses), (of_blocks, responses)):
        for name in ("values_hz", "percentiles"):
            np.testing.assert_array_equal(getattr(found.simulator, name), getattr(fit_empirical(wanted), name))
        np.testing.assert_array_equal(np.concatenate(found.responses_hz), np.concatenate(fixed.responses_hz))
    # Thresholds stand between percentiles; other mappings may not, and read the recording as it is.
    linear = Calibration.of_series([responses], policy_of(0, [responses], mapping=Linear()), kind="empirical")
    np.testing.assert_array_equal(linear.simulator.percentiles, fixed.simulator.percentiles)


@pytest.mark.oracle
def test_what_policies_see_of_the_neurons_is_remembered_as_the_loop_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeCulture() as culture:
        recorded = extract_responses(culture.record(PROTOCOL, 0), burst_threshold=0.95)
    own_hz, other = np.sort(recorded.non_burst_rate_hz), Memory(0.15, 1.0, 0.8, 0.0)
    found = lambda ranked: MEMORY if np.array_equal(ranked.sorted_hz, own_hz) else other  # noqa: E731
    monkeypatch.setattr("animat.neurons.memory._find_memory", found)
    weights = tuple(np.zeros(size, np.float32) for size in ((6, 16), (16, 16), (16, 5)))
    seeing = policy_of(
        0, [recorded], Cartpole(), weights=weights, scales=np.ones(6, np.float32), neural_observation=True
    )
    blind, sees = (Calibration.of_series([recorded], policy, kind="memory") for policy in (None, seeing))
    # The policy's trace in the loop is computed with the memory of the recording, not of the reread responses.
    for each, wanted in ((blind, other), (sees, MEMORY)):
        assert isinstance(each.simulator, MemorySimulator)
        assert each.simulator.memory == pytest.approx(wanted)
        assert each.remembering.memory == pytest.approx(MEMORY)
