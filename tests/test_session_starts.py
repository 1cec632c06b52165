"""A session's starts are known before it; episodes on simulators, and optimal returns, can have the same."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.closed_loop.runner import runner_of, starts_of
from animat.coding.mapping import Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.evaluation.controls import Control
from animat.evaluation.optimum import optimal_values
from animat.evaluation.rollouts import Constant, Uniform, roll_out
from animat.neurons.synthetic import synthetic_simulator
from animat.reality_gap.predicting import pool, predict_agents
from animat.robots import Cartpole, Navigation, Robot, robot_named
from animat.robots.base import Quantity, Transition
from animat.robots.grid import Grid, grid_for
from animat.robots.shuttle import Shuttle, ShuttleState
from animat.robots.starts import Starts, robot_generator
from animat.robots.swing_up import SwingUp
from animat.robots.wheels import Wheels
from animat.wrappers import _GOAL, GoalSwitch, ShuffledDelivery


@dataclass(frozen=True)
class Drawn(Robot[Any]):
    """Starts anywhere, stays there, and is rewarded by where it is."""

    name: ClassVar[str] = "drawn"
    episode_limit: int = 4

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("position", "m", 1.0),)

    def reset(self, key: Any) -> Any:
        return jax.random.uniform(key)

    def advance(self, uniforms: Any, state: Any, u: Any) -> Transition[Any]:
        return state, state, jnp.bool_(False)

    def observe(self, state: Any) -> Any:
        return state[None]


@pytest.mark.parametrize("episodes", [pytest.param(7, marks=pytest.mark.oracle), 70])
def test_episodes_start_where_those_of_a_session_will(episodes: int) -> None:
    """70 do not run side by side on the host. The loop's own runner is what says where it starts."""
    starts = Starts.of_session(5, 3)
    runner = runner_of(Drawn(), robot_generator(5))
    loop = np.array([runner.reset(number)[0] for number in range(3)])
    environment = ShuffledDelivery(Animat(Drawn(), Thresholds(1), 5))
    simulator = synthetic_simulator()
    returns = roll_out(environment, simulator, Uniform(), episodes=episodes, seed=1, starts=starts).returns
    np.testing.assert_allclose(returns[0], 4 * loop[np.arange(episodes) % 3], rtol=1e-6)
    other = roll_out(environment, simulator, Uniform(), episodes=episodes, seed=1).returns
    assert len(np.unique(other)) == episodes


@pytest.mark.parametrize("episodes", [7, 70])
def test_bodies_outside_jax_start_where_those_of_a_session_will(episodes: int) -> None:
    robot = robot_named("gymnasium:bodies_of_others:Slider-v0", gain=0.0, episode_limit=4)
    runner, starts = runner_of(robot, robot_generator(5)), Starts.of_session(5, 3)
    loop = np.array([runner.reset(number)[0] for number in range(3)])
    environment = WithoutNeurons(robot, (-1.0, 1.0))
    returns = roll_out(environment, None, Uniform(), episodes=episodes, seed=1, starts=starts).returns
    np.testing.assert_allclose(returns[0], -4 * np.abs(loop[np.arange(episodes) % 3]), rtol=1e-5)
    assert starts_of(robot, 5, 3) == starts


@dataclass(frozen=True)
class Lasting(Drawn):
    """Lasts the longer, the further out it starts: one to four iterations."""

    name: ClassVar[str] = "lasting"

    def reset(self, key: Any) -> Any:
        return jnp.stack([jax.random.uniform(key), jnp.float32(0)])

    def advance(self, uniforms: Any, state: Any, u: Any) -> Transition[Any]:
        return state + jnp.array([0.0, 1.0]), jnp.float32(1), state[1] >= jnp.floor(4 * state[0])

    def observe(self, state: Any) -> Any:
        return state[:1]


def test_what_is_presented_is_predicted_from_each_start() -> None:
    starts, simulator = Starts.of_session(5, 6), synthetic_simulator()
    lasts = [1 + int(4 * Lasting().reset(key)[0]) for key in starts.of_episodes(6)]
    assert len(set(lasts)) > 2
    calibration: Any = SimpleNamespace(simulator=simulator, bootstraps=[simulator] * 2)
    environment = Animat(Lasting(), Thresholds(1), 5)
    policies = Control("policies", "", Constant(jnp.array([1, 3])))
    predicted = predict_agents(policies, ("p0", "p1"), [], environment, calibration, starts=starts)
    for name, condition in (("p0", 1), ("p1", 3)):
        for number, n in enumerate(lasts):
            assert predicted[name].of_start(number).presented.tolist() == [n * (i == condition) for i in range(5)]
        assert predicted[name].presented[condition] == pytest.approx(np.mean(lasts))
    both = pool([predicted["p0"].of_start(2), predicted["p1"].of_start(2)])
    assert both.presented.tolist() == [0, lasts[2] / 2, 0, lasts[2] / 2, 0]


def test_it_is_known_whether_starts_differ() -> None:
    """Also where a session has only one round: then its start is still one of many."""
    for robot in (Cartpole(), Navigation(), SwingUp()):
        assert starts_of(robot, 1, 5) is None
    for robot in (Shuttle(), Wheels(), Drawn()):
        assert starts_of(robot, 1, 5) == Starts.of_session(1, 5) != Starts.of_session(2, 5)
        assert starts_of(robot, 1, 1) == Starts.of_session(1, 1)


def test_without_different_starts_returns_are_the_same_to_the_bit() -> None:
    environment, simulator = Animat(Cartpole(), Thresholds(1), 5), synthetic_simulator()
    one, other = (
        roll_out(environment, simulator, Uniform(), episodes=20, seed=3, starts=starts).returns
        for starts in (None, Starts.of_session(1, 5))
    )
    np.testing.assert_array_equal(one, other)


def test_a_switched_goal_is_still_another_one() -> None:
    environment = GoalSwitch(Animat(Shuttle(episode_limit=10), Thresholds(1), 5), 5)
    starts = Starts.of_session(4, 4)
    states = [environment.reset(key) for key in starts.of_episodes(4)]
    assert all(state.robot.cue == -state.info[_GOAL].cue for state in states)


@dataclass(frozen=True)
class Placed(Robot[ShuttleState]):
    """The shuttle, which starts at a drawn or a given place."""

    name: ClassVar[str] = "placed"
    baseline_commands: ClassVar[tuple[float, ...]] = (-1.0, 1.0)
    episode_limit: int = 12
    at_m: float | None = None

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return Shuttle().observation_spec

    def reset(self, key: Any) -> ShuttleState:
        at_m = jax.random.uniform(key, minval=-0.4, maxval=0.4) if self.at_m is None else jnp.float32(self.at_m)
        return ShuttleState(at_m, jnp.float32(0.0), jnp.float32(1.0))

    def advance(self, uniforms: Any, state: ShuttleState, u: Any) -> Transition[ShuttleState]:
        return Shuttle().advance(uniforms, state, u)

    def observe(self, state: ShuttleState) -> Any:
        return Shuttle().observe(state)

    def value_grid(self) -> Grid:
        return Shuttle().value_grid()


@pytest.mark.oracle
def test_the_optimal_return_is_that_of_the_sessions_starts() -> None:
    """The mean of what robots return that always start at one of them."""

    def optimum(robot: Placed, starts: Starts | None) -> float:
        case = WithoutNeurons(robot, robot.baseline_commands), None
        return float(optimal_values([case], grid_for(robot), 1, starts=starts)[0][0])

    starts = Starts.of_session(9, 3)
    places_m = [float(Placed().reset(key).position_m) for key in starts.of_episodes(3)]
    each = [optimum(Placed(at_m=at_m), None) for at_m in places_m]
    assert np.ptp(each) > 2
    assert optimum(Placed(), starts) == pytest.approx(np.mean(each), abs=1e-3)
    assert abs(optimum(Placed(), None) - np.mean(each)) > 0.1
