"""Whether policies outperform controls: the rank test counted by hand, and its message."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from animat.evaluation.statistics import EpisodeComparison, Verdict, compare, compare_episodes

returns = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=12)


@given(ours=returns, theirs=returns)
def test_pairs_and_p_are_as_counted_by_hand(ours: list[float], theirs: list[float]) -> None:
    found = compare_episodes(ours, theirs)
    pairs = [(a > b) + (a == b) / 2 for a in ours for b in theirs]
    assert found.wins == pytest.approx(np.mean(pairs))
    # The normal approximation with continuity correction and tied ranks, from its textbook formula.
    n, m, every = len(ours), len(theirs), ours + theirs
    ties = sum(t**3 - t for t in (every.count(x) for x in set(every)))
    total = n + m
    variance = n * m / 12 * ((total + 1) - ties / (total * (total - 1))) if total > 1 else 0.0
    z = (abs(sum(pairs) - n * m / 2) - 0.5) / np.sqrt(variance) if variance > 0 else 0.0
    assert found.p == pytest.approx(min(1.0, 2 * norm.sf(z)), abs=1e-12)


def test_it_says_which_controls_are_not_outperformed() -> None:
    rng = np.random.default_rng(0)
    policies = rng.normal(0, 1, (4, 25))
    verdict = Verdict.of(policies, {"worse": policies - 9, "like": policies - 0.05, "better": policies + 9})
    assert verdict.not_outperformed == ("like", "better")
    said = str(verdict)
    assert said.startswith("these policies do not outperform like (p = ")
    # Significantly worse than a control is not better than it.
    assert "better (p = " in said and "they are worse: their return is larger in 0 % of the pairs" in said
    assert said.count("worse") == 1
    # Where every episode reaches the limit no return is larger.
    equal = str(Verdict.of(np.full(20, 120.0), {"equal": np.full(20, 120.0)}))
    assert "their return is larger in 50 % of the pairs of episodes, ties counting half)" in equal
    ruled = np.arange(100.0)
    every = str(Verdict.of(ruled, {"worse": ruled - 100, "near": ruled - 60}))
    assert every.startswith("these policies outperform every control (p < 0.01; ")
    # Of 10,000 pairs 780 are lost to the nearer one, and 40 are tied.
    assert every.endswith("larger in at least 92 % of the pairs of episodes, ties counting half)")
    # All but 3 of 10,000 are not "at least 100 %".
    assert "at least 99 % of the pairs" in str(Verdict.of(ruled, {"nearly all": ruled - 97}))


def test_too_few_episodes_are_not_taken_for_no_difference() -> None:
    # With four and four even the clearest difference has p = 0.03; with six and six it has 0.005.
    four, six = Verdict.of([9.0] * 4, {"a": [0.0] * 4}), Verdict.of(np.arange(6) + 9.0, {"a": np.arange(6.0)})
    assert "4 episodes of the policies and 4 of a control are too few to show" in str(four)
    # With equal returns the approximation gives p = 0.002, but one of 66 ways to choose two of twelve is as clear.
    two = Verdict.of([9.0] * 10, {"a": [0.0] * 2})
    assert two.controls["a"].p < 0.01 and two.not_outperformed == ("a",)
    assert "10 episodes of the policies and 2 of a control are too few to show" in str(two)
    assert str(six).startswith("these policies outperform every control (p < 0.01; ")
    # The result for one control is reported even if another was broken off.
    both = Verdict.of(np.arange(20.0), {"broken off": [0.0], "better": np.arange(20) + 90.0})
    assert str(both).startswith("these policies do not outperform better (p = ")
    assert str(both).endswith("too few to show (p < 0.01) whether these policies outperform broken off")
    assert not EpisodeComparison(0.03, 1.0, 4, 4).has_enough_episodes


@given(ours=returns, theirs=returns)
def test_controls_are_outperformed_only_if_the_exact_p_is_small_too(ours: list[float], theirs: list[float]) -> None:
    found = compare_episodes(ours, theirs)
    assert found.p_exact == pytest.approx(compare(ours, theirs).p_exact)
    # Of all ways to divide them, two are as far apart as can be.
    assert found.has_enough_episodes == (2 / math.comb(len(ours) + len(theirs), len(ours)) < 0.01)
    assert not found.is_outperformed or (found.p_exact < 0.01 and found.has_enough_episodes and found.wins > 0.5)


@pytest.mark.parametrize(("ours", "theirs"), [(12, 3), (5, 5)])
def test_enough_episodes_that_are_all_larger_outperform_a_control(ours: int, theirs: int) -> None:
    """Also without ties, where the approximation has p = 0.011 and 0.012."""
    for spread in (0.0, 1.0):
        verdict = Verdict.of(100 + spread * np.arange(ours), {"a": spread * np.arange(theirs)})
        assert str(verdict).startswith("these policies outperform every control (p < 0.01; ")
