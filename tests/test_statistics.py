"""Comparisons against scipy, the paper's table, plain counting and coverage on known distributions."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.errors import InvalidArgument
from animat.evaluation.statistics import compare, compare_episodes, holm, interquartile_mean, normalised_score, p_of_u

FINITE = st.floats(-1e3, 1e3, allow_nan=False)


@pytest.mark.parametrize(("u", "p"), [(0, 1.8267e-4), (2, 3.2984e-4), (14, 7.2846e-3)])
def test_the_papers_p_and_u_belong_together(u: int, p: float) -> None:
    """Its table prints 1.82e-4 or 1.83e-4, 3.30e-4 and 7.28e-3 for ten against ten policies."""
    assert p_of_u(u, 10, 10) == pytest.approx(p, rel=1e-4)
    # Two groups with this U: all of the first below the second, then `u` of its pairs turned, one a step up.
    first, second = np.arange(10.0), np.arange(10.0) + 100
    for i in range(u):
        first[9 - i // 10] = 100.5 + i % 10
    compared = compare(first, second)
    assert compared.u == u
    assert compared.p_normal == pytest.approx(p, rel=1e-4)


def test_complete_separation_of_ten_and_ten() -> None:
    compared = compare(np.arange(10), np.arange(10) + 100)
    assert (compared.u, compared.u_first) == (0, 0)
    assert compared.p_normal == pytest.approx(1.8267e-4, rel=1e-4)
    assert compared.p_exact == pytest.approx(2 / 184756)
    assert (compared.effect.value, compared.effect.high) == (1, 1)
    # With all pairs won, (1 - t)^2 = z^2 t (1 - t) (1 + 9 ((1 - t) / (2 - t) + t / (1 + t))) / 100 ends the interval.
    share = (1 + compared.effect.low) / 2
    k = 9 * ((1 - share) / (2 - share) + share / (1 + share))
    assert 1 - share == pytest.approx(1.959964**2 * share * (1 + k) / 100, abs=1e-5)
    assert 0.5 < compared.effect.low < 0.7
    turned = compare(np.arange(10) + 100, np.arange(10)).effect
    assert (turned.low, turned.value) == (-1, -1) and turned.high == pytest.approx(-compared.effect.low)
    assert not compared.ties
    json.dumps(asdict(compared))


@given(st.lists(FINITE, min_size=1, max_size=9), st.lists(FINITE, min_size=1, max_size=9))
@settings(max_examples=60, deadline=None)
def test_u_and_effect_are_counts_of_pairs(first: list[float], second: list[float]) -> None:
    compared = compare(first, second)
    larger = sum(a > b for a, b in itertools.product(first, second))
    equal = sum(a == b for a, b in itertools.product(first, second))
    pairs = len(first) * len(second)
    assert compared.u_first == larger + equal / 2
    assert compared.u == min(compared.u_first, pairs - compared.u_first)
    assert compared.effect.value == pytest.approx((pairs - equal - 2 * larger) / pairs)
    swapped = compare(second, first)
    assert swapped.u == compared.u
    assert swapped.p_normal == pytest.approx(compared.p_normal)
    assert swapped.effect.value == pytest.approx(-compared.effect.value)
    assert 0 <= compared.p_normal <= 1


def test_without_ties_p_is_that_of_u() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        a, b = rng.normal(size=8), rng.normal(0.5, size=11)
        compared = compare(a, b)
        assert compared.p_normal == pytest.approx(p_of_u(compared.u, 8, 11))
        assert compared.p_exact == pytest.approx(scipy.stats.mannwhitneyu(a, b, method="exact").pvalue)


def test_exact_p_with_ties_goes_through_all_ways() -> None:
    a, b = [1.0, 2.0, 2.0, 5.0], [2.0, 3.0, 5.0, 6.0, 7.0]
    pooled = np.array(a + b)

    def u_of(places: tuple[int, ...]) -> float:
        first = pooled[list(places)]
        second = np.delete(pooled, list(places))
        return float(np.sum(first[:, None] > second) + np.sum(first[:, None] == second) / 2)

    observed = abs(u_of((0, 1, 2, 3)) - 10)
    ways = [abs(u_of(places) - 10) >= observed for places in itertools.combinations(range(9), 4)]
    compared = compare(a, b)
    assert compared.ties
    assert compared.p_exact == pytest.approx(np.mean(ways))


@pytest.mark.parametrize("is_alone_first", [True, False])
def test_exact_p_of_one_sample_against_many_with_ties(is_alone_first: bool) -> None:
    """Each of the 2,002 samples is equally likely to be the one alone."""
    many = np.concatenate([[0.0], np.arange(1999) // 2 + 0.0, [1000.0]])
    pair = [1000.0], many
    compared = compare(*(pair if is_alone_first else pair[::-1]))
    ranks = scipy.stats.rankdata(np.append(many, 1000.0))
    far = np.abs(ranks - ranks.mean()) >= ranks[-1] - ranks.mean()
    assert compared.ties and compared.p_exact == pytest.approx(far.mean())


def test_groups_of_thousands_are_compared_by_the_normal_approximation() -> None:
    rng = np.random.default_rng(2)
    compared = compare(rng.integers(0, 50, 1000), rng.integers(5, 55, 1000))
    assert compared.ties and 0 < compared.p_exact == compared.p_normal < 1e-3


def test_p_is_never_0() -> None:
    assert 0 < compare_episodes(np.zeros((4, 400)), np.ones(400)).p < 1e-300


def test_equal_samples_show_no_difference() -> None:
    compared = compare([3.0] * 4, [3.0] * 5)
    assert (compared.p_normal, compared.p_exact, compared.effect.value) == (1.0, 1.0, 0.0)


def test_interquartile_mean_is_rliables() -> None:
    x = np.random.default_rng(2).normal(size=30)
    interval = interquartile_mean(x)
    assert interval.value == pytest.approx(scipy.stats.trim_mean(x, 0.25))
    assert interval.low < interval.value < interval.high
    assert interquartile_mean(range(12)).value == pytest.approx(5.5)
    alone = interquartile_mean([3.0])
    assert (alone.low, alone.value, alone.high) == (-np.inf, 3.0, np.inf)
    few = interquartile_mean([1.0, 4.0, 2.0])
    assert (few.low, few.high) == pytest.approx(scipy.stats.ttest_1samp([1.0, 4.0, 2.0], 0).confidence_interval(0.95))


@pytest.mark.parametrize("n", [4, 10, 40])
def test_intervals_cover_what_they_say(n: int) -> None:
    """95 % intervals of symmetric samples, whose interquartile mean is 0, for few samples too; tails light or heavy."""
    rng = np.random.default_rng(3)
    for draw in (rng.normal, lambda size: rng.standard_t(3, size=size)):
        intervals = [interquartile_mean(draw(size=n)) for _ in range(1000)]
        assert 0.92 <= np.mean([each.low <= 0 <= each.high for each in intervals]) <= 0.975


@pytest.mark.parametrize(
    ("n", "apart"),
    # By default the hardest.
    [
        pytest.param(n, apart, marks=() if (n, apart) == (10, 3.0) else pytest.mark.oracle)
        for n in (4, 10, 25)
        for apart in (0.0, 1.0, 2.0, 3.0)
    ],
)
def test_effect_intervals_cover_the_true_effect(n: int, apart: float) -> None:
    """Normal samples some standard deviations apart: P(second > first) = Phi(apart / sqrt 2), up to 0.98.

    Near complete separation the percentile bootstrap of ten and ten holds the true effect half of the time.
    """
    truth = 2 * scipy.stats.norm.cdf(apart / np.sqrt(2)) - 1
    rng = np.random.default_rng(4)
    held = []
    for _ in range(600):
        effect = compare(rng.normal(size=n), rng.normal(apart, size=n)).effect
        assert -1 <= effect.low < effect.high <= 1
        held.append(effect.low <= truth <= effect.high)
    assert 0.91 <= np.mean(held) <= 0.99


def test_holm_by_hand() -> None:
    """Of 0.01, 0.04, 0.03: 3 x 0.01, then 2 x 0.03, then no less than that."""
    assert holm({"a": 0.01, "b": 0.04, "c": 0.03}) == pytest.approx({"a": 0.03, "b": 0.06, "c": 0.06})
    assert holm({"a": 0.7, "b": 0.8}) == {"a": 1.0, "b": 1.0}
    assert holm({}) == {}


def test_holm_keeps_the_chance_of_any_false_finding() -> None:
    rng = np.random.default_rng(5)
    found = [min(holm({str(i): p for i, p in enumerate(rng.random(8))}).values()) < 0.05 for _ in range(4000)]
    assert np.mean(found) == pytest.approx(0.05, abs=0.012)


def test_normalised_score() -> None:
    assert normalised_score(-80, -80, 17) == 0
    assert normalised_score(17, -80, 17) == 1
    assert normalised_score(0, -50, 50) == 0.5
    with pytest.raises(InvalidArgument, match="optimum"):
        normalised_score(1.0, 2.0, 2.0)


def test_refusals_name_the_argument() -> None:
    with pytest.raises(InvalidArgument, match="first"):
        compare([], [1.0])
    with pytest.raises(InvalidArgument, match="second"):
        compare([1.0], [float("nan")])
    with pytest.raises(InvalidArgument, match=r"first: expected one number per sample, .* got shape \(1, 2\)"):
        compare([[1.0, 2.0]], [1.0])
    with pytest.raises(InvalidArgument, match="p:"):
        holm({"a": 1.5})
    with pytest.raises(InvalidArgument, match="u:"):
        p_of_u(101, 10, 10)
    assert p_of_u(100, 10, 10) == p_of_u(0, 10, 10)


def test_the_interval_ends_where_the_numbers_can_be_no_larger() -> None:
    free, bound = (interquartile_mean([100.0, 118.0, 119.0, 120.0], **on) for on in ({}, {"within": (-100.0, 120.0)}))
    assert free.high > 120 == bound.high
    assert (bound.low, bound.value) == (free.low, free.value)
    assert interquartile_mean([3.0], within=(0.0, 5.0)).low == 0.0
    assert interquartile_mean([3.0], within=(0.0, 5.0)).high == 5.0


@pytest.mark.parametrize("episodes", [3, 300])
def test_returns_that_are_no_numbers_are_not_compared(episodes: int) -> None:
    returns = np.arange(2.0 * episodes).reshape(2, -1)
    wrong = np.where(returns == 1, np.nan, returns)
    for ours, theirs, name in ((wrong, returns, "policies"), (returns, wrong, "control")):
        with pytest.raises(InvalidArgument, match=f"{name}: expected finite numbers, got NaN"):
            compare_episodes(ours, theirs)
