"""A robot that is moved one step at a time, outside of any compiled loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

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


class Body:
    """A robot with its state; its step is compiled once, before the first one, and takes some 30 us.

    Args:
        robot: that is moved.
        rng: source of the robot's noise.
    """

    def __init__(self, robot: Robot[Any], rng: np.random.Generator) -> None:
        import jax

        def stepped(uniforms: Any, state: Any, u: Any) -> tuple[Any, Any, Any, Any]:
            after, reward, terminated = robot.advance(uniforms, state, u)
            return after, reward, terminated, robot.observe(after)

        self.robot, self._rng = robot, rng
        self._step = jax.jit(stepped)
        self._start = jax.device_get(robot.reset(jax.random.key(int(rng.integers(2**31)))))
        self._seen_at_start = np.asarray(robot.observe(self._start), np.float64)
        self._state = self._start
        # Compiled now: in the middle of an episode it would cost some hundred milliseconds.
        self.step(0.0)
        self.reset()

    def reset(self) -> Float64[np.ndarray, " observations"]:
        """Start an episode; returns what is observed."""
        self._state = self._start
        return self._seen_at_start

    def step(self, u: float) -> Moved:
        """Move by a command in [-1, 1]."""
        uniforms = self._rng.random(self.robot.noise_size, dtype=np.float32)
        self._state, reward, terminated, observation = self._step(uniforms, self._state, np.float32(u))
        return Moved(float(reward), bool(terminated), np.asarray(observation, np.float64))
