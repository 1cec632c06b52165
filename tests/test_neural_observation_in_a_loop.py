"""A policy that sees the neurons in a closed loop: the history state is that of a recording, and what it acts on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import percentileofscore

from animat.closed_loop.agents import Agent, AnyCondition
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.environment import Animat
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import networks_of, roll_out
from animat.neurons.history import Memory, Ranked
from animat.neurons.history_tracker import HistoryState, HistoryTracker
from animat.neurons.memory import fit_memory
from animat.neurons.timeline import fit_simulator
from animat.reality_gap import Calibration, run_policies
from animat.reality_gap.predicting import EPISODES, roll_out_seed
from animat.recordings.recording import Recording
from animat.responses.conditions import NO_CONDITION
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.stimulation.protocol import Protocol
from animat.wrappers import NeuralObservation
from fake_culture import FakeCulture
from test_closed_loop import loop_of
from test_reality_gap import policy_of

MEMORY = Memory(0.3, 0.5, 0.7, 2.0)
PROTOCOL = Protocol(order="mixed", patterns=8, trials=40, setup_s=0.1)
SHORT = Cartpole(episode_limit=12)


@pytest.fixture(scope="module")
def recording() -> Recording:
    with FakeCulture() as culture:
        return culture.record(PROTOCOL, 0)


@pytest.fixture(scope="module")
def responses(recording: Recording) -> Responses:
    return extract_responses(recording, burst_threshold=0.95)


@pytest.fixture(scope="module")
def remembering(responses: Responses) -> HistoryTracker:
    return HistoryTracker.of(responses, fit_memory(responses, memory=MEMORY))


def test_trial_by_trial_it_is_the_state_of_the_recording(responses: Responses, remembering: HistoryTracker) -> None:
    ranked = Ranked(responses)
    traces, loads = ranked.recorded(MEMORY)[0], ranked.loads(MEMORY.load_s)
    presented, _ = responses.presentations
    assert presented.time_s is not None and presented.is_burst.any()
    state = HistoryState()
    for row, at_s in enumerate(presented.time_s.tolist()):
        # The load falls up to the trial; what a policy sees is that after the trial before it.
        came = remembering.when(state, at_s, is_rested=bool(presented.is_rested[row]))
        assert (came.trace, came.load, came.at_s) == pytest.approx((traces[row], loads.every[row], at_s))
        state = remembering.after(
            came, int(presented.condition[row]), float(presented.rate_hz[row]), is_burst=bool(presented.is_burst[row])
        )


@pytest.mark.parametrize("memory", [MEMORY, MEMORY._replace(weight=-0.75)])
def test_trials_without_a_condition_are_remembered_too(responses: Responses, memory: Memory) -> None:
    some = responses.only([0, 4])
    of_some = HistoryTracker.of(some, fit_memory(some, memory=memory))
    (presented, place), state, states = some.presentations, of_some.at_rest, []
    assert presented.time_s is not None and (presented.condition == NO_CONDITION).any()
    columns = (presented.condition, presented.rate_hz, presented.is_burst, presented.is_rested, presented.time_s)
    for condition, rate_hz, is_burst, is_rested, at_s in zip(*columns, strict=True):
        came = of_some.when(state, at_s, is_rested=is_rested)
        states.append((came.trace, came.load))
        state = of_some.after(came, condition, rate_hz, is_burst=is_burst)
    np.testing.assert_allclose(np.array(states)[place], Ranked(some).states(memory), atol=1e-6)


def test_without_memory_it_is_what_simulators_without_memory_show(responses: Responses) -> None:
    blank = HistoryTracker.of(responses, fit_simulator(responses, kind="histogram", bins=20, range_hz=None))
    state = blank.after(HistoryState(), 2, 30.0, is_burst=False)
    assert blank.observed(state) == blank.observed(HistoryState()) == (0.5, 0.5)
    no_load = HistoryTracker.of(responses, fit_memory(responses, memory=MEMORY._replace(load_s=0.0)))
    assert no_load.observed(no_load.after(HistoryState(), 2, 30.0, is_burst=False))[1] == 0.5


class Watching:
    """Draws any condition, and keeps what it was shown."""

    neural_observation = True

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        self.shown.append(np.array(observation))
        return int(rng.integers(5))


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory, remembering: HistoryTracker) -> tuple[Session, Watching]:
    # Six pulses at 5 Hz last for a second, which is no rest.
    watching, loop = Watching(), replace(loop_of(robot=SHORT, burst_threshold=0.95, pulses=6), remembering=remembering)
    agents = [Agent("watching", "sees", watching), Agent("random", "does not", AnyCondition(5))]
    with FakeCulture() as culture:
        return run_session(culture, loop, agents, tmp_path_factory.mktemp("loop"), episodes=4, seed=2), watching


def test_what_is_shown_follows_from_what_was_answered_before(
    ran: tuple[Session, Watching], remembering: HistoryTracker
) -> None:
    """Computed again from the log, with SciPy's ranks."""
    session, watching = ran
    trace = load = 0.0
    before_s, shown = -np.inf, iter(watching.shown)
    m, seen = MEMORY, 0
    observed: tuple[float, ...] = ()
    for tick in session.ticks:
        if tick.agent == "watching" and tick.iteration >= 0:
            now = next(shown)
            observed = session.episodes[tick.episode].start if tick.iteration == 0 else observed
            np.testing.assert_array_equal(now[:-2], observed)
            np.testing.assert_allclose(now[-2:], (trace, load), atol=1e-12)
            seen += 1
        observed = tick.observation
        first_s, last_s = tick.pulse_time_s[0], tick.read_after_s
        trace = 0.0 if first_s - before_s > 1.0 else trace
        load = load * np.exp((before_s - last_s) / m.load_s) + remembering.added
        rank = percentileofscore(remembering.sorted_hz, tick.rate_hz, kind="mean") / 100
        mean = remembering.mean_ranks[tick.delivered]
        more = (1 - m.decay) * (rank + m.weight * mean) / (1 + m.weight)
        trace = 0.5 if tick.is_burst else m.decay * trace + more
        before_s = last_s
        assert tick.neurons == pytest.approx((trace, load))
    assert seen > 12 and next(shown, None) is None


def test_a_loop_without_it_writes_none_and_refuses_who_sees(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        with pytest.raises(InvalidArgument, match=r"loop: expected `remembering` .* history state \(w\), got none"):
            run_session(culture, loop_of(robot=SHORT), [Agent("w", "sees", Watching())], tmp_path, episodes=1)
        blind = [Agent("random", "does not", AnyCondition(5))]
        session = run_session(culture, loop_of(robot=SHORT), blind, tmp_path, episodes=1)
    assert all(tick.neurons == () for tick in session.ticks)


@pytest.mark.oracle
def test_policies_that_see_are_predicted_and_run(
    tmp_path: Path, responses: Responses, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.reality_gap.calibration.BOOTSTRAPS", 3)
    monkeypatch.setattr("animat.neurons.memory._find_memory", lambda ranked: MEMORY)
    given: dict[str, Any] = {"presentation": None, "neural_observation": True}
    rng = np.random.default_rng(4)
    weights = tuple(rng.standard_normal(s).astype(np.float32) for s in ((6, 16), (16, 16), (16, 5)))
    policy = policy_of(0, [responses], SHORT, weights=weights, scales=np.ones(6, np.float32), **given)
    calibration = Calibration.of_series([responses], kind="memory")
    with FakeCulture() as culture:
        gap = run_policies({"p0": policy}, culture, calibration, tmp_path, episodes=2, with_controls=False)
    assert gap.session.ending.by == "plan"
    assert all(len(tick.neurons) == 2 for tick in gap.session.ticks)
    assert policy.mapping is not None
    seeing = NeuralObservation(Animat(SHORT, policy.mapping, 5))
    alone = roll_out(
        seeing,
        calibration.simulator,
        networks_of([policy], greedy=True),
        episodes=EPISODES,
        seed=roll_out_seed(1, 0, 0),
    )
    np.testing.assert_array_equal(gap.rows[0].predicted[:EPISODES], alone.returns.ravel())
