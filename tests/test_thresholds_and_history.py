"""Adaptive thresholds of a culture that remembers: they follow the culture, and not what an agent likes to choose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import percentileofscore

from animat.closed_loop.adaptive import LEVEL_TRIALS, AdaptiveThresholds, LevelThresholds, Trial, thresholds_of
from animat.closed_loop.agents import Agent, AnyCondition, OneCondition
from animat.closed_loop.running import run_session
from animat.neurons.expected import Expected
from animat.neurons.history import Memory
from animat.neurons.memory import MemorySimulator, fit_memory
from animat.neurons.remembering import Remembering
from animat.responses.condition import Condition
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.stimulation.protocol import Protocol
from fake_culture import FakeCulture
from test_closed_loop import loop_of

MEMORY = Memory(0.0, 1.0, 0.7, 0.0)
WEAK, STRONG = 0, 1
EVERY_S = 0.1


def answered_hz(condition: int, before: int, rng: np.random.Generator) -> float:
    """A culture that does not drift: after a weak stimulus it has rested, and answers a third more than otherwise."""
    mean_hz = (20.0, 40.0)[condition] * (1.0 if before == STRONG else 4 / 3)
    return float(mean_hz * rng.gamma(25.0, 1 / 25.0))


@pytest.fixture(scope="module")
def recorded() -> Responses:
    rng = np.random.default_rng(5)
    condition = rng.integers(0, 2, 4_000)
    rate_hz = [answered_hz(now, before, rng) for before, now in zip([WEAK, *condition], condition, strict=False)]
    n = len(condition)
    return Responses(
        condition=condition,
        rate_hz=np.array(rate_hz),
        active_ratio=np.zeros(n),
        is_burst=np.zeros(n, bool),
        conditions=(Condition("weak", 1.0), Condition("strong", 2.0)),
        window_ms=(2.0, 10.0),
        n_channels=100,
        threshold=1.0,
        separability=float("nan"),
        time_s=EVERY_S * np.arange(n),
    )


@pytest.fixture(scope="module")
def simulator(recorded: Responses) -> MemorySimulator:
    return fit_memory(recorded, memory=MEMORY)


@given(condition=st.integers(0, 1), trace=st.floats(0, 1, width=32), load=st.floats(0, 2, width=32))
@settings(max_examples=30, deadline=None)
def test_what_is_expected_is_the_mean_of_what_the_simulator_draws_from(
    simulator: MemorySimulator, condition: int, trace: float, load: float
) -> None:
    expected_hz = Expected.of(simulator).mean_hz(condition, trace, load)
    first, end = map(int, simulator.rows_near(jnp.int32(condition), jnp.float32(trace), jnp.float32(load)))
    assert expected_hz.shape == (1,)
    after_hz = np.asarray(simulator.after_hz)[condition]
    assert expected_hz[0] == pytest.approx(after_hz[first:end].mean(), rel=1e-5)


def p50_after(recorded: Responses, remembering: Remembering | None, chosen: np.ndarray, level: float = 1.0) -> float:
    """P50 after a session in which trials were chosen so, of a culture that answers `level` times what it did."""
    rng = np.random.default_rng(6)
    thresholds = thresholds_of([recorded.rates_of(condition) for condition in (WEAK, STRONG)], remembering)
    assert isinstance(thresholds, AdaptiveThresholds if remembering is None else LevelThresholds)
    before = WEAK
    for number, condition in enumerate(chosen.tolist()):
        at_s = EVERY_S * number
        x_hz = np.asarray(level * answered_hz(condition, before, rng))
        thresholds.see(Trial(condition, x_hz, float(x_hz), at_s, at_s, is_burst=False, counts=True))
        before = condition
    return float(thresholds.percentiles()[5])


def test_what_an_agent_likes_to_choose_does_not_move_thresholds(
    recorded: Responses, simulator: MemorySimulator
) -> None:
    """Nine trials in ten are weak ones: responses are larger than in the recording, and the culture is the same."""
    chosen = (np.random.default_rng(7).random(2_000) < 0.1).astype(int)
    p50_hz = float(np.percentile(recorded.rate_hz, 50))
    assert p50_after(recorded, None, chosen) > 1.08 * p50_hz
    # Of 200 responses with a standard deviation of a quarter or so the mean is known to 2 %.
    assert p50_after(recorded, Remembering.of(recorded, simulator), chosen) == pytest.approx(p50_hz, rel=0.06)


@pytest.mark.parametrize("level", [0.6, 1.5])
def test_thresholds_follow_a_culture_that_tires_or_recovers(
    recorded: Responses, simulator: MemorySimulator, level: float
) -> None:
    chosen = np.random.default_rng(8).integers(0, 2, 5 * LEVEL_TRIALS)
    p50_hz = level * float(np.percentile(recorded.rate_hz, 50))
    # What is left of the recording is exp(-5) of the way; histories are by ranks, which a level moves too.
    assert p50_after(recorded, Remembering.of(recorded, simulator), chosen, level) == pytest.approx(p50_hz, rel=0.15)


def test_in_a_session_thresholds_are_what_its_log_lets_one_compute(tmp_path: Path) -> None:
    """Computed again tick by tick with SciPy's ranks; constant agents count in the history, and not for thresholds."""
    memory = Memory(0.3, 0.5, 0.7, 1.0)
    with FakeCulture() as culture:
        recording = culture.record(Protocol(order="mixed", patterns=8, trials=40, setup_s=0.1), 0)
        responses = extract_responses(recording, burst_threshold=0.95)
        simulator = fit_memory(responses, memory=memory)
        remembering = Remembering.of(responses, simulator)
        reference = tuple(responses.rates_of(condition) for condition in range(5))
        loop = replace(
            loop_of(robot=Cartpole(episode_limit=12), burst_threshold=0.95, adaptive_from=reference),
            remembering=remembering,
        )
        agents = [
            Agent("random", "any", AnyCondition(5)),
            Agent("always", "", OneCondition(4), calibrates=False),
            Agent("no", "", OneCondition(4), "silent"),
        ]
        session = run_session(culture, loop, agents, tmp_path, episodes=3, seed=2)
    told = {
        record.words["episode"]: record.words["percentiles_hz"]
        for record in session.log.records
        if record.words["kind"] == "percentiles"
    }
    pooled_hz = np.percentile(np.concatenate(reference), range(0, 101, 10))
    mean_hz = expected_hz = np.mean(np.concatenate(reference))
    expected, trace, load, before_s, compared = Expected.of(simulator), 0.0, 0.0, -np.inf, 0
    for tick in session.ticks:
        if tick.iteration == 0 and tick.episode in told:
            np.testing.assert_allclose(told[tick.episode], pooled_hz * mean_hz / expected_hz, rtol=1e-5)
            compared += 1
        if not tick.pulse_time_s:
            continue
        first_s, last_s = tick.pulse_time_s[0], tick.read_after_s
        trace = 0.0 if first_s - before_s > 1.0 else trace
        load = load * np.exp((before_s - last_s) / memory.load_s)
        if not tick.is_burst and (tick.agent == "random" or tick.iteration < 0):
            mean_hz = (1 - 1 / 200) * mean_hz + tick.rate_hz / 200
            expected_hz = (1 - 1 / 200) * expected_hz + expected.mean_hz(tick.delivered, trace, load)[0] / 200
        rank = percentileofscore(remembering.sorted_hz, tick.rate_hz, kind="mean") / 100
        more = (1 - memory.decay) * (rank + memory.weight * remembering.mean_ranks[tick.delivered])
        trace = 0.5 if tick.is_burst else memory.decay * trace + more / (1 + memory.weight)
        load, before_s = load + remembering.added, last_s
    assert compared > 3 and mean_hz / expected_hz != pytest.approx(1.0, abs=1e-3)
