"""One Animat as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float32, UInt8

from animat.errors import InvalidArgument, shown
from animat.gym.compiled import CompiledAnimat
from animat.gym.setup import set_up
from animat.robots.base import Robot, capability
from animat.robots.drawing import draw_robot


class AnimatEnv(gymnasium.Env[Float32[np.ndarray, " observations"], np.int64]):
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
        self.setup = set_up(robot, **options)
        check_render_mode(render_mode, self.setup.environment.robot)
        self.render_mode = render_mode
        self.observation_space = self.setup.observation_space
        self.action_space = self.setup.action_space
        self._compiled = CompiledAnimat(self.setup)
        self._states: Float32[np.ndarray, "1 numbers"] | None = None
        self._shown: list[Float32[np.ndarray, " observations"]] = []
        self._command: float | Float32[np.ndarray, " commands"] = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32[np.ndarray, " observations"], dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        self._states = self._compiled.start(1, self.np_random)
        _, observations = self._compiled.read(self._states)
        self._shown, self._command = [], 0.0
        self._show(observations[0])
        return observations[0], {}

    def step(self, action: np.int64) -> tuple[Float32[np.ndarray, " observations"], float, bool, bool, dict[str, Any]]:
        """Stimulate with the condition `action`, and move the robot by the response."""
        if self._states is None:
            raise gymnasium.error.ResetNeeded("step: expected an episode that reset() started, got none")
        if not self.action_space.contains(action):
            last = len(self.setup.condition_labels) - 1
            raise InvalidArgument(f"action: expected a condition, a whole number from 0 to {last}, got {shown(action)}")
        self._states = self._compiled.step(self._states, np.array([action]), self.np_random)
        after, observations = self._compiled.read(self._states)
        # Python numbers; arrays with several readouts.
        info = {name: value[0] if value.ndim > 1 else value[0].item() for name, value in after.info.items()}
        self._command = info["command"]
        self._show(observations[0])
        terminated, truncated = (bool(each[0]) for each in after.ended)
        return observations[0], float(after.reward[0]), terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """A picture of the robot as it is now, with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: expected render_mode="rgb_array" when the environment was created, got None')
            return None
        if not self._shown:
            raise gymnasium.error.ResetNeeded("render: expected an episode that reset() started, got none")
        *earlier, now = self._shown
        return draw_robot(self.setup.environment.robot, now, command=self._command, earlier=earlier)

    def _show(self, observation: Float32[np.ndarray, " observations"]) -> None:
        """Keep the robot's numbers for pictures; a copy, as the observation belongs to the user."""
        if self.render_mode is not None:
            self._shown.append(observation[: len(self.setup.environment.robot.observation_spec)].copy())


def check_render_mode(render_mode: str | None, robot: Robot[Any]) -> None:
    """Refuse a render mode other than None and `rgb_array`, and `rgb_array` for a robot that cannot be drawn.

    Raises:
        InvalidArgument: naming the mode, or the robot.
    """
    if render_mode not in (None, "rgb_array"):
        hint = "; gymnasium.make shows these pictures in a window, with pygame" if render_mode == "human" else ""
        raise InvalidArgument(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}{hint}")
    if render_mode is not None:
        capability(robot, "draw")
