"""A recording as adaptive thresholds read it: what it takes away, what it leaves, and who predicts with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import spearmanr

from animat.neurons.adjusted_rank import AdjustedRanks
from animat.neurons.memory import fit_memory
from animat.neurons.simulator import fit_empirical
from animat.reality_gap import Calibration
from animat.reality_gap.as_read import as_read
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.stimulation.protocol import Presentation
from test_adaptive_thresholds import Answered, responses_of, thresholds_after


def mixed(rng: np.random.Generator, n: int, rises: np.ndarray | float = 0.0) -> Responses:
    """Five conditions in random order, log-normal about their means, all of which rise and fall together."""
    condition = rng.permutation(np.repeat(np.arange(5), n // 5))
    return responses_of(condition, np.exp(0.3 * condition + 0.5 * (rng.normal(size=n) + rises)))


def read(responses: Responses) -> Responses:
    return as_read(responses, AdjustedRanks.of(responses, fit_empirical(responses)))


def in_common(responses: Responses) -> float:
    """What ranks 10 to 80 trials apart have in common beside their condition: the root of the mean product."""
    rank = np.argsort(np.argsort(responses.rate_hz)) / len(responses)
    for condition in range(5):
        rank[responses.condition == condition] -= rank[responses.condition == condition].mean()
    product = float(np.mean([np.mean(rank[lag:] * rank[:-lag]) for lag in range(10, 80)]))
    return float(np.sqrt(max(product, 0.0)))


def test_what_rises_and_falls_over_minutes_is_taken_away() -> None:
    rng, n = np.random.default_rng(1), 5_000
    rising = mixed(rng, n, np.sin(2 * np.pi * np.arange(n) / 400))
    left = read(rising)
    assert in_common(rising) > 0.1
    assert in_common(left) < 0.05
    # Responses of a condition are less alike by that, and conditions differ as they did.
    for condition in range(5):
        was, now = (np.std(np.log(each.rates_of(condition))) for each in (rising, left))
        assert now < 0.92 * was
    shares = [[np.mean(each.rates_of(c) >= each.median_rate_hz) for c in range(5)] for each in (rising, left)]
    assert np.ptp(shares[1]) > np.ptp(shares[0])
    assert left.median_rate_hz == pytest.approx(rising.median_rate_hz, rel=0.02)


def test_independent_responses_stay_nearly_as_they_are() -> None:
    independent = mixed(np.random.default_rng(2), 5_000)
    left = read(independent)
    # Thresholds of so few of the latest responses err by chance: 1 / sqrt(45) of a standard deviation.
    assert spearmanr(independent.rate_hz, left.rate_hz).statistic > 0.975
    assert np.corrcoef(np.log(independent.rate_hz), np.log(left.rate_hz))[0, 1] > 0.97


def test_a_response_is_above_the_median_where_the_threshold_of_its_time_has_it() -> None:
    responses = mixed(np.random.default_rng(3), 600, 0.5)
    left = read(responses)
    recorded = [responses.rates_of(c) for c in range(5)]
    begun, answered, agree = [each[:100] for each in recorded], list[Answered](), 0
    above = left.rate_hz >= np.median(responses.rate_hz)
    for trial in range(150):
        # Ranks are those of the recording, also where thresholds begin with a part of it.
        p50_hz = thresholds_after(begun, answered, among=np.concatenate(recorded))[5]
        agree += bool((responses.rate_hz[trial] >= p50_hz) == above[trial])
        answered.append((int(responses.condition[trial]), float(responses.rate_hz[trial]), 0.0))
    assert agree >= 149


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


def test_who_predicts_with_it() -> None:
    rng = np.random.default_rng(5)
    responses = replace(mixed(rng, 1_000, np.sin(np.arange(1_000) / 60)), presentation=Presentation("mixed", 1))
    adaptive, fixed = (Calibration.of_series([responses], adaptive=each, kind="empirical") for each in (True, False))
    blocked = replace(responses, presentation=Presentation("blocked", 1))
    of_blocks = Calibration.of_series([blocked], kind="empirical")
    for found, wanted in ((adaptive, read(responses)), (fixed, responses), (of_blocks, responses)):
        for name in ("values_hz", "percentiles"):
            np.testing.assert_array_equal(getattr(found.simulator, name), getattr(fit_empirical(wanted), name))
        np.testing.assert_array_equal(np.concatenate(found.responses_hz), np.concatenate(fixed.responses_hz))
    # What neurons remember is looked for in what is read, too.
    remembers = Calibration.of_series([responses], kind="memory")
    np.testing.assert_array_equal(
        np.asarray(remembers.simulator.percentiles),
        np.asarray(fit_memory(as_read(responses, remembers.adjusted)).percentiles),
    )
