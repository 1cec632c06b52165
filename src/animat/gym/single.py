"""One Animat as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float32, UInt8

from animat.errors import InvalidArgument, shown
from animat.gym.compiled import CompiledAnimats


class AnimatEnv(CompiledAnimats, gymnasium.Env[Float32[np.ndarray, " observations"], np.int64]):
    """A robot moved by the responses of neurons; the action picks the stimulus.

    Observation: `Box`, what the robot sees, in the task's units (the learner scales). Action: `Discrete`, the index
    of the condition given to the neurons. Reward: the task's. `terminated` when the task ends by itself, `truncated` at
    the robot's `episode_limit`, never both.

    `info` of a step: `delivered`, the condition that reached the neurons; `rate_hz`, their response (Hz per channel);
    `command`, the motor command in [-1, 1] decoded from it. With several readouts the latter two are arrays.

    All random numbers come from the generator that `reset(seed=...)` seeds.

    Args:
        robot: its name; set by the environment's id.
        render_mode: `rgb_array`, or None.
        options: mapping, neurons and the robot's parameters (see `animat.gym.setup.set_up`).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - Gymnasium's name and form

    def __init__(self, robot: str = "", *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__(1, robot, render_mode, options)
        self.observation_space = self.setup.observation_space
        self.action_space = self.setup.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32[np.ndarray, " observations"], dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        _, observations = self._go_on_from(self._start(self.np_random), np.ones(1, bool))
        return observations[0], {}

    def step(self, action: np.int64) -> tuple[Float32[np.ndarray, " observations"], float, bool, bool, dict[str, Any]]:
        """Stimulate with the condition `action`, and move the robot by the response."""
        rows = self._expect_started("step")
        if not self.action_space.contains(action):
            last = len(self.setup.condition_labels) - 1
            raise InvalidArgument(f"action: expected a condition, a whole number from 0 to {last}, got {shown(action)}")
        rows = self._step(rows, np.array([action]), self.np_random)
        after, observations = self._go_on_from(rows, np.zeros(1, bool))
        # Python numbers; arrays with several readouts.
        info = {name: value[0] if value.ndim > 1 else value[0].item() for name, value in after.info.items()}
        terminated, truncated = (bool(each[0]) for each in after.ended)
        return observations[0], float(after.reward[0]), terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """A picture of the robot as it is now, with `render_mode="rgb_array"`."""
        pictures = self._pictures()
        return None if pictures is None else pictures[0]
