"""Interventions in a closed loop: each does what it says, seen in the log of a session, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.closed_loop.agents import ActorController, Agent, AnyCondition, OneCondition, agent_of
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.closed_loop.stretch import Stretch, read_response
from animat.closed_loop.tick import Tick
from animat.coding.mapping import Thresholds
from animat.environment import Animat
from animat.errors import InvalidArgument
from animat.evaluation.controls import controls_of, interventions_of
from animat.evaluation.rollouts import Actor
from animat.neurons.synthetic import synthetic_simulator
from animat.robots import Cartpole, Robot, Shuttle
from fake_culture import FakeCulture
from test_closed_loop import loop_of
from test_interventions import linear_networks

POOL_HZ = np.array([1.5, 2.5, 3.5, 60.0])
POLICIES = {"p0": AnyCondition(5), "p1": OneCondition(3)}
ROBOT = Shuttle(episode_limit=12)
SIMULATOR = synthetic_simulator()


def changed(robot: Robot[Any]) -> list[Agent]:
    """The interventions that involve a culture, as agents."""
    environment, networks = Animat(robot, Thresholds(1), 5), linear_networks(np.zeros((len(robot.observation_spec), 5)))
    found = interventions_of(environment, SIMULATOR, networks, switch_at=5)
    asked = ("random spikes", "yoked", "turned round", "goal switched")
    return [agent_of(each, environment, POLICIES, POOL_HZ) for each in found if each.name in asked]


def test_what_moves_the_robot_without_responses_is_no_agent_of_a_loop() -> None:
    environment, networks = Animat(ROBOT, Thresholds(1), 5), linear_networks(np.zeros((len(ROBOT.observation_spec), 5)))
    ideal = interventions_of(environment, SIMULATOR, networks)[0]
    with pytest.raises(InvalidArgument, match="expected one whose commands come from responses, got ideal actuator"):
        agent_of(ideal, environment, POLICIES, POOL_HZ)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    agents = [Agent(name, "as trained", who) for name, who in POLICIES.items()]
    agents += changed(ROBOT)
    with FakeCulture() as culture:
        return run_session(culture, loop_of(robot=ROBOT), agents, tmp_path_factory.mktemp("loop"), episodes=6, seed=2)


def ticks_of(session: Session, agent: str) -> list[list[Tick]]:
    """Of each episode of an agent, without its warm-up."""
    numbers = [episode.number for episode in session.episodes if episode.agent == agent]
    return [[t for t in session.ticks if t.episode == number and t.iteration >= 0] for number in numbers]


def test_random_spikes_are_recorded_responses_and_no_pulses(session: Session) -> None:
    ticks = [tick for episode in ticks_of(session, "random spikes") for tick in episode]
    assert len(ticks) == 72 and not any(tick.pulse_time_s for tick in ticks)
    assert {tick.rate_hz for tick in ticks} == set(POOL_HZ)
    decoder, percentiles = loop_of(robot=ROBOT).decoder, loop_of(robot=ROBOT).percentiles
    wanted = [float(decoder.command(np.float32(tick.rate_hz), percentiles)) for tick in ticks]
    assert [tick.command for tick in ticks] == wanted


def test_a_burst_of_the_culture_is_none_of_the_response_that_is_drawn_in_its_place() -> None:
    channels, drawn = FakeCulture().channels, np.array([7.5])
    # One spike on each of 16 channels, in 8 ms. No response is a burst at a threshold of 1.
    stretch = Stretch(0, 0.0, 0.02, np.full(16, 0.006), np.arange(16), channels, np.empty(0))
    for threshold, drawn_from, hz, is_burst in (
        (0.9, None, 125.0, True),
        (1, None, 125.0, False),
        (0.9, drawn, 7.5, False),
    ):
        loop, rng = loop_of(burst_threshold=threshold), np.random.default_rng(1)
        members = loop.readouts.members(channels)
        x_hz, tick = read_response(loop, drawn_from, stretch, members, np.zeros(1), rng)
        assert (float(x_hz), tick["rate_hz"], tick["is_burst"]) == (hz, hz, is_burst)
        assert (tick["spikes"], tick["active_ratio"], tick["readout_hz"]) == (16, 1.0, ())


@pytest.mark.oracle
def test_yoked_stimuli_are_those_of_a_policy_s_episode_before(session: Session, tmp_path: Path) -> None:
    # A cartpole may stay upright for longer than in the episode that is repeated.
    agents = [Agent("p0", "as trained", POLICIES["p0"]), *(a for a in changed(Cartpole()) if a.name == "yoked")]
    with FakeCulture() as culture:
        longer = run_session(culture, loop_of(robot=Cartpole()), agents, tmp_path, episodes=6, seed=1)
    lengths = []
    for each in (session, longer):
        of_policies = {e.number: [t.delivered for t in each.ticks if t.episode == e.number and t.iteration >= 0]
                       for e in each.episodes if e.agent in POLICIES}  # fmt: skip
        found = ticks_of(each, "yoked")
        assert len(found) == 6
        for ticks in found:
            source = of_policies[max(number for number in of_policies if number < ticks[0].episode)]
            assert [tick.delivered for tick in ticks] == [source[i % len(source)] for i in range(len(ticks))]
            assert all(tick.pulse_time_s for tick in ticks)
            lengths.append((len(source), len(ticks), len({*source})))
        assert any(tick.delivered != tick.chosen for ticks in found for tick in ticks)
    assert any(ticks > source and conditions > 1 for source, ticks, conditions in lengths)


def test_turned_round_every_command_is_the_opposite(session: Session) -> None:
    loop = loop_of(robot=ROBOT)
    for agent, sign in (("turned round", -1), ("p0", 1)):
        for tick in (tick for episode in ticks_of(session, agent) for tick in episode):
            assert tick.command == sign * float(loop.decoder.command(np.float32(tick.rate_hz), loop.percentiles))


def test_a_goal_is_switched_once_to_that_of_another_start(session: Session) -> None:
    cues = [[tick.observation[2] for tick in ticks] for ticks in ticks_of(session, "goal switched")]
    starts = [e.start[2] for e in session.episodes if e.agent == "goal switched"]
    assert all(cue[:4] == [start] * 4 for cue, start in zip(cues, starts, strict=True))
    assert all(len(set(cue[4:])) == 1 for cue in cues)
    # Another start has the same cue half of the time: find one with the other cue.
    assert all(cue[3] != cue[4] for cue in cues)
    for name in ("p0", "yoked"):
        assert all(len({t.observation[2] for t in ticks}) == 1 for ticks in ticks_of(session, name))


def test_a_robot_with_one_goal_has_none_switched_and_yoked_ones_need_a_source(tmp_path: Path) -> None:
    agents = changed(Cartpole())
    assert [agent.name for agent in agents] == ["random spikes", "yoked", "turned round"]
    # Neither names of others nor a controller without a name has episodes.
    for yoked in (agents, [Agent("p0", "", AnyCondition(5)), Agent("yoked", "", AnyCondition(5), "yoked")]):
        with (
            FakeCulture() as culture,
            pytest.raises(InvalidArgument, match="expected episodes for 'yoked' to repeat, got none"),
        ):
            run_session(culture, loop_of(), yoked, tmp_path, episodes=1)


def test_controls_of_a_simulator_are_agents_of_a_loop() -> None:
    environment = Animat(Cartpole(), Thresholds(1), 5)
    networks = linear_networks(np.zeros((4, 5)))
    found = controls_of(environment, SIMULATOR, list("abcde"), networks)
    agents = {each.name: agent_of(each, environment, POLICIES, POOL_HZ) for each in found}
    assert [*agents] == ["random", *(f"constant {x}" for x in "abcde"), "heuristic", "silent", "shuffled"]
    rng = np.random.default_rng(1)
    seen = np.array([0.0, 0.0, 0.05, 0.0])
    assert [agents[f"constant {x}"].controller.act(seen, rng) for x in "abcde"] == [0, 1, 2, 3, 4]
    assert [agents["heuristic"].controller.act(sign * seen, rng) for sign in (1, -1)] == [4, 0]
    for name in ("silent", "shuffled"):
        assert agents[name].controller == POLICIES
        assert agents[name].delivery == name
    # Whoever repeats stimuli, or those of another episode, gets other responses than mixed stimuli do.
    assert [name for name, agent in agents.items() if not agent.calibrates] == [f"constant {x}" for x in "abcde"]
    assert [agent.name for agent in changed(ROBOT) if not agent.calibrates] == ["yoked"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Drawing(Actor):
    """Condition 4 in so many cases, else condition 1."""

    share: Any

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return jnp.where(uniforms[:, 0] < self.share, 4, 1)


def test_an_actor_s_draws_leave_the_other_draws_of_a_loop_as_they_are() -> None:
    acts = ActorController(Drawing(jnp.array([0.25])), Animat(Cartpole(), Thresholds(1), 5))
    rng, alone = np.random.default_rng(1), np.random.default_rng(1)
    chosen = np.array([acts.act(np.zeros(4), rng) for _ in range(2000)])
    assert set(chosen) == {1, 4} and abs(np.mean(chosen == 4) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 2000)
    assert rng.random() == alone.random()
    # The same seed draws the same.
    again = np.random.default_rng(1)
    assert [acts.act(np.zeros(4), again) for _ in range(50)] == chosen[:50].tolist()
