"""Episodes of a closed loop start where the robot draws them, as in simulation; in a round, everyone's alike."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import kstest

from animat.closed_loop.agents import Agent
from animat.closed_loop.runner import RobotRunner
from animat.closed_loop.running import run_session
from animat.closed_loop.session import Session, read_session, recover_session
from animat.robots import Navigation, Robot
from animat.robots.base import Quantity
from animat.robots.navigation import NavigationState
from fake_culture import FakeCulture
from test_closed_loop import RANDOM, loop_of

if TYPE_CHECKING:
    from jax import Array

COURSE = Navigation()


@dataclass(frozen=True)
class Anywhere(Robot[NavigationState]):
    """A user's own robot, in no registry: navigation that starts anywhere, or `at` x, y and heading."""

    episode_limit: int = 4
    at: tuple[float, float, float] | None = None
    name: ClassVar[str] = "anywhere"
    noise_size: ClassVar[int] = 0
    paper_iterations: ClassVar[int] = 1000

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return COURSE.observation_spec

    def reset(self, key: Array) -> NavigationState:
        if self.at is not None:
            return NavigationState(*(jnp.float32(each) for each in self.at))
        x, y, heading = jax.random.uniform(key, (3,))
        return NavigationState(x, y, (2 * heading - 1) * np.pi)

    def advance(self, uniforms: Array, state: NavigationState, u: Array) -> tuple[NavigationState, Array, Array]:
        return COURSE.advance(uniforms, state, u)

    def observe(self, state: NavigationState) -> Array:
        return COURSE.observe(state)


@dataclass
class Looking:
    """Whoever acts and remembers what it saw first."""

    seen: list[tuple[float, ...]] = field(default_factory=list)

    def act(self, observation: Any, rng: np.random.Generator) -> int:
        self.seen.append(tuple(observation.tolist()))
        return int(rng.integers(5))


def starts_of(session: Session, agent: str) -> list[tuple[float, ...]]:
    return [episode.start for episode in session.episodes if episode.agent == agent]


def ran(folder: Path, seed: int, culture: int = 1) -> tuple[Session, Looking]:
    looking = Looking()
    agents = [
        Agent("p0", "", looking),
        RANDOM,
        Agent("silent", "", {"p0": looking, "p1": Looking()}, "silent"),
    ]
    with FakeCulture(culture) as fake:
        loop = loop_of(robot=Anywhere(), warm_up=1)
        return run_session(fake, loop, agents, folder, episodes=5, seed=seed), looking


def test_each_episode_starts_where_the_robot_draws_it(tmp_path: Path) -> None:
    session, looking = ran(tmp_path / "a", seed=3)
    assert session.ending.by == "plan"
    starts = starts_of(session, "p0")
    assert len(set(starts)) == 5
    # In a round policies and controls meet the same start.
    assert starts_of(session, "random") == starts_of(session, "silent") == starts
    # The start is what is acted by, and where the robot moves from.
    assert set(starts) <= set(looking.seen)
    for episode in session.episodes:
        first = next(t for t in session.ticks if t.episode == episode.number and t.iteration == 0)
        state = NavigationState(*np.array(episode.start, np.float32))
        after, _, _ = COURSE.advance(np.empty(0), state, np.float32(first.command))
        np.testing.assert_allclose(first.observation, COURSE.observe(after), atol=1e-6)
    # The seed decides, and the culture does not.
    assert starts_of(ran(tmp_path / "b", seed=3, culture=2)[0], "random") == starts
    assert not set(starts_of(ran(tmp_path / "c", seed=4)[0], "random")) & set(starts)


def test_the_starts_are_those_of_the_robots_own_distribution() -> None:
    runner = RobotRunner(Anywhere(), np.random.default_rng(1))
    starts = np.array([runner.reset(number) for number in range(400)])
    np.testing.assert_array_equal(runner.reset(7), starts[7])
    for column, (low, width) in zip(starts.T, ((0, 1), (0, 1), (-np.pi, 2 * np.pi)), strict=True):
        assert kstest(column, "uniform", (low, width)).pvalue > 1e-3


def test_a_robot_of_ones_own_is_recovered_with_its_starts(tmp_path: Path) -> None:
    session, _ = ran(tmp_path, seed=3)
    table = session.ticks_file.read_bytes()
    assert b",x_m,y_m,heading_rad," in table.splitlines()[0]
    session.ticks_file.unlink()
    session.recording_file.unlink()
    recovered = recover_session(tmp_path)
    assert recovered.ticks_file.read_bytes() == table
    assert recovered.recording_file.is_file()
    assert [e.start for e in read_session(tmp_path).episodes] == [e.start for e in session.episodes]


def test_a_robot_that_cannot_start_ends_the_session(tmp_path: Path) -> None:
    class Lost(Anywhere):
        def reset(self, key: Array) -> NavigationState:
            x, y, heading = super().reset(key)
            return NavigationState(x * np.nan, y, heading)

    with FakeCulture() as culture:
        session = run_session(culture, loop_of(robot=Lost()), [RANDOM], tmp_path, episodes=1)
        assert session.ending.by == "robot"
        assert "the robot starts at [nan, " in session.ending.message
        assert culture.pulses == 0
