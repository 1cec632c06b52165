"""Many Animats, stepped together, as a Gymnasium vector environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float32, Int64, UInt8

from animat.errors import InvalidArgument, expect_kind
from animat.gym.compiled import CompiledAnimat, Rows
from animat.gym.setup import set_up
from animat.gym.single import check_render_mode
from animat.robots.drawing import draw_robot


class AnimatVectorEnv(VectorEnv[Rows, Int64[np.ndarray, " environments"], Float32[np.ndarray, " environments"]]):
    """`num_envs` independent Animats in one compiled call; each behaves as an `AnimatEnv`.

    An environment whose episode ended starts a new one in the next step (Gymnasium's `NEXT_STEP`): that step ignores
    its action, returns the first observation of the new episode, and gives reward 0. `info` holds the arrays
    `delivered`, `rate_hz` and `command`, each with a mask (`_delivered`, ...) that is False where a step only started
    an episode.

    Args:
        robot: its name; set by the environment's id.
        num_envs: the number of environments.
        render_mode: `rgb_array`, or None.
        options: as in `AnimatEnv`, the same for all.
    """

    metadata = {  # noqa: RUF012 - Gymnasium's name and form
        "render_modes": ["rgb_array"],
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, robot: str = "", num_envs: int = 1, *, render_mode: str | None = None, **options: Any) -> None:
        expect_kind("num_envs", num_envs, int | np.integer, "a whole number")
        if num_envs < 1:
            raise InvalidArgument(f"num_envs: expected at least 1, got {num_envs}")
        self.setup = set_up(robot, **options)
        check_render_mode(render_mode, self.setup.environment.robot)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = self.setup.observation_space
        self.single_action_space = self.setup.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._compiled = CompiledAnimat(self.setup)
        self._states: Rows | None = None
        self._ended: Bool[np.ndarray, " environments"] = np.zeros(num_envs, bool)
        self._shown: list[list[Float32[np.ndarray, " observations"]]] = [[] for _ in range(num_envs)]
        n_commands = self.setup.environment.robot.n_commands
        self._at_rest = np.zeros(num_envs if n_commands == 1 else (num_envs, n_commands), np.float32)
        self._commands = self._at_rest

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Rows, dict[str, Any]]:
        """Start all episodes from one seed; `options` are not used.

        Raises:
            InvalidArgument: for Gymnasium's `reset_mask`, which would start only some of them.
        """
        if options and "reset_mask" in options:
            raise InvalidArgument("options: expected no 'reset_mask': all episodes are started together")
        super().reset(seed=seed)
        self._states = self._compiled.start(self.num_envs, self.np_random)
        _, observations = self._compiled.read(self._states)
        self._ended = np.zeros(self.num_envs, bool)
        self._show(observations, self._at_rest, np.ones(self.num_envs, bool))
        return observations, {}

    def step(
        self, actions: Int64[np.ndarray, " environments"]
    ) -> tuple[
        Rows,
        Float32[np.ndarray, " environments"],
        Bool[np.ndarray, " environments"],
        Bool[np.ndarray, " environments"],
        dict[str, Any],
    ]:
        """One iteration of each environment, or the start of a new episode where the last one ended."""
        if self._states is None:
            raise gymnasium.error.ResetNeeded("step: expected episodes that reset() started, got none")
        actions = np.asarray(actions)
        n_conditions = len(self.setup.condition_labels)
        expected = f"actions: expected {self.num_envs} conditions, whole numbers from 0 to {n_conditions - 1}"
        if not np.issubdtype(actions.dtype, np.integer) or actions.shape != (self.num_envs,):
            raise InvalidArgument(f"{expected}, got an array of {actions.dtype}, shape {actions.shape}")
        if (is_none := (actions < 0) | (actions >= n_conditions)).any():
            raise InvalidArgument(f"{expected}, got {actions[is_none][0]} for environment {is_none.argmax()}")
        states = self._compiled.step(self._states, actions, self.np_random)
        begun = self._ended
        if begun.any():
            states = np.where(begun[:, None], self._compiled.start(self.num_envs, self.np_random), states)
        self._states = states
        after, observations = self._compiled.read(states)
        self._ended = np.logical_or(*after.ended)
        info = after.info | {"delivered": after.info["delivered"].astype(np.int64)}
        info |= {f"_{name}": ~begun for name in info}
        self._show(observations, info["command"], begun)
        return observations, after.reward, *after.ended, info

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """A picture of each robot as it is now, with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: expected render_mode="rgb_array" when the environment was created, got None')
            return None
        if self._states is None:
            raise gymnasium.error.ResetNeeded("render: expected episodes that reset() started, got none")
        robot = self.setup.environment.robot
        return tuple(
            draw_robot(robot, shown[-1], command=u if np.ndim(u) else float(u), earlier=shown[:-1])
            for shown, u in zip(self._shown, self._commands, strict=True)
        )

    def _show(
        self,
        observations: Rows,
        commands: Float32[np.ndarray, "environments *commands"],
        begun: Bool[np.ndarray, " environments"],
    ) -> None:
        """Keep the robots' numbers for pictures; copies, as the observations belong to the user."""
        if self.render_mode is None:
            return
        self._commands = commands
        of_robot = len(self.setup.environment.robot.observation_spec)
        for i, observation in enumerate(observations[:, :of_robot].copy()):
            self._shown[i] = [observation] if begun[i] else [*self._shown[i], observation]
