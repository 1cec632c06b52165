"""Interventions in a closed loop: each does what it says, seen in the log of a session, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from animat.closed_loop.agents import Agent, AnyCondition, OneCondition, interventions
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session
from animat.closed_loop.tick import Tick
from animat.errors import InvalidArgument
from animat.robots import Cartpole, Shuttle
from fake_culture import FakeCulture
from test_closed_loop import loop_of

POOL_HZ = np.array([1.5, 2.5, 3.5, 60.0])
POLICIES = {"p0": AnyCondition(5), "p1": OneCondition(3)}
ROBOT = Shuttle(episode_limit=12)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    agents = [Agent(name, "as trained", who) for name, who in POLICIES.items()]
    agents += interventions(ROBOT, POLICIES, POOL_HZ, switch_at=5)
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


def test_yoked_stimuli_are_those_of_a_policy_s_episode_before(session: Session) -> None:
    of_policies = {e.number: [t.delivered for t in session.ticks if t.episode == e.number and t.iteration >= 0]
                   for e in session.episodes if e.agent in POLICIES}  # fmt: skip
    found = ticks_of(session, "yoked")
    assert len(found) == 6
    for ticks in found:
        before = [number for number in of_policies if number < ticks[0].episode]
        assert [tick.delivered for tick in ticks] == of_policies[max(before)]
        assert all(tick.pulse_time_s for tick in ticks)
    assert any(tick.delivered != tick.chosen for ticks in found for tick in ticks)


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
    # Another start has the same cue half of the time: one that has not is looked for.
    assert all(cue[3] != cue[4] for cue in cues)
    for name in ("p0", "yoked"):
        assert all(len({t.observation[2] for t in ticks}) == 1 for ticks in ticks_of(session, name))


def test_a_robot_with_one_goal_has_none_switched_and_yoked_ones_need_a_source(tmp_path: Path) -> None:
    agents = interventions(Cartpole(), POLICIES, POOL_HZ, switch_at=5)
    assert [agent.name for agent in agents] == ["random spikes", "yoked", "turned round"]
    with (
        FakeCulture() as culture,
        pytest.raises(InvalidArgument, match="expected episodes that 'yoked' could repeat, got none"),
    ):
        run_session(culture, loop_of(), agents, tmp_path, episodes=1)
