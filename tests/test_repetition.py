"""Whether responses depend on how often their condition has just been presented."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.neurons.history import Memory
from animat.neurons.history_tracker import AdjustedRanks
from animat.neurons.memory import fit_memory
from animat.responses.quality.history import repetition_findings, repetitions
from animat.responses.responses import Responses, Trials
from test_simulator import responses_of

CONDITIONS, N = 5, 1000


def mixed(seed: int, *, of_its_own: float = 0.0, of_the_last: float = 0.0, silences: float = 0.0) -> Responses:
    """Responses in random order, higher by so much after a trial of their own condition, and after a high response."""
    rng = np.random.default_rng(seed)
    condition, is_rested = rng.integers(0, CONDITIONS, N), rng.random(N) < silences
    rate_hz = rng.normal(20.0 + condition, 2.0)
    rate_hz[1:] += of_its_own * ((condition[1:] == condition[:-1]) & ~is_rested[1:])
    for before, now in pairwise(range(N)):
        rate_hz[now] += of_the_last * (rate_hz[before] - 22.0)
    time_s = np.cumsum(np.where(is_rested, 2.0, 0.1))
    presented = Trials(condition, rate_hz, np.zeros(N, bool), is_rested, time_s)
    shape = responses_of(*[np.zeros(1)] * CONDITIONS)
    columns = {"condition": condition, "rate_hz": rate_hz, "active_ratio": np.zeros(N), "is_burst": np.zeros(N, bool)}
    return replace(shape, **columns, time_s=time_s, presented=presented, place=np.arange(N))


@pytest.mark.oracle
@given(st.integers(0, 10_000))
def test_responses_after_their_own_condition_are_found_to_differ_only_where_they_do(seed: int) -> None:
    (found,) = repetition_findings(mixed(seed, of_its_own=3.0))
    assert (found.name, found.severity) == ("repetition", "warning")
    assert found.value is not None
    assert found.value > 0.15
    (less,) = repetition_findings(mixed(seed, of_its_own=-3.0))
    assert less.value is not None
    assert less.value < -0.15
    assert not list(repetition_findings(mixed(seed)))
    # Large responses follow large ones, whatever their conditions.
    assert not list(repetition_findings(mixed(seed, of_the_last=0.5)))


def test_conditions_in_blocks_and_single_trials_show_no_repetition() -> None:
    rng = np.random.default_rng(0)
    assert not list(repetition_findings(responses_of(*[rng.normal(mean, 1.0, 100) for mean in (20, 25, 30)])))
    assert not list(repetition_findings(responses_of(np.array([1.0]), np.array([2.0]))))


@given(st.integers(0, 10_000), st.floats(0.0, 0.5))
def test_repetitions_are_counted_as_by_hand(seed: int, silences: float) -> None:
    responses = mixed(seed, silences=silences)
    presented, _ = responses.presentations
    # Each silence begins another group.
    labels = zip(presented.condition.tolist(), np.cumsum(presented.is_rested).tolist(), strict=True)
    expected = [number for _, group in groupby(labels) for number, _ in enumerate(group)]
    np.testing.assert_array_equal(repetitions(responses), expected)
    rows = np.flatnonzero(np.random.default_rng(seed).random(N) < 0.5)
    np.testing.assert_array_equal(repetitions(responses.at_rows(rows)), np.array(expected)[rows])


@pytest.mark.parametrize(("of_the_last", "memory"), [(0.0, None), (0.5, None), (0.5, Memory(0.6, -0.85, 0.7))])
def test_adjusted_ranks_of_a_recording_and_of_the_same_responses_elsewhere_agree(
    of_the_last: float, memory: Memory | None
) -> None:
    responses = mixed(3, of_the_last=of_the_last, silences=0.05)
    adjusted = AdjustedRanks.of(responses, fit_memory(responses, memory=memory))
    ranks = adjusted.of_responses(responses)
    for condition, expected in enumerate(adjusted.ranks):
        np.testing.assert_allclose(ranks[responses.condition == condition], expected, atol=1e-6)
