"""Robots that are moved one step at a time, outside of a compiled loop, in JAX or on the host."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8
from numpy.typing import ArrayLike

from animat.errors import InvalidArgument
from animat.lazy import jax, jnp
from animat.robots.base import Robot, capability
from animat.robots.host import Bodies, HostRobot
from animat.robots.starts import Starts, robot_generator
from animat.wrappers import other_goal

_FEWEST_STARTS = 10
"""Fewest starts that show whether a robot always starts alike."""


class Moved(NamedTuple):
    """The result of a step, in the robot's own units.

    `truncated`: the robot itself cut the episode off; at its `episode_limit` the caller does.
    """

    reward: float
    terminated: bool
    observation: Float64[np.ndarray, " observations"]
    truncated: bool = False


@lru_cache(maxsize=8)
def _compiled(robot: Robot[Any]) -> tuple[Callable[..., Any], ...]:
    """A step, a start, and another goal: compiled once for all runners of a robot."""

    def stepped(uniforms: Any, state: Any, u: Any) -> tuple[Any, Any]:
        after, reward, terminated = robot.advance(uniforms, state, u)
        # One array: waiting for each of three takes longer than the step itself.
        return after, jnp.concatenate([jnp.stack([reward, terminated]), robot.observe(after)])

    def started(key: Any, number: int) -> tuple[Any, Any]:
        state = robot.reset(jax.random.fold_in(key, number))
        return state, robot.observe(state)

    def switched(key: Any, number: int, state: Any) -> tuple[Any, Any]:
        other = other_goal(robot, state, jax.random.fold_in(key, number))
        after = capability(robot, "with_goal_of")(state, other)
        return after, robot.observe(after)

    return jax.jit(stepped), jax.jit(started), jax.jit(switched)


class RobotRunner:
    """A robot with its state; its step is compiled once, in advance, and takes some 30 us.

    The generator draws the robot's noise, and the starts of its episodes.
    """

    def __init__(self, robot: Robot[Any], rng: np.random.Generator) -> None:
        self.robot, self._rng = robot, rng
        self._step, self._start, self._switch = _compiled(robot)
        self._key = jax.random.key(int(rng.integers(2**31)))
        # Other goals come from starts that no episode has.
        self._goals = jax.random.split(self._key)[1]
        # Compile now: in the middle of an episode it would take some hundred milliseconds.
        self.reset(0)
        self.step(np.zeros(robot.command_shape))

    def reset(self, number: int) -> Float64[np.ndarray, " observations"]:
        """Start an episode where the robot draws it, in the same state for the same number; returns the observation."""
        self._state, observation = self._start(self._key, number)
        return np.asarray(observation, np.float64)

    def step(self, u: ArrayLike) -> Moved:
        """Move by one or several commands in [-1, 1]."""
        uniforms = self._rng.random(self.robot.noise_size, dtype=np.float32)
        self._state, stepped = self._step(uniforms, self._state, np.asarray(u, np.float32))
        stepped = np.asarray(stepped, np.float64)
        return Moved(float(stepped[0]), bool(stepped[1]), stepped[2:])

    def switch_goal(self, number: int) -> Float64[np.ndarray, " observations"]:
        """Give the robot the goal of another start, the same for the same number; returns the observation."""
        self._state, observation = self._switch(self._goals, number, self._state)
        return np.asarray(observation, np.float64)


class HostRunner:
    """A robot that is stepped outside JAX, with its state; arguments and methods as for `RobotRunner` and `Bodies`."""

    def __init__(self, robot: Robot[Any], rng: np.random.Generator, *, with_pictures: bool = False) -> None:
        assert isinstance(robot, HostRobot)
        self._entropy = int(rng.integers(2**31))
        self._bodies = Bodies(robot, [(self._entropy, 0)], with_pictures=with_pictures)
        # Whatever it loads on its first move would delay an episode.
        self.reset(0)
        self.step(np.zeros(robot.n_commands))

    def reset(self, number: int) -> Float64[np.ndarray, " observations"]:
        self._bodies.reseed([(self._entropy, number)])
        return np.asarray(self._bodies.begin()[0], np.float64)

    def step(self, u: ArrayLike) -> Moved:
        stepped = self._bodies.step(np.asarray(u, np.float32).reshape(1, -1))
        (reward,), (terminated,), (truncated,) = stepped.reward, stepped.terminated, stepped.truncated
        return Moved(float(reward), bool(terminated), stepped.observation[0].astype(np.float64), bool(truncated))

    def switch_goal(self, number: int) -> Float64[np.ndarray, " observations"]:
        """Raise InvalidArgument: the goal of a host robot cannot be switched."""
        raise InvalidArgument(f"robot: expected one whose goal can be switched, got {self._bodies.robot.name}")

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """A picture of the robot now; None if it draws none."""
        return self._bodies.picture()


def starts_of(robot: Robot[Any], seed: int, rounds: int) -> Starts | None:
    """The starts of a session's rounds; None if all are alike, and would be in further rounds too."""
    runner = runner_of(robot, robot_generator(seed))
    seen = [runner.reset(number) for number in range(max(rounds, _FEWEST_STARTS))]
    return Starts.of_session(seed, rounds) if np.any(np.ptp(seen, axis=0) > 0) else None


def runner_of(robot: Robot[Any], rng: np.random.Generator) -> RobotRunner | HostRunner:
    """The runner of a robot, in JAX or on the host."""
    return HostRunner(robot, rng) if isinstance(robot, HostRobot) else RobotRunner(robot, rng)
