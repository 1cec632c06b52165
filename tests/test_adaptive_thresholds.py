"""Thresholds that adapt, against closed forms and a second computation from the log; and what they are good for."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import norm, percentileofscore

from animat.closed_loop.adaptive import LATEST, NEWEST, AdaptiveThresholds
from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.closed_loop.tick import Tick
from animat.coding.mapping import Thresholds
from animat.cultures.observed import Observed, Spikes
from animat.errors import InvalidArgument
from animat.neurons.history import Memory, Ranked
from animat.neurons.history_tracker import AdjustedRanks, HistoryState
from animat.neurons.memory import fit_memory
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
def adjusted(recorded: Responses) -> AdjustedRanks:
    return AdjustedRanks.of(recorded, fit_empirical(recorded))


Answered = tuple[int, float, float]
"""Condition, x in Hz, and how much of its rank its history explains."""


def thresholds_after(
    recorded_hz: list[np.ndarray],
    answered: list[Answered],
    *,
    among: np.ndarray | None = None,
    recorded_ranks: list[np.ndarray] | None = None,
) -> np.ndarray:
    """P0 to P100, computed again with SciPy's ranks, lists and NumPy's quantiles."""
    pooled, by = newest_after(recorded_hz, answered, among=among, recorded_ranks=recorded_ranks)
    return np.quantile(pooled, norm.cdf(norm.ppf(np.linspace(0, 1, 11)) + by)).astype(np.float32)


def newest_after(
    recorded_hz: list[np.ndarray],
    answered: list[Answered],
    *,
    among: np.ndarray | None = None,
    recorded_ranks: list[np.ndarray] | None = None,
) -> tuple[list[float], float]:
    """The newest responses, and how far the latest are above them on the normal scale."""
    everything = np.concatenate(recorded_hz) if among is None else among

    def ranks(values: list[float]) -> list[float]:
        return [float(percentileofscore(everything, x, kind="mean")) / 100 for x in values]

    part = min(1, NEWEST / max(map(len, recorded_hz)))
    pooled, above = list[float](), []
    for condition, own in enumerate(recorded_hz):
        kept = max(1, round(part * len(own)))
        new = [x for c, x, _ in answered if c == condition]
        new_ranks = [
            rank - explained
            for (c, _, explained), rank in zip(answered, ranks([x for _, x, _ in answered]), strict=True)
            if c == condition
        ]
        own_ranks = ranks(own.tolist()) if recorded_ranks is None else recorded_ranks[condition].ravel().tolist()
        latest = float(np.mean(own_ranks[-kept:]))
        for rank in new_ranks:
            latest = (1 - 1 / LATEST) * latest + rank / LATEST
        pooled += [*own.tolist(), *new][-kept:]
        above.append(latest - np.mean([*own_ranks, *new_ranks][-kept:]))
    # How many responses to others came since the last one to each; of one that was never answered all of them.
    given = [condition for condition, _, _ in answered]
    since = [given[::-1].index(c) if c in given else len(given) for c in range(len(recorded_hz))]
    weights = (1 - 1 / (LATEST * len(recorded_hz))) ** np.array(since)
    return pooled, float(np.sqrt(2) * norm.ppf(np.clip(0.5 + np.average(above, weights=weights), 0.01, 0.99)))


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_thresholds_follow_the_newest_of_each_condition_and_nothing_else(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    # Where a condition has more than a hundred, the newest count, of every condition the same part.
    sizes = data.draw(st.lists(st.integers(1, 6) | st.integers(98, 130), min_size=1, max_size=4))
    recorded_hz = [rng.gamma(5.0, 2.0, n).round(data.draw(st.integers(0, 2))) for n in sizes]
    responses = responses_of(np.repeat(np.arange(len(sizes)), sizes), np.concatenate(recorded_hz))
    thresholds = AdaptiveThresholds(AdjustedRanks.of(responses, fit_empirical(responses)))
    answered = list[Answered]()
    for condition in data.draw(st.lists(st.integers(0, len(sizes) - 1), max_size=30)):
        answered.append((condition, float(rng.gamma(5.0, 1.0)), 0.0))
        thresholds.add(condition, HistoryState(), np.array(answered[-1][1]))
    np.testing.assert_allclose(thresholds.percentiles(), thresholds_after(recorded_hz, answered), rtol=1e-5)


@pytest.mark.parametrize("by", [-0.4, *(pytest.param(by, marks=pytest.mark.oracle) for by in (-1.0, 0.0, 0.1, 1.0))])
def test_when_all_responses_rise_on_a_normal_scale_thresholds_rise_with_them(by: float) -> None:
    rng = np.random.default_rng(2)
    recorded = responses_of(np.tile([0, 1], 10_000), np.exp(rng.normal(size=20_000)))
    adjusted, found = AdjustedRanks.of(recorded, fit_empirical(recorded)), []
    for _ in range(300):
        some = rng.choice(10_000, 100, replace=False)
        newest = ([each[some] for each in values] for values in (adjusted.responses_hz, adjusted.ranks))
        responses_hz, ranks = map(tuple, newest)
        thresholds = AdaptiveThresholds(replace(adjusted, responses_hz=responses_hz, ranks=ranks))
        for turn, x in enumerate(np.exp(rng.normal(size=60) + by)):
            thresholds.add(turn % 2, HistoryState(), np.array(x))
        found.append(np.log(thresholds.percentiles()[5]))

    # Of each condition 70 are standard normal and 30 higher by `by`: of one of each P(x < y) = Phi(by / sqrt(2)).
    d = 0.7 * (norm.cdf(by / np.sqrt(2)) - 0.5)
    share = norm.cdf(np.sqrt(2) * norm.ppf(0.5 + d))
    p50 = brentq(lambda x: 0.7 * norm.cdf(x) + 0.3 * norm.cdf(x - by) - share, -5, 5)
    assert np.mean(found) == pytest.approx(p50, abs=0.07)
    # By the newest responses alone the median would be in the middle of the mixture, a third of the way.
    assert abs(by) < 0.2 or abs(p50) > 0.8 * abs(by)


def test_a_condition_that_is_no_longer_given_counts_less_and_less(adjusted: AdjustedRanks) -> None:
    thresholds, rng = AdaptiveThresholds(adjusted), np.random.default_rng(1)

    def share() -> float:
        return float(np.mean(adjusted.sorted_hz < thresholds.percentiles()[5]))

    for condition in (0, 1, 2):
        for _ in range(LATEST):
            thresholds.add(condition, HistoryState(), adjusted.sorted_hz[-5])
    assert share() > 0.6
    # Those of the other two are as ever.
    for _ in range(300):
        condition = int(rng.integers(3, 5))
        thresholds.add(condition, HistoryState(), rng.choice(adjusted.responses_hz[condition]))
    assert abs(share() - 0.5) < 0.15


def test_whatever_comes_thresholds_are_finite_and_in_order(adjusted: AdjustedRanks) -> None:
    # A history may explain more than the whole of a rank, so that a mean of what is left is beyond 0 and 1.
    for x, came in itertools.product((-1.0, 1e6), (HistoryState(), HistoryState(trace=-2.0), HistoryState(trace=2.0))):
        thresholds = AdaptiveThresholds(replace(adjusted, slopes=np.ones_like(adjusted.slopes)))
        for condition in [*range(5)] * 30:
            thresholds.add(condition, came, np.array(x))
            percentiles = thresholds.percentiles()
            assert np.all(np.isfinite(percentiles)) and np.all(np.diff(percentiles) >= 0)


def test_an_adjusted_rank_has_nothing_left_of_trace_and_load(recorded: Responses) -> None:
    # The normal equations: what least squares leave is orthogonal to all that was given.
    adjusted, ranked = AdjustedRanks.of(recorded, fit_memory(recorded, memory=MEMORY)), Ranked(recorded)
    history = np.stack([ranked.traces(MEMORY), ranked.loads(MEMORY.load_s).at], axis=1)
    assert np.all(adjusted.slopes != 0)
    for_history = np.zeros(2)
    for condition, (own_hz, ranks) in enumerate(zip(adjusted.responses_hz, adjusted.ranks, strict=True)):
        rows = ~recorded.is_burst & (recorded.condition == condition)
        np.testing.assert_array_equal(own_hz, recorded.rate_hz[rows])
        rank = np.array([percentileofscore(adjusted.sorted_hz, x, kind="mean") for x in own_hz]) / 100
        np.testing.assert_allclose(ranks, rank[:, None] - history[rows] @ adjusted.slopes)
        for_history += history[rows].T @ (ranks[:, 0] - ranks.mean())
    np.testing.assert_allclose(for_history, 0.0, atol=1e-6)


def test_without_memory_an_adjusted_rank_is_the_rank(adjusted: AdjustedRanks) -> None:
    np.testing.assert_array_equal(adjusted.slopes, 0.0)
    came = HistoryState(trace=0.9, load=2.0)
    assert adjusted.of_response(came, np.array(adjusted.sorted_hz[-1] + 1)) == pytest.approx(1.0)


def test_trial_by_trial_a_loop_finds_the_adjusted_ranks_of_the_recording(recorded: Responses) -> None:
    adjusted = AdjustedRanks.of(recorded, fit_memory(recorded, memory=MEMORY))
    presented, place = recorded.presentations
    assert presented.time_s is not None
    state, found, remembering = HistoryState(), [], adjusted.remembering
    for condition, x, is_burst, is_rested, at_s in zip(
        presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested, presented.time_s, strict=True
    ):
        came = remembering.when(state, at_s, is_rested=is_rested)
        found.append(adjusted.of_response(came, np.array(x)))
        state = remembering.after(came, condition, x, is_burst=is_burst)
    for condition, ranks in enumerate(adjusted.ranks):
        rows = ~recorded.is_burst & (recorded.condition == condition)
        np.testing.assert_allclose(ranks, np.array(found)[place][rows])


def test_two_readouts_adapt_each_by_its_own() -> None:
    rng = np.random.default_rng(3)
    recorded = responses_of(np.tile([0, 1], 200), rng.gamma(5.0, 2.0, 400))
    of_each = [recorded, replace(recorded, rate_hz=rng.gamma(3.0, 2.0, 400))]
    both_hz = np.stack([each.rate_hz for each in of_each], axis=1)
    both = replace(recorded, readouts=Readouts(("a", "b"), ((1,), (2,))), readout_hz=both_hz)
    together = AdaptiveThresholds(AdjustedRanks.of(both, fit_empirical(both)))
    alone = [AdaptiveThresholds(AdjustedRanks.of(each, fit_empirical(each))) for each in of_each]
    for condition, x in ((0, (3.0, 9.0)), (1, (12.0, 2.0)), (0, (1.0, 1.0))):
        together.add(condition, HistoryState(), np.array(x))
        for each, own in zip(alone, x, strict=True):
            each.add(condition, HistoryState(), np.array(own))
    assert together.percentiles().shape == (2, 11)
    np.testing.assert_array_equal(together.percentiles(), [each.percentiles() for each in alone])


def adapted(session: Session, recorded: Responses, adjusted: AdjustedRanks, counts: Any) -> None:
    """Every command and all that the log says of thresholds, computed again from the responses before it."""
    recorded_hz, m = [recorded.rates_of(condition) for condition in range(5)], adjusted.remembering.memory
    percentiles = percentiles_of(adjusted).astype(np.float32)
    answered, trace, load, before_s = list[Answered](), 0.0, 0.0, -np.inf
    for record in session.log:
        tick = session_tick(record.fields)
        if tick is None:
            continue
        if tick.command is not None:
            assert tick.command == float(Thresholds(9).command(np.float32(tick.rate_hz), percentiles))
        assert ("percentiles_hz" in record.fields) == (counts(tick) and not tick.is_burst)
        if not tick.patterns:
            continue
        first_s, last_s = tick.pulse_time_s[0], tick.read_after_s
        trace = 0.0 if first_s - before_s > 1.0 else trace
        load = load * np.exp((before_s - last_s) / m.load_s) if m.load_s else 0.0
        if "percentiles_hz" in record.fields:
            explained = float(np.array([trace, load]) @ adjusted.slopes[:, 0])
            answered.append((tick.delivered, tick.rate_hz, explained))
            percentiles = np.float32(record.fields["percentiles_hz"])
            again = thresholds_after(recorded_hz, answered, recorded_ranks=list(adjusted.ranks))
            np.testing.assert_allclose(percentiles, again, rtol=1e-5)
        rank = percentileofscore(adjusted.sorted_hz, tick.rate_hz, kind="mean") / 100
        more = (1 - m.decay) * (rank + m.weight * adjusted.remembering.mean_ranks[tick.delivered]) / (1 + m.weight)
        trace, load, before_s = (
            0.5 if tick.is_burst else m.decay * trace + more,
            load + adjusted.remembering.added,
            last_s,
        )
    assert len(answered) > 10


def session_tick(words: dict[str, Any]) -> Tick | None:
    return Tick.from_dict(words["tick"]) if words.get("tick") else None


def percentiles_of(adjusted: AdjustedRanks) -> np.ndarray:
    return np.percentile(adjusted.sorted_hz, range(0, 101, 10))


@pytest.mark.parametrize("memory", [None, MEMORY], ids=["nothing remembered", "memory"])
def test_in_a_session_thresholds_move_after_every_response_that_counts(
    memory: Memory | None, recorded: Responses, adjusted: AdjustedRanks, tmp_path: Path
) -> None:
    if memory is not None:
        adjusted = AdjustedRanks.of(recorded, fit_memory(recorded, memory=memory))
    # After a pause of more than a second nothing is left of the trace.
    loop = loop_of(percentiles=percentiles_of(adjusted), adaptive_from=adjusted, burst_threshold=0.95, pause_s=1.5)
    agents = [
        RANDOM,
        # What was delivered counts, not what was chosen.
        Agent("shuffled", "", OneCondition(4), "shuffled"),
        Agent("always", "", OneCondition(4), calibrates=False),
        Agent("no", "", OneCondition(4), "silent"),
    ]
    with FakeCulture() as culture:
        session = run_session(culture, loop, agents, tmp_path, episodes=4)
    adapted(session, recorded, adjusted, lambda tick: tick.agent in ("random", "shuffled"))
    assert_read_alike(tmp_path, loop)
    assert ("memory" in session.log.header["loop"]) and (session.log.header["loop"]["memory"]["load_s"] > 0) == (
        memory is not None
    )


def test_the_warm_up_and_the_settling_count(recorded: Responses, adjusted: AdjustedRanks, tmp_path: Path) -> None:
    loop = loop_of(
        percentiles=percentiles_of(adjusted), adaptive_from=adjusted, warm_up=3, settling=1, burst_threshold=0.95
    )
    # Neither a constant control nor what was drawn in place of a response counts, and the culture's own does.
    agents = [
        Agent("constant", "", OneCondition(0), calibrates=False),
        Agent("silent", "", AnyCondition(5), "silent", drawn_from=np.array([999.0])),
    ]
    with FakeCulture() as culture:
        session = run_session(culture, loop, agents, tmp_path, episodes=2)
    adapted(session, recorded, adjusted, lambda tick: tick.handled == "warm-up")


def test_what_thresholds_cannot_start_from_is_refused(recorded: Responses, adjusted: AdjustedRanks) -> None:
    for wrong, changed, message in (
        (adjusted, {"conditions": CONDITIONS[:4]}, "expected responses to each of 4 conditions, .* got \\[40, 37"),
        (
            replace(adjusted, ranks=(*adjusted.ranks[:4], adjusted.ranks[4][:0])),
            {},
            "each of 5 conditions, .* 0\\] in 1",
        ),
        (replace(adjusted, slopes=np.zeros((2, 2))), {}, r"the loop's number of readouts \(1\), got .* in 2"),
        (adjusted.responses_hz, {}, "adaptive_from: expected calibration.adjusted, got tuple"),
    ):
        with pytest.raises(InvalidArgument, match=message):
            loop_of(adaptive_from=wrong, **changed)
    other = AdjustedRanks.of(recorded, fit_memory(recorded, memory=MEMORY)).remembering
    with pytest.raises(InvalidArgument, match=r"remembering: expected adaptive_from\.remembering"):
        loop_of(adaptive_from=adjusted, remembering=other)


class Tiring(FakeCulture):
    """Its responses to all conditions fade: halved in ten minutes."""

    def _deliver(self, admitted: Any, duration_s: float) -> Observed:
        observed = super()._deliver(admitted, duration_s)
        kept = np.random.default_rng(self.deliveries).random(len(observed.spikes.time_s)) < 2 ** (-self.now_s / 600)
        return replace(observed, spikes=Spikes(observed.spikes.time_s[kept], observed.spikes.channel[kept]))


@pytest.mark.oracle
def test_half_of_the_responses_of_a_culture_that_tires_stay_above_the_median(tmp_path: Path) -> None:
    above: dict[str, float] = {}
    for how in ("fixed", "adaptive"):
        with Tiring() as culture:
            responses = extract_responses(culture.record(PROTOCOL), burst_threshold=0.95)
            adjusted = AdjustedRanks.of(responses, fit_empirical(responses))
            culture.rest(600.0)
            loop = loop_of(
                robot=Navigation(episode_limit=25),
                mapping=Thresholds(1),
                percentiles=percentiles_of(adjusted),
                adaptive_from=adjusted if how == "adaptive" else None,
                burst_threshold=0.95,
            )
            session = run_session(culture, loop, [RANDOM], tmp_path / how, episodes=16)
        # The last quarter of the session.
        above[how] = float(np.mean([tick.command == 1.0 for tick in list(session.ticks)[-100:]]))
    # Half of a binomial of 100: standard deviation 0.05. Ties at the median count as above it.
    assert above["fixed"] < 0.25
    assert 0.38 < above["adaptive"] < 0.72
