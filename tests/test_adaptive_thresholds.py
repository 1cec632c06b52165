"""Thresholds that adapt, against closed forms and a second computation from the log; and what they are good for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm, percentileofscore

from animat.closed_loop.adaptive import COUNTED, AdaptiveThresholds
from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.coding.mapping import Linear, Thresholds
from animat.cultures.observed import Observed, Spikes
from animat.errors import InvalidArgument
from animat.neurons.expected_rank import ExpectedRank
from animat.neurons.history import Memory, Ranked
from animat.neurons.memory import fit_memory
from animat.neurons.remembering import Remembered
from animat.neurons.simulator import fit_empirical
from animat.responses.extraction import extract_responses
from animat.responses.readouts import Readouts
from animat.responses.responses import Responses
from animat.robots import Navigation
from animat.stimulation.protocol import Protocol
from fake_culture import FakeCulture
from test_closed_loop import CONDITIONS, RANDOM, assert_read_alike, loop_of

PROTOCOL = Protocol(order="mixed", patterns=8, trials=40, setup_s=0.1)
MEMORY = Memory(0.3, 0.5, 0.7, 1.0)


def responses_of(condition: np.ndarray, rate_hz: np.ndarray) -> Responses:
    n, conditions = len(condition), CONDITIONS[: condition.max() + 1]
    return Responses(condition, rate_hz, np.full(n, 0.3), np.zeros(n, bool), conditions, (2.0, 10.0), 100, 1, 0.7)


@pytest.fixture(scope="module")
def recorded() -> Responses:
    with FakeCulture() as culture:
        return extract_responses(culture.record(PROTOCOL, 0), burst_threshold=0.95)


@pytest.fixture(scope="module")
def expected(recorded: Responses) -> ExpectedRank:
    return ExpectedRank.of(recorded, fit_empirical(recorded))


def moved(recorded_hz: list[np.ndarray], answered: list[tuple[int, float]]) -> np.ndarray:
    """P0 to P100, computed again with SciPy's ranks and NumPy's quantiles: of conditions that remember nothing."""
    pooled = np.concatenate(recorded_hz)
    d = []
    for condition, own in enumerate(recorded_hz):
        mean_rank = np.mean([percentileofscore(pooled, x, kind="mean") for x in own]) / 100
        above = 0.0
        for n, x in enumerate([x for c, x in answered if c == condition], 1):
            above += (percentileofscore(pooled, x, kind="mean") / 100 - mean_rank - above) / min(n, COUNTED)
        d.append(above)
    shares = norm.cdf(norm.ppf(np.linspace(0, 1, 11)) + np.sqrt(2) * norm.ppf(0.5 + np.mean(d)))
    return np.quantile(pooled, shares).astype(np.float32)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_thresholds_move_with_the_newest_of_each_condition_and_with_nothing_else(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    sizes = data.draw(st.lists(st.integers(2, 6) | st.integers(98, 130), min_size=1, max_size=4))
    recorded_hz = [rng.gamma(5.0, 2.0, n).round(data.draw(st.integers(0, 2))) for n in sizes]
    responses = responses_of(np.repeat(np.arange(len(sizes)), sizes), np.concatenate(recorded_hz))
    expected = ExpectedRank.of(responses, fit_empirical(responses))
    thresholds, answered = AdaptiveThresholds(expected), list[tuple[int, float]]()
    for condition in data.draw(st.lists(st.integers(0, len(sizes) - 1), max_size=4 * COUNTED)):
        answered.append((condition, float(rng.gamma(5.0, 1.0))))
        thresholds.add(condition, expected.beyond(Remembered(), condition, np.array(answered[-1][1])))
    assert thresholds.seen == len(answered)
    np.testing.assert_allclose(thresholds.percentiles(), moved(recorded_hz, answered), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("by", [-2.0, -0.4, 0.0, 0.1, 1.0])
def test_when_all_responses_move_on_a_normal_scale_thresholds_move_with_them(by: float) -> None:
    # Of x normal and y normal that is `by` larger on average, P(x < y) = Phi(by / sqrt(2)).
    sample = norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    responses = responses_of(np.tile([0, 1], 10_000), np.exp(sample))
    expected = ExpectedRank.of(responses, fit_empirical(responses))
    thresholds = AdaptiveThresholds(expected)
    for condition in (0, 1):
        thresholds.add(condition, np.array([norm.cdf(by / np.sqrt(2)) - 0.5]))
    tenths = np.linspace(0.1, 0.9, 9)
    np.testing.assert_allclose(np.log(thresholds.percentiles()[1:-1]), norm.ppf(tenths) + by, atol=0.01)


def test_a_culture_that_answers_nothing_any_more_leaves_thresholds_that_are_numbers(expected: ExpectedRank) -> None:
    for x in (-1.0, 1e6):
        thresholds = AdaptiveThresholds(expected)
        for condition in range(5):
            thresholds.add(condition, expected.beyond(Remembered(), condition, np.array(x)))
        percentiles = thresholds.percentiles()
        assert np.all(np.isfinite(percentiles)) and np.all(np.diff(percentiles) >= 0)


def test_what_is_expected_leaves_nothing_of_condition_trace_and_load(recorded: Responses) -> None:
    # The normal equations: what least squares leave is orthogonal to all that was given.
    expected = ExpectedRank.of(recorded, fit_memory(recorded, memory=MEMORY))
    (beyond,) = expected.along(recorded).T
    ranked, usable = Ranked(recorded), ~recorded.is_burst
    given = [*np.eye(5)[recorded.condition].T, ranked.traces(MEMORY), ranked.loads(MEMORY.load_s).at]
    assert np.all(expected.slopes != 0)
    np.testing.assert_allclose([np.sum((each * beyond)[usable]) for each in given], 0.0, atol=1e-9)
    rank = np.array([percentileofscore(expected.sorted_hz, x, kind="mean") for x in recorded.rate_hz]) / 100
    np.testing.assert_allclose(
        beyond, rank - expected.levels[recorded.condition, 0] - np.stack(given[5:], axis=1) @ expected.slopes[:, 0]
    )


def test_trial_by_trial_a_loop_finds_what_is_found_along_a_recording(recorded: Responses) -> None:
    expected = ExpectedRank.of(recorded, fit_memory(recorded, memory=MEMORY))
    presented, place = recorded.presentations
    assert presented.time_s is not None
    state, found, remembering = Remembered(), [], expected.remembering
    for condition, x, is_burst, is_rested, at_s in zip(
        presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested, presented.time_s, strict=True
    ):
        came = remembering.when(state, at_s, is_rested=is_rested)
        found.append(expected.beyond(came, condition, np.array(x)))
        state = remembering.after(came, condition, x, is_burst=is_burst)
    np.testing.assert_allclose(expected.along(recorded), np.array(found)[place])


def test_two_readouts_move_each_by_its_own() -> None:
    rng = np.random.default_rng(3)
    recorded = responses_of(np.tile([0, 1], 200), rng.gamma(5.0, 2.0, 400))
    of_each = [recorded, replace(recorded, rate_hz=rng.gamma(3.0, 2.0, 400))]
    both_hz = np.stack([each.rate_hz for each in of_each], axis=1)
    both = replace(recorded, readouts=Readouts(("a", "b"), ((1,), (2,))), readout_hz=both_hz)
    together = AdaptiveThresholds(ExpectedRank.of(both, fit_empirical(both)))
    alone = [AdaptiveThresholds(ExpectedRank.of(each, fit_empirical(each))) for each in of_each]
    for condition, x in ((0, (3.0, 9.0)), (1, (12.0, 2.0)), (0, (1.0, 1.0))):
        together.add(condition, together.expected.beyond(Remembered(), condition, np.array(x)))
        for each, own in zip(alone, x, strict=True):
            each.add(condition, each.expected.beyond(Remembered(), condition, np.array(own)))
    assert together.percentiles().shape == (2, 11)
    np.testing.assert_allclose(together.percentiles(), [each.percentiles() for each in alone])


def adapted(session: Session, recorded: Responses, counts: Any) -> None:
    """Every command and all that the log says of thresholds, computed again from the responses before it."""
    recorded_hz = [recorded.rates_of(condition) for condition in range(5)]
    answered, told = (
        list[tuple[int, float]](),
        iter([r.words["percentiles_hz"] for r in session.log.records if r.words["kind"] == "percentiles"]),
    )
    percentiles = np.percentile(np.concatenate(recorded_hz), range(0, 101, 10)).astype(np.float32)
    for tick in session.ticks:
        if tick.command is not None:
            assert tick.command == float(Linear().command(np.float32(tick.rate_hz), percentiles))
        if counts(tick) and not tick.is_burst:
            answered.append((tick.delivered, tick.rate_hz))
            percentiles = np.float32(next(told))
            np.testing.assert_allclose(percentiles, moved(recorded_hz, answered), rtol=1e-5, atol=1e-6)
    assert next(told, None) is None and len(answered) > 10


def test_in_a_session_thresholds_move_after_every_response_that_counts(
    recorded: Responses, expected: ExpectedRank, tmp_path: Path
) -> None:
    loop = loop_of(
        mapping=Linear(), percentiles=expected_percentiles(expected), adaptive_from=expected, burst_threshold=0.95
    )
    agents = [
        RANDOM,
        Agent("always", "", OneCondition(4), calibrates=False),
        Agent("no", "", OneCondition(4), "silent"),
    ]
    with FakeCulture() as culture:
        session = run_session(culture, loop, agents, tmp_path, episodes=6)
    adapted(session, recorded, lambda tick: tick.agent == "random")
    assert_read_alike(tmp_path, loop)
    with pytest.raises(InvalidArgument, match="adaptive_from: expected 4 conditions and 1 readouts, got 5 and 1"):
        loop_of(adaptive_from=expected, conditions=CONDITIONS[:4])


def test_the_warm_up_and_the_settling_count(recorded: Responses, expected: ExpectedRank, tmp_path: Path) -> None:
    loop = loop_of(
        mapping=Linear(),
        percentiles=expected_percentiles(expected),
        adaptive_from=expected,
        warm_up=3,
        settling=1,
        burst_threshold=0.95,
    )
    # Neither a constant control nor what was drawn in place of a response counts, and the culture's own does.
    agents = [
        Agent("constant", "", OneCondition(0), calibrates=False),
        Agent("silent", "", AnyCondition(5), "silent", drawn_from=np.array([999.0])),
    ]
    with FakeCulture() as culture:
        session = run_session(culture, loop, agents, tmp_path, episodes=2)
    adapted(session, recorded, lambda tick: tick.handled == "warm-up")


def expected_percentiles(expected: ExpectedRank) -> np.ndarray:
    return np.percentile(expected.sorted_hz, range(0, 101, 10))


class Tiring(FakeCulture):
    """Its responses to all conditions fade: halved in ten minutes."""

    def _deliver(self, admitted: Any, duration_s: float) -> Observed:
        observed = super()._deliver(admitted, duration_s)
        kept = np.random.default_rng(self.deliveries).random(len(observed.spikes.time_s)) < 2 ** (-self.now_s / 600)
        return replace(observed, spikes=Spikes(observed.spikes.time_s[kept], observed.spikes.channel[kept]))


def test_half_of_the_responses_of_a_culture_that_tires_stay_above_the_median(tmp_path: Path) -> None:
    above: dict[str, float] = {}
    for how in ("fixed", "adaptive"):
        with Tiring() as culture:
            responses = extract_responses(culture.record(PROTOCOL), burst_threshold=0.95)
            expected = ExpectedRank.of(responses, fit_empirical(responses))
            culture.rest(600.0)
            loop = loop_of(
                robot=Navigation(episode_limit=25),
                mapping=Thresholds(1),
                percentiles=expected_percentiles(expected),
                adaptive_from=expected if how == "adaptive" else None,
                burst_threshold=0.95,
            )
            session = run_session(culture, loop, [RANDOM], tmp_path / how, episodes=16)
        # The last quarter of the session.
        above[how] = float(np.mean([tick.command == 1.0 for tick in list(session.ticks)[-100:]]))
    # Half of a binomial of 100: standard deviation 0.05. Ties at the median count as above it.
    assert above["fixed"] < 0.25
    assert 0.38 < above["adaptive"] < 0.72
