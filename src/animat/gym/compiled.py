"""What one Gymnasium environment and a vector share: Animats stepped together in compiled code, and their pictures.

The cost of a call into compiled code depends more on the number of arrays passed than on what is computed. So an
iteration takes and returns one row of 32-bit words per environment, which packs the state and the observation bit by
bit: float32 would round the large integers of a state, such as the data of a random key.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int64, UInt8, UInt32

from animat.environment import Environment, State
from animat.errors import InvalidArgument
from animat.gym.setup import set_up
from animat.robots.base import capability
from animat.robots.drawing import draw_robot

Rows = UInt32[np.ndarray, "environments words"]
Observations = Float32[np.ndarray, "environments observations"]


class CompiledAnimats:
    """Some Animats on numpy arrays, with all random numbers from a numpy generator.

    They are compiled at the first call, once for all environments of the same Animat.

    Args:
        n: how many.
        robot, render_mode, options: of the environment (`animat.gym.single.AnimatEnv`).

    Raises:
        InvalidArgument: as `set_up` does, for an unknown render mode, or `rgb_array` for a robot that cannot be drawn.
    """

    render_mode: str | None

    def __init__(self, n: int, robot: str, render_mode: str | None, options: dict[str, Any]) -> None:
        self.setup = set_up(robot, **options)
        if render_mode not in (None, "rgb_array"):
            hint = "; gymnasium.make shows these pictures in a window, with pygame" if render_mode == "human" else ""
            raise InvalidArgument(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}{hint}")
        if render_mode is not None:
            capability(self.setup.environment.robot, "draw")
        self.render_mode = render_mode
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
        start, _, _ = self._functions
        return np.asarray(start(rng.integers(0, 2**32, len(self._shown), dtype=np.uint32)))

    def _step(self, rows: Rows, actions: Int64[np.ndarray, " environments"], rng: np.random.Generator) -> Rows:
        """Rows after an iteration of each."""
        _, step, _ = self._functions
        n, noise_size = len(rows), self.setup.environment.noise_size
        inputs = np.empty((n, 1 + noise_size), np.float32)
        inputs[:, 0] = actions
        inputs[:, 1:] = rng.random((n, noise_size), np.float32)
        return np.asarray(step(inputs, rows, self.setup.simulator))

    def _go_on_from(self, rows: Rows, begun: Bool[np.ndarray, " environments"]) -> tuple[Any, Observations]:
        """Returns the `State` and the observations in the rows, as numpy copies, shape (environments, ...)."""
        _, _, read = self._functions
        self._rows, (state, observations) = rows, read(rows)
        if self.render_mode is not None:
            self._commands = state.info["command"]
            # Copies, as the observations belong to the user.
            of_robot = observations[:, : len(self.setup.environment.robot.observation_spec)].copy()
            for i, observation in enumerate(of_robot):
                self._shown[i] = [observation] if begun[i] else [*self._shown[i], observation]
        return state, observations

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
    def _functions(self) -> tuple[Callable[..., Any], ...]:
        return _compiled(self.setup.environment)


@lru_cache(maxsize=64)
def _compiled(environment: Environment[Any]) -> tuple[Callable[..., Any], ...]:
    """Starts and steps, as rows, and the reading of rows."""

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

    def read(rows: Rows) -> tuple[Any, Observations]:
        return unpack(rows, np.ndarray.view)

    return jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step, (0, 0, None))), read
