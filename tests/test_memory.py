"""The simulator that remembers, against nearest neighbours found by hand, Markov chains, and games solved exactly."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, get_args

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save
from scipy.stats import rankdata

import animat.gym  # noqa: F401
from animat.cli.train import _controllability, _memories
from animat.coding.mapping import Linear, Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument, InvalidFile, Mismatch, UnusableData
from animat.evaluation.commands import CLASSES, commands_after
from animat.evaluation.optimum import best_return, best_returns
from animat.evaluation.rollouts import Constant, Uniform, heuristic_policy, networks_of, roll_out
from animat.execution.training import train
from animat.neurons.fidelity import fidelity
from animat.neurons.history import Ranked
from animat.neurons.history_tracker import HistoryState, HistoryTracker
from animat.neurons.memory import NO_MEMORY, Memory, MemorySimulator, _slopes, fit_memory
from animat.neurons.simulator import EmpiricalSimulator, fit_empirical
from animat.neurons.timeline import SimulatorKind, fit_timeline, load_timeline, save_timeline
from animat.reality_gap import Calibration
from animat.recordings.findings import Finding
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recorded_culture import RecordedCulture
from animat.responses.condition import Condition
from animat.responses.conditions import conditions_named
from animat.responses.extraction import extract_responses
from animat.responses.quality.history import compare_passing, memory_findings
from animat.responses.responses import Responses, Trials
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation
from animat.stimulation.protocol import Presentation, Protocol
from animat.studies.differences import decisions
from animat.studies.paper import paper_study
from animat.studies.specification import Simulators
from animat.training.specification import Training
from animat.wrappers import ShuffledDelivery
from synthetic_recordings import SyntheticCulture, synthetic_recording
from test_optimum import STEPS, Stairs, coins
from test_responses import recording
from test_simulator import responses_of


def after(trace: Any, load: float = 0.5) -> jnp.ndarray:
    """A history state, as `Answer` has it."""
    trace = jnp.asarray(trace, jnp.float32)
    return jnp.stack([trace, jnp.full_like(trace, load)], axis=-1)


def chain(
    n: int, *, after_low: tuple[float, ...], after_high: tuple[float, ...], seed: int = 1, **changes: Any
) -> Responses:
    """Responses of a culture that remembers whether its last response was high: each is high with these chances."""
    rng = np.random.default_rng(seed)
    condition = rng.integers(0, len(after_low), n)
    x = np.zeros(n)
    last = 0.0
    for i, c in enumerate(condition):
        high = rng.random() < (after_high if last >= 50 else after_low)[c]
        last = x[i] = rng.uniform(50, 100) if high else rng.uniform(0, 50)
    columns = {"condition": condition, "rate_hz": x, "active_ratio": np.full(n, 0.1), "is_burst": np.zeros(n, bool)}
    return replace(responses_of(*[[1.0]] * len(after_low)), presented=None, place=None, **columns, **changes)


def histories_by_hand(responses: Responses, memory: Memory) -> list[Fraction]:
    """The history of each response as `Memory` says, in fractions."""
    decay, weight = Fraction(memory.decay), Fraction(memory.weight)
    x, burst, condition = (getattr(responses, name).tolist() for name in ("rate_hz", "is_burst", "condition"))
    kept = [(v, c) for v, is_burst, c in zip(x, burst, condition, strict=True) if not is_burst]

    def rank(value: float) -> Fraction:
        return Fraction(sum(k < value for k, _ in kept) + sum(k <= value for k, _ in kept), 2 * len(kept))

    def mean(c: int) -> Fraction:
        alike = [rank(k) for k, of in kept if of == c]
        return sum(alike, Fraction(0)) / len(alike) if c >= 0 else Fraction(1, 2)

    presented, place = responses.presentations
    # Silence is a response of 0 to a stimulus of 0.
    silence = max(Fraction(0), -weight) / (1 + abs(weight))
    history, histories = silence, []
    columns = (presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested)
    for c, value, is_burst, is_rested in zip(*(column.tolist() for column in columns), strict=True):
        history = silence if is_rested else history
        histories.append(history)
        left = (1 - decay) * ((rank(value) + weight * mean(c)) / (1 + abs(weight)) + silence)
        history = Fraction(1, 2) if is_burst else decay * history + left
    return [histories[row] for row in place]


MEMORIES = st.builds(
    Memory,
    st.sampled_from([0.0, 0.25, 0.5]),
    st.sampled_from([-1.0, -0.25, 0.0, 0.5, 1.0]),
    st.sampled_from([0.5, 0.8, 1.0]),
    st.just(0.0),
)


@pytest.mark.oracle
@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 0, 1, -1]), st.integers(0, 6), st.booleans(), st.integers(0, 5)),
        min_size=3,
        max_size=40,
    ),
    st.none() | MEMORIES,
    st.integers(0, 16),
)
def test_it_draws_among_the_nearest(rows: list[tuple[int, int, bool, int]], memory: Memory | None, at: int) -> None:
    """All that had the very same history can be drawn, and nothing beyond the k nearest in rank; also where
    presentations have no condition, or come after a rest."""
    every, every_x, bursts, sixth = (np.array(column) for column in zip(*rows, strict=True))
    place = np.flatnonzero(every >= 0)
    condition, x, burst = every[place], every_x[place], bursts[place]
    responses = replace(
        responses_of([1.0], [1.0]),
        condition=condition,
        rate_hz=x.astype(float),
        active_ratio=np.full(len(x), 0.1),
        is_burst=burst,
        presented=Trials(every, every_x.astype(float), bursts, sixth == 0),
        place=place,
    )
    if any(not np.any((condition == c) & ~burst) for c in (0, 1)):
        words = r"responses to fit, got none, which --allow cannot change: .*\(--conditions\)"
        with pytest.raises(UnusableData, match=words):
            fit_memory(responses)
        return
    simulator = fit_memory(responses, memory=memory)
    memory = simulator.memory
    histories = [np.float32(float(history)) for history in histories_by_hand(responses, memory)]
    # Also exactly where a recorded one is.
    last = np.float32(at / 16) if at % 2 else histories[at % len(histories)]
    uniforms = jnp.linspace(0, 1, 400, endpoint=False)
    for c in (0, 1):
        mine = [i for i in range(len(x)) if condition[i] == c and not burst[i]]
        mine = [i for i in mine if sixth[place[i]] == 0 or place[i] == 0 or not bursts[place[i] - 1]] or mine
        k = int(simulator.nearest[c])
        assert k == round(len(mine) ** memory.neighbour_exponent)
        assert 1 <= k <= len(mine) == simulator.followers[c]
        np.testing.assert_allclose(simulator.before[c][: len(mine)], sorted(histories[i] for i in mine), atol=1e-6)
        answers = jax.vmap(simulator.answer, (None, 0, None))(jnp.int32(c), uniforms, after(last))
        drawn = set(np.asarray(answers.rate_hz).tolist())
        same = [i for i in mine if abs(histories[i] - last) < 1e-6]
        # Between this history and that of one that is drawn lie fewer than k others.
        near = [
            i
            for i in mine
            if sum(min(last, histories[i]) + 1e-6 < histories[j] < max(last, histories[i]) - 1e-6 for j in mine) < k
        ]
        assert drawn <= {x[i] for i in near}
        if memory.decay == memory.weight == 0:
            # Histories are ranks then, the same to the last bit wherever the responses before are.
            assert drawn >= {x[i] for i in same}
            if len(same) >= k:
                assert drawn == {x[i] for i in same}


PERIODS_S = np.array([0.2, 0.05, 0.0125])


def loads_by_hand(condition: np.ndarray, load_s: float) -> np.ndarray:
    """The load at each of some trials, their mean 0.5: one term for every trial before."""
    time_s = np.cumsum(PERIODS_S[condition])
    apart_s = time_s[:, None] - time_s[None, :]
    terms = np.where(np.tri(len(time_s), k=-1, dtype=bool), np.exp(-np.maximum(apart_s, 0) / load_s), 0.0)
    return terms.sum(axis=1) / (2 * terms.sum(axis=1).mean())


def loaded(n: int, seed: int, *, slope: float) -> Responses:
    """Responses of a culture to three frequencies in random order, which fall or rise with the load of two seconds."""
    rng = np.random.default_rng(seed)
    condition = rng.integers(0, 3, n)
    x = 50.0 + 5.0 * condition + slope * (loads_by_hand(condition, 2.0) - 0.5) + rng.normal(0, 5, n)
    columns = {"condition": condition, "rate_hz": x, "active_ratio": np.full(n, 0.1), "is_burst": np.zeros(n, bool)}
    every = Trials(condition, x, columns["is_burst"], np.arange(n) == 0, np.cumsum(PERIODS_S[condition]))
    return replace(responses_of(*[[1.0]] * 3), presented=every, place=np.arange(n), **columns)


@pytest.mark.oracle
def test_the_load_is_what_was_presented_in_the_seconds_before() -> None:
    responses = loaded(300, 1, slope=-60.0)
    simulator = fit_memory(responses, memory=Memory(0.0, 0.0, 0.5, 2.0))
    by_hand = loads_by_hand(responses.condition, 2.0)
    kept = np.exp(-PERIODS_S / 2.0)
    for c in range(3):
        load = np.asarray(simulator.histories)[c, : simulator.followers[c], 1] * kept[c]
        np.testing.assert_allclose(np.sort(load), np.sort(by_hand[responses.condition == c]), rtol=1e-5)
    # Answered as it was recorded, a simulator comes through the loads that the recording came through.
    history = after(0.0, 0.0)
    for c, load in zip(responses.condition.tolist(), by_hand.tolist(), strict=True):
        assert float(history[1]) * kept[c] == pytest.approx(load, abs=1e-5)
        history = simulator.answer(jnp.int32(c), jnp.float32(0.5), history).history


@pytest.mark.oracle
def test_a_load_is_found_where_there_is_one_and_not_where_there_is_none() -> None:
    times_known = [loaded(600, seed, slope=-60.0) for seed in range(10)]
    assert all(fit_memory(each).memory.load_s == 1.0 for each in times_known)
    assert not any(
        fit_memory(replace(each, presented=replace(each.presentations[0], time_s=None))).memory.load_s
        for each in times_known
    )
    none = 0
    for seed in range(40):
        responses = chain(600, after_low=(0.1, 0.3, 0.2), after_high=(0.7, 0.9, 0.8), seed=seed)
        condition = responses.condition
        every = Trials(
            condition, responses.rate_hz, responses.is_burst, np.arange(600) == 0, np.cumsum(PERIODS_S[condition])
        )
        memory = fit_memory(replace(responses, presented=every, place=np.arange(600))).memory
        assert memory != NO_MEMORY
        none += not memory.load_s
    # One in a hundred by chance, and a few more, as the trace does not contain everything about a step.
    assert none >= 36


def test_trials_further_apart_than_a_silence_have_a_load() -> None:
    """At 0.5 Hz a trial comes after a silence each time, and a seventh of the load of one second is left."""
    rng = np.random.default_rng(1)
    condition = rng.integers(0, 2, 400)
    since_s = np.array([2.0, 0.05])[condition]
    x = 50.0 + 5.0 * condition + rng.normal(0, 5, 400)
    every = Trials(condition, x, np.zeros(400, bool), since_s > 1.0, np.cumsum(since_s))
    columns = {"condition": condition, "rate_hz": x, "active_ratio": np.full(400, 0.1), "is_burst": every.is_burst}
    responses = replace(responses_of([1.0], [1.0]), presented=every, place=np.arange(400), **columns)
    simulator = fit_memory(responses, memory=Memory(0.0, 0.0, 0.5, 1.0))
    np.testing.assert_allclose(simulator.kept, np.exp([-2.0, -0.05]), rtol=1e-6)
    # After a trial there is at least what it added, and at most what trials at 20 Hz add up to.
    states = np.concatenate([np.asarray(simulator.histories)[c, : simulator.followers[c], 1] for c in (0, 1)])
    added = float(simulator.added)
    assert states.min() == 0.0 and np.sort(states)[1] >= 0.999 * added
    assert states.max() <= 1.001 * added / (1 - np.exp(-0.05))


def test_a_condition_of_few_responses_takes_nothing_from_the_others() -> None:
    responses = loaded(900, 3, slope=-60.0)
    rare = np.flatnonzero(responses.condition == 2)[4:]
    kept = np.setdiff1d(np.arange(900), rare)
    few = replace(
        responses,
        **{name: getattr(responses, name)[kept] for name in ("condition", "rate_hz", "active_ratio", "is_burst")},
        place=kept,
    )
    simulator = fit_memory(few, memory=Memory(0.0, 0.0, 0.7, 2.0))
    whole = fit_memory(responses, memory=Memory(0.0, 0.0, 0.7, 2.0))
    # Of loads' units and ranks, which 300 responses less change a little.
    slopes, expected = (np.asarray(each.toward)[:2, 1] for each in (simulator, whole))
    np.testing.assert_allclose(slopes, expected, rtol=0.35)
    assert np.all(np.isfinite(simulator.toward))


@pytest.mark.parametrize("spread", [0.004, 0.06])
def test_slopes_are_shrunk_as_far_as_conditions_are_alike(spread: float) -> None:
    """Of 200 conditions, whose slopes are known; each slope alone has an error of about 0.02."""
    rng = np.random.default_rng(1)
    true = 0.06 + spread * rng.normal(size=(200, 2))
    histories = rng.normal(size=(200, 100, 2))
    ranks = np.einsum("crh,ch->cr", histories, true) + 0.2 * rng.normal(size=(200, 100))
    designs = np.concatenate([histories, np.ones((200, 100, 1))], axis=2)
    alone = np.array([np.linalg.lstsq(designs[c], ranks[c], rcond=None)[0][:2] for c in range(200)])
    together = np.broadcast_to(alone.mean(axis=0), (200, 2))
    of_shrunk, of_alone, of_together = (
        np.mean((each - true) ** 2) for each in (_slopes(list(ranks), list(histories)), alone, together)
    )
    assert of_shrunk < 1.5 * of_together < 0.2 * of_alone if spread < 0.02 else of_shrunk < of_alone < 0.2 * of_together


def test_of_exponents_as_good_as_the_best_the_largest_is_taken() -> None:
    """Each response is left out in turn, and its rank predicted by the mean of its neighbours'."""
    n = 600
    responses = chain(n, after_low=(0.1, 0.2), after_high=(0.8, 0.9))
    found, condition = fit_memory(responses).memory, responses.condition
    rank = (rankdata(responses.rate_hz) - 0.5) / n
    traces, means = [0.0], [rank[condition == c].mean() for c in (0, 1)]
    for r, c in zip(rank, condition.tolist(), strict=True):
        more = (1 - found.decay) * (r + found.weight * means[c]) / (1 + found.weight)
        traces.append(found.decay * traces[-1] + more)
    errors: dict[float, list[float]] = {exponent: [] for exponent in (0.5, 0.6, 0.7, 0.8, 0.9)}
    for exponent, squares in errors.items():
        for rows in (np.flatnonzero(condition == c) for c in (0, 1)):
            in_order = rows[np.argsort(np.array(traces)[rows], kind="stable")]
            k = round(len(rows) ** exponent)
            for i, row in enumerate(in_order):
                first = min(max(i - k // 2, 0), len(rows) - k - 1)
                others = in_order[first : first + k + 1]
                squares.append((rank[row] - (rank[others].sum() - rank[row]) / k) ** 2)
    best = np.array(min(errors.values(), key=np.mean))
    worse = {exponent: np.array(squares) - best for exponent, squares in errors.items()}
    as_good = [exponent for exponent, by in worse.items() if by.mean() <= by.std() / np.sqrt(n)]
    assert as_good == [0.5, 0.6] and found.neighbour_exponent == pytest.approx(0.6)


def network_of_its_own(n: int, seed: int) -> Responses:
    """Responses of stimuli of three strengths, plus a noise that lasts, whatever the stimuli are."""
    rng = np.random.default_rng(seed)
    condition, lasting, x = rng.integers(0, 3, n), 0.0, np.zeros(n)
    for i, noise in enumerate(rng.normal(0, 10, n)):
        apart = 0.7 * lasting + noise
        x[i] = 100 + 12 * condition[i] + apart
        lasting = 0.6 * lasting + 0.4 * apart
    columns = {"condition": condition, "rate_hz": x, "active_ratio": np.full(n, 0.1), "is_burst": np.zeros(n, bool)}
    conditions = tuple(Condition(f"electrode {c}", float(c), frequencies_hz=(20.0,)) for c in range(3))
    return replace(responses_of(*[[1.0]] * 3), presented=None, place=None, conditions=conditions, **columns)


@pytest.mark.oracle
def test_where_stimuli_leave_no_trace_a_response_counts_by_its_difference_from_the_mean() -> None:
    """The same stimulus again and again is then answered as among others: on average the noise is 0."""
    for seed in (1, 2):
        responses = network_of_its_own(3000, seed)
        simulator = fit_memory(responses)
        assert simulator.memory.weight <= -0.85 and simulator.memory.decay == pytest.approx(0.6)

        def trial(history: Any, uniform: Any, simulator: MemorySimulator = simulator) -> Any:
            answer = jax.vmap(simulator.answer, (None, 0, 0))(jnp.int32(2), uniform, history)
            return answer.history, answer.rate_hz

        first, uniforms = after(np.full(400, 0.5)), jax.random.uniform(jax.random.key(1), (60, 400))
        rate_hz = np.asarray(jax.lax.scan(trial, first, uniforms)[1])
        usual_hz = responses.rate_hz[responses.condition == 2].mean()
        ranks_alone = fit_memory(responses, memory=Memory(0.45, 0.0, 0.7))
        others_hz = np.asarray(jax.lax.scan(partial(trial, simulator=ranks_alone), first, uniforms)[1])
        # The standard deviation of a response is 12.
        assert abs(rate_hz[20:].mean() - usual_hz) < 2.5 and others_hz[20:].mean() > usual_hz + 6


def test_after_silence_the_trace_is_that_of_no_stimulus_and_no_response() -> None:
    responses = network_of_its_own(300, 1)
    rests = np.arange(300) % 2 == 0
    rested = replace(responses, presented=replace(responses.presentations[0], is_rested=rests), place=np.arange(300))
    for weight, silence in ((-1.0, 0.5), (-0.25, 0.2), (0.0, 0.0), (2.0, 0.0)):
        memory = Memory(0.6, weight, 0.7)
        np.testing.assert_allclose(Ranked(rested).traces(memory)[::2], silence)
        simulator = replace(fit_memory(responses, memory=memory), rests=jnp.ones(3, bool))
        answers = [simulator.answer(jnp.int32(1), jnp.float32(0.3), after(trace)) for trace in (0.1, 0.9)]
        expected = simulator.answer_at(jnp.int32(1), jnp.float32(0.3), jnp.float32(silence), jnp.float32(0.5))
        assert all(float(answer.rate_hz) == float(expected[0]) for answer in answers)
        tracker = HistoryTracker.of(responses, simulator)
        assert tracker.when(HistoryState(0.9, 0.5, 1.0), 3.0, is_rested=True).trace == silence


def test_responses_that_are_all_the_same_have_no_slopes() -> None:
    responses = loaded(300, 1, slope=0.0)
    same = replace(responses, rate_hz=np.full(300, 7.0))
    assert np.all(np.isfinite(fit_memory(same, memory=Memory(0.3, 0.5, 0.7, 2.0)).toward))


@pytest.mark.oracle
@pytest.mark.parametrize("slope", [-60.0, 60.0])
def test_runs_of_one_condition_are_answered_as_they_are(slope: float) -> None:
    """After ten of one frequency the culture answers otherwise than in random order: its simulator knows."""
    simulator = fit_memory(loaded(1500, 1, slope=slope), memory=Memory(0.0, 0.0, 0.7, 2.0))
    mixed = np.random.default_rng(2).integers(0, 3, 200)
    answer = jax.jit(jax.vmap(simulator.answer, (None, 0, 0)))
    usual = np.mean(loads_by_hand(loaded(1500, 1, slope=slope).condition, 2.0))
    for c in (0, 2):
        given = np.concatenate([mixed, np.full(6, c)])
        # The load in a run, in the units of the recording's.
        time_s = np.cumsum(PERIODS_S[given])
        scale = float(simulator.added)
        load = scale * np.sum(np.exp(-(time_s[-1] - time_s[:-1]) / 2.0))
        expected = 50.0 + 5.0 * c + slope * (load - usual)
        history = jnp.tile(after(0.5), (500, 1))
        for number, each in enumerate(given.tolist()):
            uniforms = jax.random.uniform(jax.random.key(number), (500,))
            rate_hz, history = answer(jnp.int32(each), uniforms, history)
        # Of 500 draws among 35 neighbours, and of what the recording's own order reaches.
        assert float(rate_hz.mean()) == pytest.approx(expected, abs=2.5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), MEMORIES)
@pytest.mark.oracle
def test_what_is_remembered_of_an_answer_is_what_the_recording_remembered_of_it(seed: int, memory: Memory) -> None:
    """Answered as it was recorded, a simulator comes through the histories that the recording came through."""
    rng = np.random.default_rng(seed)
    n = 30
    responses = replace(
        responses_of([1.0], [1.0], [1.0]),
        condition=np.concatenate([[0, 1, 2], rng.integers(0, 3, n - 3)]),
        rate_hz=rng.permutation(n).astype(float),
        active_ratio=np.full(n, 0.1),
        is_burst=np.zeros(n, bool),
    )
    # Of one neighbour alone, and at its own history, that very response is drawn.
    simulator = replace(fit_memory(responses, memory=memory), nearest=jnp.ones(3, jnp.int32))
    histories = histories_by_hand(responses, memory)
    answers = jax.vmap(lambda condition, history: simulator.answer(condition, jnp.float32(0.5), history))(
        jnp.int32(responses.condition), after([float(history) for history in histories[:n]])
    )
    for i in range(n - 1):
        if sum(abs(float(history - histories[i])) < 1e-6 for history in histories) == 1:
            assert float(answers.rate_hz[i]) == responses.rate_hz[i]
            assert float(answers.history[i, 0]) == pytest.approx(float(histories[i + 1]), abs=1e-6)


def test_what_was_recorded_first_follows_silence_and_what_follows_a_burst_is_known_to() -> None:
    responses = responses_of([3.0, 4.0, 5.0], bursts_hz=(90.0,))
    assert responses.last_hz.tolist() == [0.0, 3.0, 4.0, 5.0]
    later = replace(responses, is_burst=np.array([False, True, False, False]), rate_hz=np.array([3.0, 90.0, 5.0, 6.0]))
    np.testing.assert_array_equal(later.last_hz, [0.0, 3.0, np.nan, 5.0])
    simulator = fit_memory(later, memory=Memory(0.0, 0.0, 0.5))
    assert int(simulator.followers[0]) == 2
    # 5 is the second of three, and 6 came after it.
    assert np.asarray(simulator.before)[0].tolist() == [0.0, 0.5, np.inf]
    assert np.asarray(simulator.after_hz)[0, :2].tolist() == [3.0, 6.0]
    # All that is not a burst is there for whoever does not ask what was before.
    assert np.asarray(simulator.values_hz)[0].tolist() == [3.0, 5.0, 6.0]


def test_what_came_before_is_what_was_presented_before() -> None:
    """Also where that has no condition; and nothing, where nothing was presented for a while."""
    times_s = [0.1, 0.3, 0.5, 0.7, 3.0, 3.2]
    spikes = [(t + 0.003 + 0.0005 * i, 0) for n, t in enumerate(times_s) for i in range(n)]
    given = recording(spikes, times_s, n_channels=1, frequency_hz=[5.0, 80.0, 5.0, 80.0, 5.0, 5.0])
    every = extract_responses(given, burst_threshold=1.0)
    np.testing.assert_allclose(every.last_hz, np.array([0, 0, 1, 2, 0, 4]) * 125.0)
    fives = extract_responses(given, conditions_named("frequency:5"), burst_threshold=1.0)
    np.testing.assert_allclose(fives.rate_hz, np.array([0, 2, 4, 5]) * 125.0)
    np.testing.assert_allclose(fives.last_hz, np.array([0, 1, 0, 4]) * 125.0)


def test_between_the_pulses_of_a_slow_presentation_there_is_no_silence() -> None:
    """Presentations of seven pulses, 0.2 s apart, last longer than a silence; the third comes after one."""
    starts_s = np.array([0.1, 1.5, 5.0])
    times_s = (starts_s[:, None] + 0.2 * np.arange(7)).ravel()
    spikes = [(t + 0.004, 0) for t in times_s]
    given = recording(spikes, times_s, n_channels=1, presentation=np.repeat([0, 1, 2], 7).tolist())
    np.testing.assert_allclose(extract_responses(given, burst_threshold=1.0).last_hz, [0.0, 125.0, 0.0])


def test_a_rest_and_what_has_no_condition_are_in_the_past() -> None:
    """Of a recording only 5 Hz is chosen from: what was 80 Hz in between has its rank, and no condition's mean."""
    times_s = [0.1, 0.3, 0.5, 0.7, 3.0, 3.2]
    spikes = [(t + 0.003 + 0.0005 * i, 0) for n, t in enumerate(times_s) for i in range(n)]
    given = recording(spikes, times_s, n_channels=1, frequency_hz=[5.0, 80.0, 5.0, 80.0, 5.0, 5.0])
    responses = extract_responses(given, conditions_named("frequency:5"), burst_threshold=1.0)
    # Four of 5 Hz, of 0, 2, 4 and 5 spikes: ranks 1/8, 3/8, 5/8, 7/8, mean 1/2. One of 80 Hz had 1 spike: rank 1/4.
    simulator = fit_memory(responses, memory=Memory(0.25, 0.5, 0.5))
    first = 0.75 * (1 / 8 + 0.5 / 2) / 1.5
    third = 0.25 * first + 0.75 * (1 / 4 + 0.5 / 2) / 1.5
    last = 0.75 * (5 / 8 + 0.5 / 2) / 1.5
    np.testing.assert_allclose(simulator.before[0], [0.0, 0.0, third, last], atol=1e-7)
    np.testing.assert_allclose(simulator.after_hz[0], np.array([0, 4, 2, 5]) * 125.0)


@pytest.mark.oracle
def test_a_known_chain_is_answered_as_it_is() -> None:
    """Two conditions, four chances: the share of high answers after a low and a high one, within chance."""
    low, high = (0.1, 0.5), (0.3, 0.9)
    responses = chain(8000, after_low=low, after_high=high)
    simulator = fit_memory(responses)
    # The last response is all that it remembers, and all that is found.
    assert simulator.memory[:2] == (0.0, 0.0)
    uniforms = jnp.linspace(0, 1, 2000, endpoint=False)
    for c in (0, 1):
        for last, chance in ((25.0, low[c]), (75.0, high[c])):
            lasts = jnp.linspace(last - 10, last + 10, 50)
            histories = jnp.mean(responses.rate_hz[:, None] < lasts, axis=0)
            x = jax.vmap(lambda at, c=c: jax.vmap(lambda u: simulator.answer(jnp.int32(c), u, at).rate_hz)(uniforms))(
                after(histories)
            )
            share = float(jnp.mean(x >= 50))
            # About 1,200 responses lie behind it.
            assert abs(share - chance) < 5 * np.sqrt(chance * (1 - chance) / 1200)


def test_without_regard_to_the_last_it_is_the_empirical_simulator() -> None:
    responses = chain(400, after_low=(0.1, 0.5), after_high=(0.3, 0.9))
    remembering, plain = fit_memory(responses), fit_empirical(responses)
    uniforms = jnp.linspace(0, 1, 300, endpoint=False)
    for c in (0, 1):
        ours, theirs = (jax.vmap(s.quantile, (None, 0))(jnp.int32(c), uniforms) for s in (remembering, plain))
        np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(
            jax.vmap(plain.answer, (None, 0, None))(jnp.int32(c), uniforms, after(0.7)).rate_hz, theirs
        )
    np.testing.assert_array_equal(remembering.percentiles, plain.percentiles)


def test_bootstrapped_responses_keep_what_was_before_them() -> None:
    responses = chain(500, after_low=(0.1, 0.5), after_high=(0.3, 0.9))
    bootstrapped = responses.bootstrapped(np.random.default_rng(0))
    pairs = set(zip(responses.last_hz, responses.rate_hz, strict=True))
    assert len(bootstrapped) == 500
    assert set(zip(bootstrapped.last_hz, bootstrapped.rate_hz, strict=True)) <= pairs


def test_presentations_that_do_not_fit_are_refused() -> None:
    responses = chain(20, after_low=(0.1, 0.5), after_high=(0.3, 0.9))
    presented, place = responses.presentations
    with pytest.raises(Mismatch, match="expected both or neither"):
        replace(responses, presented=presented)
    with pytest.raises(Mismatch, match=r"responses.place: expected rows from 0 to 19, got 1 to 20"):
        replace(responses, presented=presented, place=place + 1)
    with pytest.raises(Mismatch, match=r"presented.is_rested: expected 20 values"):
        Trials(presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested[1:])


@pytest.mark.oracle
def test_simulators_of_recordings_of_different_lengths_stack() -> None:
    series = [chain(n, after_low=(0.1, 0.5), after_high=(0.3, 0.9), start_min=float(n)) for n in (200, 300)]
    timeline = fit_timeline(series, kind="memory")
    alone = fit_memory(series[0])
    uniforms = jnp.linspace(0, 1, 100, endpoint=False)
    for history in (0.0, 0.3, 0.8, 1.0):
        drawn = [
            jax.vmap(s.answer, (None, 0, None))(jnp.int32(1), uniforms, after(history))
            for s in (timeline.at(200.0), alone)
        ]
        np.testing.assert_array_equal(*(each.rate_hz for each in drawn))
        np.testing.assert_array_equal(*(each.history for each in drawn))
    with pytest.raises(InvalidArgument, match="room"):
        fit_memory(series[1], room=20)


@pytest.mark.parametrize("kind", get_args(SimulatorKind))
def test_a_study_keeps_simulators_of_every_kind(kind: SimulatorKind, tmp_path: Path) -> None:
    culture, presentation = RecordedCulture("virtual", 3), Presentation("mixed", 2)
    known: dict[str, Any] = {
        "culture": culture,
        "presentation": presentation,
        "after_low": (0.1, 0.5),
        "after_high": (0.3, 0.9),
    }
    timeline = fit_timeline([chain(n, start_min=float(n), **known) for n in (200, 300)], kind=kind, range_hz=90.0)
    save_timeline(timeline, tmp_path / "timeline.safetensors")
    loaded = load_timeline(tmp_path / "timeline.safetensors")
    assert (loaded.culture, loaded.presentation) == (culture, presentation)
    for name in ("conditions", "window_ms", "findings", "fitted", "readouts"):
        assert getattr(loaded, name) == getattr(timeline, name), name
    of_histogram = (20, 90.0) if kind == "histogram" else (None, None)
    assert (loaded.fitted["bins"], loaded.fitted["range_hz"]) == of_histogram
    for read, written in zip(loaded.fidelities, timeline.fidelities, strict=True):
        assert (read.labels, read.n_above_range) == (written.labels, written.n_above_range)
        np.testing.assert_array_equal((read.in_data, read.in_simulator), (written.in_data, written.in_simulator))
    assert type(loaded.simulators) is type(timeline.simulators)
    for read, written in zip(jax.tree.leaves(loaded.simulators), jax.tree.leaves(timeline.simulators), strict=True):
        np.testing.assert_array_equal(read, written)
    assert Simulators(kind=kind).kind == loaded.fitted["kind"] == kind


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "No such file"),
        (b"{}", "header"),
        (save({"a": np.zeros(3)}), "no entry 'animat'"),
        (save({"a": np.zeros(3)}, {"animat": '{"format": "a policy"}'}), "no entry 'conditions'"),
        (save({"a": np.zeros(3)}, {"animat": "[" * 100_000}), "recursion"),
    ],
)
def test_a_file_of_another_kind_is_no_simulators(content: bytes | None, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "timeline.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidFile) as error:
        load_timeline(path)
    assert str(error.value).startswith(f"{path}: expected simulators as animat study and animat tune write them, got ")
    assert reason in str(error.value) and str(error.value).endswith("; run the command again to replace it")


@pytest.mark.parametrize("kind", get_args(SimulatorKind))
def test_a_report_says_how_its_simulators_differ_from_the_papers(kind: SimulatorKind) -> None:
    said = dict(decisions(replace(paper_study(), simulators=Simulators(kind=kind))))
    words = {
        "histogram": "20 bins are percentiles",
        "empirical": "there are no bins",
        "memory": "similar history is drawn",
    }
    for other, message in words.items():
        assert any(message in text for text in said.values()) == (other == kind)


def test_an_animat_remembers() -> None:
    # Whatever is chosen, this culture answers as it did before.
    stubborn = replace(
        responses_of([1.0], [1.0]),
        condition=np.tile([0, 1], 100),
        rate_hz=np.repeat([10.0, 90.0], 100),
        active_ratio=np.full(200, 0.1),
        is_burst=np.zeros(200, bool),
        presented=None,
        place=None,
    )
    simulator = fit_memory(stubborn)
    animat = Animat(Cartpole(), Thresholds(1), 2)
    state = animat.reset(jax.random.key(0))
    assert state.neurons.tolist() == [0.5, 0.5]
    for history, answer in ((0.8, 90.0), (0.2, 10.0)):
        came = animat.step(jax.random.key(1), state._replace(neurons=after(history)), jnp.int32(0), simulator)
        assert float(came.info["rate_hz"]) == answer
        then = simulator.answer(jnp.int32(0), jnp.float32(0.5), after(history)).history
        assert came.neurons.tolist() == then.tolist()
        assert float(then[0]) not in (history, 0.5)
    # Without neurons nothing changes it.
    alone = WithoutNeurons(Cartpole(), (-1.0, 1.0))
    assert float(alone.step(jax.random.key(1), state, jnp.int32(0), None).neurons[0]) == 0.5


def persistent(n: int = 10) -> MemorySimulator:
    """A coin for each of two conditions: heads in 0.2 and 0.5 of the tosses after tails, 0.5 and 0.8 after heads."""
    tails, heads = (2, 5), (5, 8)
    answers = np.array(
        [[0.0] * (n - t) + [1.0] * t + [0.0] * (n - h) + [1.0] * h for t, h in zip(tails, heads, strict=True)]
    )
    before = np.array([[0.5] * n + [0.75] * n] * 2)
    plain = coins(3, 6)
    return MemorySimulator(
        jnp.sort(jnp.asarray(answers, jnp.float32), axis=1),
        jnp.full(2, 2 * n),
        plain.percentiles,
        jnp.asarray(before, jnp.float32),
        after(before),
        jnp.asarray(answers, jnp.float32),
        jnp.asarray(0.5 + answers / 4, jnp.float32),
        jnp.full(2, 2 * n),
        jnp.full(2, n),
        jnp.tile(jnp.array([1.0, 0.0]), (2, 1)),
        jnp.ones(2),
        *(jnp.float32(each) for each in (0.0, 0.0, 0.0, 0.5, 0.0)),
    )


@pytest.mark.oracle
@pytest.mark.parametrize("limit", [1, 2, 5, 60])
def test_the_optimum_knows_what_the_neurons_remember(limit: int) -> None:
    """Up and down stairs with a coin that remembers, folded back by hand over step and last toss."""
    heads = np.array([[0.2, 0.5], [0.5, 0.8]])  # after tails and heads, of each action
    worth = np.zeros((5, 2))
    for _ in range(limit):
        up = np.array([[1.0 if s + 1 == 4 else worth[s + 1, 1]] * 2 for s in range(1, 4)])
        down = np.array([[0.0 if s - 1 == 0 else worth[s - 1, 0]] * 2 for s in range(1, 4)])
        of_actions = heads[None] * up[:, :, None] + (1 - heads[None]) * down[:, :, None]
        worth[1:4] = of_actions.max(-1)
    # An episode begins as after tails.
    found = best_return(Animat(Stairs(limit), Thresholds(1), 2), persistent(), grid=STEPS, episodes=4000)
    # Chances are known to one of 2,048 draws.
    assert found.value == pytest.approx(worth[2, 0], abs=1e-3)
    assert abs(found.monte_carlo - worth[2, 0]) < 4 * found.standard_error + 1e-6


@pytest.mark.oracle
def test_cases_with_and_without_memory_have_the_optima_that_they_have_alone() -> None:
    environment = Animat(Stairs(), Thresholds(1), 2)
    cases = [(environment, coins(3, 6)), (environment, persistent()), (environment, coins(1, 2))]
    together = best_returns(cases, grid=STEPS, episodes=500)
    for case, found in zip(cases, together, strict=True):
        assert best_return(*case, grid=STEPS, episodes=500).to_dict() == found.to_dict()


def independent(seed: int, n: int = 500) -> Responses:
    """Responses to five conditions in turn, of a culture that remembers nothing."""
    rng = np.random.default_rng(seed)
    condition = rng.permutation(np.arange(n) % 5)
    return replace(
        responses_of(*[[1.0]] * 5),
        condition=condition,
        rate_hz=rng.gamma(6.0, 5.0 + condition),
        active_ratio=np.full(n, 0.1),
        is_burst=np.zeros(n, bool),
    )


def network(seed: int, spikes: float, n: int = 3000) -> Responses:
    """Responses of a network that answers less the more active it has just been, read by so many spikes each."""
    rng = np.random.default_rng(seed)
    condition, x = rng.integers(0, 5, n), np.zeros(n)
    before = 0.5
    for i, c in enumerate(condition):
        activity = (0.4 + 0.15 * c) * rng.gamma(10, 0.1) * (1.5 - before)
        x[i] = rng.poisson(spikes * activity)
        before = 0.3 * before + 0.7 * min(activity, 1.0)
    return replace(independent(seed, n), condition=condition, rate_hz=x)


@pytest.mark.parametrize("seed", range(3))
def test_the_fewer_the_spikes_the_more_the_stimulus_weighs_in_the_trace(seed: int) -> None:
    many = fit_memory(network(seed, spikes=300)).memory
    few = fit_memory(network(seed, spikes=3)).memory
    # The network's own: it remembers its activity, which so many spikes measure well.
    assert (many.decay, many.weight) == (pytest.approx(0.3), 0.0)
    assert few.weight >= 2


@pytest.mark.oracle
def test_without_memory_in_the_responses_there_is_mostly_none_in_the_simulator() -> None:
    none = 0
    for seed in range(60):
        simulator = fit_memory(independent(seed))
        none += simulator.memory == NO_MEMORY
    # By chance the best of many memories predicts a little better than none: two standard errors keep that part small.
    assert none >= 54
    assert not any(
        np.all(each.nearest == each.followers)
        for each in (
            fit_memory(chain(500, after_low=(0.1, 0.5), after_high=(0.5, 0.9), seed=seed)) for seed in range(20)
        )
    )


@pytest.mark.oracle
def test_without_memory_none_is_found_where_responses_are_of_few_spikes() -> None:
    """Many responses are the same then, and histories too."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found.append(fit_memory(replace(independent(seed), rate_hz=rng.poisson(1.0, 500).astype(float))).memory)
    assert all(memory == NO_MEMORY or memory.neighbour_exponent < 1 for memory in found)
    assert found.count(NO_MEMORY) >= 36


def test_the_optimum_of_a_custom_simulator_with_memory_is_refused() -> None:
    class Own(EmpiricalSimulator):
        has_memory = True

    plain = fit_empirical(independent(0))
    own = Own(plain.values_hz, plain.counts, plain.percentiles)
    with pytest.raises(InvalidArgument, match="simulator: expected a MemorySimulator or one without memory, got Own"):
        best_return(Animat(Stairs(), Thresholds(1), 5), own, grid=STEPS, episodes=0)


@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9), Linear()])
@pytest.mark.oracle
def test_where_nothing_is_remembered_commands_and_optimum_are_those_without_memory(mapping: Any) -> None:
    responses = independent(0)
    simulator, plain = fit_memory(responses), fit_empirical(responses)
    assert np.all(simulator.nearest == simulator.followers)
    environment = Animat(Navigation(), mapping, 5)
    rows, (whole,) = commands_after(environment, simulator), commands_after(environment, plain)[0]
    assert len(rows) == len(rows[0]) == CLASSES
    means = np.sum(whole.levels * whole.probabilities, axis=1)
    for row in rows:
        np.testing.assert_allclose(sum(each.probabilities.sum(axis=1) for each in row), 1.0, atol=1e-9)
        mean = sum(np.sum(each.levels * each.probabilities, axis=1) for each in row)
        np.testing.assert_allclose(mean, means, atol=0.01)
    if isinstance(mapping, Thresholds):
        optima = [best_return(environment, each, resolution=0.4, episodes=0).value for each in (simulator, plain)]
        assert optima[0] == pytest.approx(optima[1], abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize("robot", [Cartpole(), Navigation()])
@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9)])
def test_the_controller_that_remembers_gets_what_was_promised(robot: Any, mapping: Any) -> None:
    """The optimum's own controller, on the simulator with its memory of a real number, beside six classes of it."""
    chances = {"after_low": (0.05, 0.2, 0.35, 0.45, 0.5), "after_high": (0.25, 0.5, 0.75, 0.85, 0.9)}
    simulator = fit_memory(chain(2500, **chances))
    found = best_return(Animat(robot, mapping, 5), simulator, resolution=0.8, episodes=4000)
    assert abs(found.value - found.monte_carlo) < 4 * found.standard_error + 2 * found.grid_error + 0.02 * abs(
        found.value
    )


@pytest.mark.long
def test_intervals_of_predictions_with_memory_hold_what_they_say() -> None:
    """A culture that is a known chain, and 500 responses of it in each recording."""
    chances = {"after_low": (0.05, 0.2, 0.35, 0.5, 0.6), "after_high": (0.25, 0.5, 0.75, 0.85, 0.95)}
    environment = Animat(Cartpole(), Thresholds(1), 5)
    culture = fit_memory(chain(40_000, seed=99, **chances))
    rule = heuristic_policy(environment, culture)

    def returns(simulator: MemorySimulator, episodes: int, seed: int) -> np.ndarray:
        return roll_out(environment, simulator, rule, episodes=episodes, seed=seed).returns.ravel()

    truth, covered = returns(culture, 20_000, 1).mean(), 0
    for seed in range(60):
        calibration = Calibration.of_series([chain(500, seed=seed, **chances)], kind="memory")
        low, high = np.quantile([returns(each, 200, seed).mean() for each in calibration.bootstraps], [0.025, 0.975])
        covered += low <= truth <= high
    # 57 of 60, standard deviation 1.7; nearest neighbours of so few responses blur the chain's step a little.
    assert 51 <= covered <= 60


@pytest.mark.oracle
def test_an_environment_without_neurons_has_its_optimum_with_any_simulator() -> None:
    """As a case of its own, and beside one whose neurons remember."""
    alone = best_return(WithoutNeurons(Stairs(5), (-1.0, 1.0)), None, grid=STEPS, episodes=10)
    both = [(WithoutNeurons(Stairs(5), (-1.0, 1.0)), persistent()), (Animat(Stairs(5), Thresholds(1), 2), persistent())]
    assert [found.value for found in best_returns(both, grid=STEPS, episodes=10)] == [
        alone.value,
        best_return(*both[1], grid=STEPS, episodes=0).value,
    ]


@pytest.mark.oracle
def test_shuffled_delivery_leaves_nothing_to_choose() -> None:
    simulator = fit_memory(chain(500, after_low=(0.1, 0.5), after_high=(0.3, 0.9)))
    environment = ShuffledDelivery(Animat(Stairs(), Thresholds(1), 2))
    optimum = best_return(environment, simulator, grid=STEPS, episodes=0)
    played = [
        roll_out(environment, simulator, actor, episodes=4000, seed=1).returns
        for actor in (Uniform(), Constant(jnp.array([0])))
    ]
    for returns in played:
        # Six classes stand for a memory of a real number.
        assert abs(returns.mean() - optimum.value) < 5 * returns.std() / np.sqrt(4000) + 0.03


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_memory_is_found_where_there_is_one_and_not_where_there_is_none(seed: int) -> None:
    remembers = chain(500, after_low=(0.1, 0.5), after_high=(0.5, 0.9), seed=seed)
    (found,) = memory_findings(remembers)
    assert found.severity == "note"
    assert found.value == pytest.approx(0.4, abs=0.2)
    assert not list(memory_findings(independent(seed)))
    falls = independent(seed, 2500)
    drifting = replace(falls, rate_hz=falls.rate_hz * np.linspace(1.4, 0.6, 2500))
    assert not list(memory_findings(drifting))


@pytest.mark.parametrize("of_each", [3, 40])
def test_the_error_of_memory_is_that_of_tables_with_fixed_margins(of_each: int) -> None:
    rng = np.random.default_rng(of_each)
    n, n_conditions = 240, 240 // of_each
    chained = np.cumsum(rng.normal(size=n)) * 0.2 + rng.normal(size=n)
    condition, never = np.arange(n) % n_conditions, np.zeros(n, np.bool_)
    conditions = tuple(Condition(str(c), float(c)) for c in range(n_conditions))
    responses = Responses(condition, 10 + chained, np.zeros(n), never, conditions, (2.0, 10.0), 64, 1.0, 0.0)
    passes = responses.rate_hz >= np.median(responses.rate_hz)
    after = np.append(False, passes[:-1])
    more, variance = 0.0, 0.0
    for c in range(n_conditions):
        of = condition == c
        n1, m1 = int(after[of].sum()), int(passes[of].sum())
        # The hypergeometric distribution of how many pass after one that did.
        more += np.count_nonzero(passes[of] & after[of]) - n1 * m1 / of_each
        variance += n1 * (of_each - n1) * m1 * (of_each - m1) / (of_each**2 * (of_each - 1))
    found = compare_passing(responses, ~never, lambda rows, _: after[rows])
    assert found is not None
    assert found.difference / found.error == pytest.approx(more / np.sqrt(variance))


def test_conditions_in_blocks_are_not_taken_for_memory() -> None:
    rng = np.random.default_rng(0)
    blocks = responses_of(*[rng.normal(mean, 1.0, 100) for mean in (20, 25, 30, 35, 40)])
    assert not list(memory_findings(blocks))
    assert not list(memory_findings(replace(blocks, conditions=(*blocks.conditions, Condition("none", 1.0, "Hz")))))


def test_a_memory_of_blocks_is_reported() -> None:
    for order in ("mixed", "blocked"):
        responses = chain(200, after_low=(0.1, 0.5), after_high=(0.3, 0.9), presentation=Presentation(order))
        found = {finding.name for finding in fit_timeline([responses], kind="memory").findings}
        assert ("memory-of-blocks" in found) == (order == "blocked")
        assert "memory-of-blocks" not in {finding.name for finding in fit_timeline([responses]).findings}


def test_the_load_decays_while_stimulation_is_set_up_between_blocks() -> None:
    recording = SyntheticCulture(1, channels=32, patterns=20).record(0)
    protocol = Protocol(patterns=20, trials=20, setup_s=14.0)
    responses = extract_responses(replace(recording, protocol=protocol), burst_threshold=0.95)
    presented = responses.presentations[0]
    at_once = extract_responses(recording, burst_threshold=0.95).presentations[0]
    assert presented.clock_s is not None and presented.time_s is not None and at_once.clock_s is at_once.time_s
    is_first = np.arange(100) % 20 == 0
    waited_s = np.diff(presented.clock_s) - np.diff(presented.time_s)
    np.testing.assert_allclose(waited_s, np.where(is_first[1:], 14.0, 0.0), atol=1e-9)
    loads = Ranked(responses).loads(1.0).every
    assert np.all(loads[is_first] < 1e-5) and np.all(loads[~is_first] > 1e-3)


def test_the_fidelity_of_a_simulator_with_memory_is_that_of_its_answers() -> None:
    (kept,) = fit_timeline([chain(2000, after_low=(0.1, 0.5), after_high=(0.5, 0.9))], kind="memory").fidelities
    np.testing.assert_allclose(kept.in_simulator, kept.in_data, atol=0.03)
    assert not np.array_equal(kept.in_simulator, kept.in_data)


@pytest.mark.parametrize("seed", range(4))
def test_what_a_simulator_without_memory_keeps_is_all_of_its_responses(seed: int) -> None:
    responses = independent(seed, 1500)
    simulator = fit_memory(responses, memory=NO_MEMORY)
    kept = fidelity(responses, simulator)
    np.testing.assert_allclose(kept.in_simulator, kept.in_data, atol=1e-6)
    assert not kept.findings(of_memory=True)


@pytest.mark.oracle
def test_what_a_simulator_with_memory_keeps_is_what_many_draws_come_to() -> None:
    responses = chain(400, after_low=(0.1, 0.5), after_high=(0.5, 0.9))
    simulator = fit_memory(responses)
    rng, above, median_hz = np.random.default_rng(0), [], np.asarray(simulator.percentiles, np.float32)[5]
    for condition, n in enumerate(np.asarray(simulator.followers)):
        histories = np.asarray(simulator.histories)[condition, rng.integers(n, size=40_000)]
        drawn = jax.vmap(simulator.answer, (None, 0, 0))(condition, rng.random(40_000, np.float32), histories)
        above.append(np.mean(np.asarray(drawn.rate_hz) >= median_hz))
    np.testing.assert_allclose(fidelity(responses, simulator).in_simulator, above, atol=0.015)


def test_too_few_neighbours_are_reported() -> None:
    few = chain(40, after_low=(0.1, 0.5), after_high=(0.5, 0.9))
    # Always the nearest alone: what had an outlying history is drawn most often.
    kept = fidelity(few, fit_memory(few, memory=Memory(0.0, 0.0, 0.0)))
    moved = replace(kept, in_simulator=kept.in_data + np.array([0.06, 0.0]))
    (found,) = moved.findings(of_memory=True)
    assert found.name == "few-neighbours"
    assert found.value == pytest.approx(0.06)
    assert [finding.name for finding in moved.findings()] == ["binning"]
    assert all(finding.name != "binning" for finding in fit_timeline([few], kind="memory").findings)


@pytest.mark.oracle
def test_training_reports_the_memory() -> None:
    series = [chain(500, after_low=(0.1, 0.5), after_high=(0.5, 0.9)), replace(independent(0), start_min=10.0)]
    series[1] = replace(series[1], condition=series[1].condition % 2, conditions=series[0].conditions)
    timeline = fit_timeline(series, kind="memory")
    first, last = _memories(timeline)
    decay, weight, neighbour_exponent, _ = fit_memory(series[0]).memory
    assert first.startswith("memory at 0 min: a response depends on earlier trials, ")
    assert (
        f"each trial counts {decay:.2g} times as much as the one after it, and its stimulus {weight:.2g} times as"
        in first
    )
    n = int(np.median([np.count_nonzero(series[0].condition == c) for c in range(2)]))
    near = int(np.median([np.rint(len(series[0].rates_of(c)) ** neighbour_exponent) for c in range(2)]))
    assert first.endswith(f"draws from the {near} responses with the most similar history, out of {n} per condition")
    (message,) = _memories(fit_timeline([loaded(600, 1, slope=-60.0)], kind="memory"))
    assert ". It also depends on the amount of stimulation in the last 1 s. The simulator draws" in message
    (message,) = _memories(fit_timeline([network_of_its_own(3000, 1)], kind="memory"))
    less = "1 times the mean rank of its condition is subtracted from the rank of its response"
    assert f"earlier trials, where each trial counts 0.6 times as much as the one after it, and {less}. The" in message
    assert last == "memory at 10 min: none was found"
    assert not list(_memories(fit_timeline(series)))
    differing = Finding("difference", "note", "the conditions differ by 0.40", 0.4)
    lines = _controllability(replace(timeline, findings=(differing,))).splitlines()
    assert lines[0].startswith("P(x >= P50), the share of responses that reach the median, in the simulator at 0 min: ")
    assert lines[1].startswith("in the recording, before the simulator draws from it, the conditions differ by 0.40")
    assert lines[2:] == [first, last]


def test_gymnasium_environments_remember(tmp_path: Path) -> None:
    write_nwb(synthetic_recording(1, channels=32), tmp_path / "synthetic.nwb")
    with pytest.warns(UserWarning, match="presented in blocks"):
        environment = gymnasium.make("Animat/Navigation-v0", recordings=tmp_path / "synthetic.nwb", kind="memory")
    environment.reset(seed=1)
    rates_hz = [environment.step(0)[4]["rate_hz"] for _ in range(20)]
    assert len(set(rates_hz)) > 1


@pytest.mark.oracle
def test_training_through_a_memory_begins_each_episode_alike(tmp_path: Path) -> None:
    """The culture answers low, middle, high in turn, whatever is chosen, and each episode begins in the middle."""
    x = np.tile([10.0, 50.0, 90.0], 80)
    turns = replace(
        responses_of([1.0], [1.0]),
        condition=np.tile([0, 0, 0, 1, 1, 1], 40),
        rate_hz=x,
        active_ratio=np.full(240, 0.1),
        is_burst=np.zeros(240, bool),
    )
    timeline = fit_timeline([turns, replace(turns, start_min=10.0)], kind="memory")
    training = Training(Navigation(episode_limit=7), Thresholds(1), policies=2, iterations=4_000, duration_min=20.0)
    trained = train(training, timeline, tmp_path / "policies")
    assert all(policy.fitted["kind"] == "memory" for policy in trained.values())
    played = roll_out(
        training.environment(2), timeline.at(0.0), networks_of(list(trained.values())), episodes=3, seed=1
    )
    # Every episode is the same one, in training as in evaluation.
    assert len(set(played.returns.ravel().tolist())) == 1
    for policy in trained.values():
        means = policy.learning_curve[:, 2]
        np.testing.assert_allclose(means[~np.isnan(means)], played.returns[0, 0], atol=5e-3)


def slow(n: int, slow_conditions: tuple[int, ...], *, trend: float, carry: float = 0.0, seed: int = 1) -> Responses:
    """Responses that rise over the recording, of three conditions; trials of some come after a silence each."""
    rng = np.random.default_rng(seed)
    condition = rng.integers(0, 3, n)
    is_rested = np.isin(condition, slow_conditions)
    x, before = np.zeros(n), 0.0
    for i, c in enumerate(condition):
        noise = rng.normal(0, 5)
        x[i] = 50 + 4 * c + trend * i / n + noise + (0.0 if is_rested[i] else carry * before)
        before = noise
    every = Trials(condition, x, np.zeros(n, bool), is_rested)
    columns = {"condition": condition, "rate_hz": x, "active_ratio": np.full(n, 0.1), "is_burst": every.is_burst}
    return replace(responses_of(*[[1.0]] * 3), presented=every, place=np.arange(n), **columns)


@pytest.mark.parametrize("seed", range(3))
def test_drift_of_responses_after_silence_is_no_memory(seed: int) -> None:
    """All have the same history, so their order is that of time."""
    assert fit_memory(slow(300, (0, 1, 2), trend=20.0, seed=seed)).memory == NO_MEMORY


def test_trials_after_silence_are_answered_with_all_responses_to_such() -> None:
    responses = slow(600, (0,), trend=20.0, carry=0.9)
    simulator = fit_memory(responses, memory=Memory(0.0, 0.0, 0.5))
    assert np.asarray(simulator.rests).tolist() == [True, False, False]
    uniforms = (jnp.arange(4000) + 0.5) / 4000
    answer = jax.vmap(simulator.answer, (None, 0, None))
    recorded = np.sort(responses.rate_hz[responses.condition == 0])
    for trace in (0.1, 0.9):
        answers = np.sort(np.asarray(answer(jnp.int32(0), uniforms, after(trace)).rate_hz))
        np.testing.assert_allclose(
            np.quantile(answers, [0.1, 0.5, 0.9]), np.quantile(recorded, [0.1, 0.5, 0.9]), rtol=0.01
        )
        # The next trace is that of this response alone.
        assert float(answer(jnp.int32(0), uniforms, after(trace)).history[0, 0]) < 0.05
    # The others depend on it.
    low, high = (float(answer(jnp.int32(1), uniforms, after(trace)).rate_hz.mean()) for trace in (0.1, 0.9))
    assert high > low + 2


def test_without_memory_policies_see_in_training_what_they_see_in_a_loop() -> None:
    rng = np.random.default_rng(2)
    responses = responses_of(rng.normal(50, 5, 200), rng.normal(60, 5, 200))
    simulator = fit_timeline([responses], kind="memory").at(0.0)
    assert isinstance(simulator, MemorySimulator) and simulator.memory == NO_MEMORY
    history = simulator.answer(jnp.int32(1), jnp.float32(0.9), after(0.5)).history
    assert (
        tuple(history.tolist())
        == HistoryTracker.of(responses, simulator).observed(HistoryState(0.2, 0.7))
        == (0.5, 0.5)
    )
