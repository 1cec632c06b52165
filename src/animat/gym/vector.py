"""Many Animats, stepped together, as a Gymnasium vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float32, Int64, UInt8

from animat.errors import InvalidArgument, expect_at_least, expect_kind
from animat.gym.compiled import CompiledAnimats, Observations

Actions = Int64[np.ndarray, " environments"]
Rewards = Float32[np.ndarray, " environments"]
Flags = Bool[np.ndarray, " environments"]


class AnimatVectorEnv(CompiledAnimats, VectorEnv[Observations, Actions, Rewards]):
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
        expect_at_least("num_envs", num_envs, 1)
        super().__init__(num_envs, robot, render_mode, options)
        self.num_envs = num_envs
        self.single_observation_space = self.setup.observation_space
        self.single_action_space = self.setup.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended: Flags = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start all episodes from one seed; `options` are not used.

        Raises:
            InvalidArgument: for Gymnasium's `reset_mask`, which would start only some of them.
        """
        if options and "reset_mask" in options:
            raise InvalidArgument("options: expected no 'reset_mask': all episodes are started together")
        super().reset(seed=seed)
        _, observations = self._go_on_from(self._start(self.np_random), np.ones(self.num_envs, bool))
        self._ended = np.zeros(self.num_envs, bool)
        return observations, {}

    def step(self, actions: Actions) -> tuple[Observations, Rewards, Flags, Flags, dict[str, Any]]:
        """One iteration of each environment, or the start of a new episode where the last one ended."""
        rows, actions = self._expect_started("step"), np.asarray(actions)
        n_conditions = len(self.setup.condition_labels)
        expected = f"actions: expected {self.num_envs} conditions, whole numbers from 0 to {n_conditions - 1}"
        if not np.issubdtype(actions.dtype, np.integer) or actions.shape != (self.num_envs,):
            raise InvalidArgument(f"{expected}, got an array of {actions.dtype}, shape {actions.shape}")
        if (is_none := (actions < 0) | (actions >= n_conditions)).any():
            raise InvalidArgument(f"{expected}, got {actions[is_none][0]} for environment {is_none.argmax()}")
        rows, begun = self._step(rows, actions, self.np_random), self._ended
        if begun.any():
            rows = np.where(begun[:, None], self._start(self.np_random), rows)
        after, observations = self._go_on_from(rows, begun)
        self._ended = np.logical_or(*after.ended)
        info = after.info | {"delivered": after.info["delivered"].astype(np.int64)}
        info |= {f"_{name}": ~begun for name in info}
        return observations, after.reward, *after.ended, info

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """A picture of each robot as it is now, with `render_mode="rgb_array"`."""
        return self._pictures()
