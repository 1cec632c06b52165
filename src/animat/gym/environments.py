"""Animats as a Gymnasium environment, and as a vector of them that are stepped together.

The cost of a call into compiled code depends more on the number of arrays passed than on what is computed. So an
iteration takes and returns one row of 32-bit words per environment, which packs the state and the observation bit by
bit: float32 would round the large integers of a state, such as the data of a random key.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float32, Int64, UInt8, UInt32

from animat.environment import Environment, State
from animat.errors import InvalidArgument, expect_at_least, expect_kind, shown
from animat.goals.robot import RobotWithGoal, without_goal
from animat.gym.setup import set_up
from animat.robots.base import capability
from animat.robots.drawing import draw_robot

Rows = UInt32[np.ndarray, "environments words"]
Observations = Float32[np.ndarray, "environments observations"]
Actions = Int64[np.ndarray, " environments"]
Rewards = Float32[np.ndarray, " environments"]
Flags = Bool[np.ndarray, " environments"]


class _Functions(NamedTuple):
    """Of an environment, compiled: starts and steps, as rows; what is in rows; what episodes achieved of a goal."""

    start: Callable[..., Any]
    step: Callable[..., Any]
    read: Callable[[Rows], tuple[Any, Observations]]
    judge: Callable[..., Any] | None


class CompiledAnimats:
    """What both share: n Animats on numpy arrays, with all random numbers from a numpy generator.

    They are compiled at the first call, once for all environments of the same Animat.

    Raises:
        InvalidArgument: as `set_up` does, for an unknown render mode, or `rgb_array` for a robot that cannot be drawn.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - Gymnasium's name and form
    render_mode: str | None

    def __init__(self, n: int, robot: str, robot_of_id: str, render_mode: str | None, options: dict[str, Any]) -> None:
        if robot_of_id and robot not in ("", robot_of_id):
            named = f"none, as the id names the {robot_of_id}"
            raise InvalidArgument(f"robot: expected {named}, got {shown(robot)}: use Animat/Robot-v0")
        self.setup = set_up(robot or robot_of_id, **options)
        if render_mode not in (None, "rgb_array"):
            hint = "; gymnasium.make shows these pictures in a window, with pygame" if render_mode == "human" else ""
            raise InvalidArgument(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}{hint}")
        if render_mode is not None:
            capability(self.setup.environment.robot, "draw")
        self.render_mode = render_mode
        if not hasattr(self.setup.environment.robot, "draw"):
            self.metadata = {**self.metadata, "render_modes": []}
        if (step_s := getattr(without_goal(self.setup.environment.robot), "step_s", None)) is not None:
            # Films are then in real time.
            self.metadata = {**self.metadata, "render_fps": max(1, round(1 / step_s))}
        self._rows: Rows | None = None
        self._shown: list[list[Float32[np.ndarray, " observations"]]] = [[] for _ in range(n)]
        self._commands: Float32[np.ndarray, "environments *commands"]

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions are not pickled; they are compiled again after unpickling."""
        return {name: value for name, value in vars(self).items() if name != "_functions"}

    def _expect_started(self, method: str) -> Rows:
        if self._rows is None:
            raise gymnasium.error.ResetNeeded(f"{method}: expected an episode that reset() started, got none")
        return self._rows

    def _start(self, rng: np.random.Generator) -> Rows:
        """Rows of new episodes."""
        return np.asarray(self._functions.start(rng.integers(0, 2**32, len(self._shown), dtype=np.uint32)))

    def _step(self, rows: Rows, actions: Actions, rng: np.random.Generator) -> Rows:
        """Rows after an iteration of each."""
        n, noise_size = len(rows), self.setup.environment.noise_size
        inputs = np.empty((n, 1 + noise_size), np.float32)
        inputs[:, 0] = actions
        inputs[:, 1:] = rng.random((n, noise_size), np.float32)
        return np.asarray(self._functions.step(inputs, rows, self.setup.simulator))

    def _go_on_from(self, rows: Rows, begun: Flags) -> tuple[Any, Observations]:
        """Returns the `State` and the observations in the rows, as numpy copies, shape (environments, ...)."""
        self._rows, (state, observations) = rows, self._functions.read(rows)
        if self.render_mode is not None:
            self._commands = state.info["command"]
            # Copies, as the observations belong to the user.
            of_robot = observations[:, : len(self.setup.environment.robot.observation_spec)].copy()
            for i, observation in enumerate(of_robot):
                self._shown[i] = [observation] if begun[i] else [*self._shown[i], observation]
        return state, observations

    def _outcomes(self, after: State) -> dict[str, Any]:
        """What each episode that ended achieved of the robot's goal; empty without a goal, and if none ended."""
        judge = self._functions.judge
        if judge is None or not np.logical_or(*after.ended).any():
            return {}
        outcome = jax.device_get(judge(after.robot))
        return {"is_success": outcome.succeeded, "satisfaction": outcome.satisfaction, "margin": outcome.margin}

    def _pictures(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """Pictures of the robots as they are now; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn('render: expected render_mode="rgb_array" when the environment was created, got None')
            return None
        self._expect_started("render")
        return tuple(
            draw_robot(self.setup.environment.robot, now, command=u if u.ndim else float(u), earlier=earlier)
            for (*earlier, now), u in zip(self._shown, self._commands, strict=True)
        )

    @cached_property
    def _functions(self) -> _Functions:
        return _compiled(self.setup.environment)


@lru_cache(maxsize=64)
def _compiled(environment: Environment[Any]) -> _Functions:

    def with_observation(state: State) -> tuple[State, Array]:
        return state, environment.observe(state)

    template = with_observation(environment.reset(jax.random.key(0)))
    leaves, structure = jax.tree.flatten(jax.device_get(jax.tree.map(jnp.asarray, template)))
    ends = np.cumsum([leaf.size for leaf in leaves])
    # A bool or a number of fewer bits is held as a float32, which is exact.
    held = [leaf.dtype if leaf.dtype.itemsize == 4 else np.dtype(np.float32) for leaf in leaves]

    def pack(state: State) -> Array:
        parts = [
            jnp.ravel(leaf).astype(kind)
            for leaf, kind in zip(jax.tree.leaves(with_observation(state)), held, strict=True)
        ]
        return jnp.concatenate([jax.lax.bitcast_convert_type(part, jnp.uint32) for part in parts])

    def unpack(rows: Any, as_kind: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
        whole = {kind: as_kind(rows, kind) for kind in set(held)}
        parts = [
            whole[kind][..., end - leaf.size : end].reshape(*rows.shape[:-1], *leaf.shape).astype(leaf.dtype)
            for end, leaf, kind in zip(ends, leaves, held, strict=True)
        ]
        return jax.tree.unflatten(structure, parts)  # type: ignore[no-any-return]

    def start(seed: Array) -> Array:
        return pack(environment.reset(jax.random.key(seed)))

    def step(inputs: Array, row: Array, simulator: Any) -> Array:
        state, _ = unpack(row, jax.lax.bitcast_convert_type)
        return pack(environment.advance(inputs[1:], state, inputs[0].astype(jnp.int32), simulator))

    robot = environment.robot
    judge = jax.jit(jax.vmap(robot.outcome)) if isinstance(robot, RobotWithGoal) else None
    read = partial(unpack, as_kind=np.ndarray.view)
    return _Functions(jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step, (0, 0, None))), read, judge)


class AnimatEnv(CompiledAnimats, gymnasium.Env[Float32[np.ndarray, " observations"], np.int64]):
    """A robot moved by the responses of neurons; the action picks the stimulus.

    Observation: `Box`, what the robot sees, in the task's units (the learner scales). Action: `Discrete`, the index
    of the condition given to the neurons. Reward: the task's. `terminated` when the task ends by itself, `truncated` at
    the robot's `episode_limit`, never both.

    `info` of a step: `delivered`, the condition that reached the neurons; `rate_hz`, their response (Hz per channel);
    `command`, the motor command in [-1, 1] decoded from it. With several readouts the latter two are arrays. At the end
    of an episode with a goal also `is_success`, `satisfaction` (% of each objective) and `margin`.

    All random numbers come from the generator that `reset(seed=...)` seeds.

    Args:
        robot: its name, for `Animat/Robot-v0`.
        robot_of_id: the robot of any other id.
        render_mode: `rgb_array`, or None.
        options: mapping, neurons and the robot's parameters (see `animat.gym.setup.set_up`).
    """

    def __init__(
        self, robot: str = "", *, robot_of_id: str = "", render_mode: str | None = None, **options: Any
    ) -> None:
        super().__init__(1, robot, robot_of_id, render_mode, options)
        self.observation_space = self.setup.observation_space
        self.action_space = self.setup.action_space
        self._has_ended = self._was_warned = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32[np.ndarray, " observations"], dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        _, observations = self._go_on_from(self._start(self.np_random), np.ones(1, bool))
        self._has_ended = self._was_warned = False
        return observations[0], {}

    def step(self, action: np.int64) -> tuple[Float32[np.ndarray, " observations"], float, bool, bool, dict[str, Any]]:
        """Stimulate with the condition `action`, and move the robot by the response."""
        rows = self._expect_started("step")
        if not self.action_space.contains(action):
            last = len(self.setup.condition_labels) - 1
            raise InvalidArgument(f"action: expected a condition, a whole number from 0 to {last}, got {shown(action)}")
        if self._has_ended and not self._was_warned:
            gymnasium.logger.warn("step: the episode has ended: call reset(), as what follows has no meaning")
            self._was_warned = True
        rows = self._step(rows, np.array([action]), self.np_random)
        after, observations = self._go_on_from(rows, np.zeros(1, bool))
        # Python numbers for one readout, arrays for several.
        known = after.info | self._outcomes(after)
        info = {name: value[0] if value.ndim > 1 else value[0].item() for name, value in known.items()}
        terminated, truncated = (bool(each[0]) for each in after.ended)
        self._has_ended = self._has_ended or terminated or truncated
        return observations[0], float(after.reward[0]), terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """A picture of the robot as it is now, with `render_mode="rgb_array"`."""
        pictures = self._pictures()
        return None if pictures is None else pictures[0]


class AnimatVectorEnv(CompiledAnimats, VectorEnv[Observations, Actions, Rewards]):
    """`num_envs` independent Animats in one compiled call; each behaves as an `AnimatEnv`.

    An environment whose episode ended starts a new one in the next step (Gymnasium's `NEXT_STEP`): that step ignores
    its action, returns the first observation of the new episode, and gives reward 0. `info` holds the arrays
    `delivered`, `rate_hz` and `command`, each with a mask (`_delivered`, ...) that is False where a step only started
    an episode.

    Args:
        num_envs: the number of environments.
        robot, robot_of_id, render_mode, options: as in `AnimatEnv`, the same for all.
    """

    metadata = CompiledAnimats.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        robot: str = "",
        num_envs: int = 1,
        *,
        robot_of_id: str = "",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        expect_kind("num_envs", num_envs, int | np.integer, "a whole number")
        expect_at_least("num_envs", num_envs, 1)
        super().__init__(num_envs, robot, robot_of_id, render_mode, options)
        self.num_envs = num_envs
        self.single_observation_space = self.setup.observation_space
        self.single_action_space = self.setup.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended: Flags = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start all episodes from one seed; of the `options`, `reset_mask`, which would start only some, is refused."""
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
        for name, value in self._outcomes(after).items():
            info |= {name: value, f"_{name}": self._ended}
        return observations, after.reward, *after.ended, info

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """A picture of each robot as it is now, with `render_mode="rgb_array"`."""
        return self._pictures()
