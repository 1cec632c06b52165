"""A robot that is moved one step at a time, outside of any compiled loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from animat.robots.base import Robot


class Moved(NamedTuple):
    """What a step did.

    Attributes:
        reward: in the task's own units.
        terminated: the task ended by itself.
        observation: after the step, in the robot's own units.
    """

    reward: float
    terminated: bool
    observation: Float64[np.ndarray, " observations"]


class RobotRunner:
    """A robot with its state; its step is compiled once, before the first one, and takes some 30 us.

    Args:
        robot: that is moved.
        rng: source of the robot's noise, and of where its episodes start.
    """

    def __init__(self, robot: Robot[Any], rng: np.random.Generator) -> None:
        import jax

        def stepped(uniforms: Any, state: Any, u: Any) -> tuple[Any, Any, Any, Any]:
            after, reward, terminated = robot.advance(uniforms, state, u)
            return after, reward, terminated, robot.observe(after)

        def started(key: Any, number: int) -> tuple[Any, Any]:
            state = robot.reset(jax.random.fold_in(key, number))
            return state, robot.observe(state)

        self.robot, self._rng = robot, rng
        self._step, self._start = jax.jit(stepped), jax.jit(started)
        self._key = jax.random.key(int(rng.integers(2**31)))
        # Compiled now: in the middle of an episode it would cost some hundred milliseconds.
        self.reset(0)
        self.step(np.zeros(() if robot.n_commands == 1 else robot.n_commands))

    def reset(self, number: int) -> Float64[np.ndarray, " observations"]:
        """Start an episode where the robot draws it; returns what is observed.

        Args:
            number: the same number starts in the same state.
        """
        self._state, observation = self._start(self._key, number)
        return np.asarray(observation, np.float64)

    def step(self, u: ArrayLike) -> Moved:
        """Move by a command in [-1, 1], or by several."""
        uniforms = self._rng.random(self.robot.noise_size, dtype=np.float32)
        self._state, reward, terminated, observation = self._step(uniforms, self._state, np.asarray(u, np.float32))
        return Moved(float(reward), bool(terminated), np.asarray(observation, np.float64))
