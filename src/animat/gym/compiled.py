"""An environment as two compiled functions from arrays to arrays, which Gymnasium's environments call.

The cost of a call into compiled code depends more on the number of arrays passed than on what is computed. So an
iteration takes and returns one row of float32 per environment, which packs the state and the observation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float32, Int64

from animat.environment import Environment, State
from animat.gym.setup import Setup

Rows = Float32[np.ndarray, "environments numbers"]


class CompiledAnimat:
    """Starts and steps any number of Animats on numpy arrays, with all random numbers from a numpy generator.

    It is compiled at the first call, once for all environments of the same Animat.
    """

    def __init__(self, setup: Setup) -> None:
        self._environment, self._simulator = setup.environment, setup.simulator

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions are not pickled; they are compiled again after unpickling."""
        return {name: value for name, value in vars(self).items() if name != "_functions"}

    def start(self, n: int, rng: np.random.Generator) -> Rows:
        """Start `n` episodes."""
        return np.asarray(self._functions.start(rng.integers(0, 2**32, n, dtype=np.uint32)))

    def step(self, rows: Rows, actions: Int64[np.ndarray, " environments"], rng: np.random.Generator) -> Rows:
        """One iteration of each."""
        n, noise_size = len(rows), self._environment.noise_size
        inputs = np.empty((n, 1 + noise_size), np.float32)
        inputs[:, 0] = actions
        inputs[:, 1:] = rng.random((n, noise_size), np.float32)
        return np.asarray(self._functions.step(inputs, rows, self._simulator))

    def read(self, rows: Rows) -> tuple[Any, Rows]:
        """The `State` and the observations in the rows, as numpy copies, shape (environments, ...)."""
        return self._functions.read(rows)

    @cached_property
    def _functions(self) -> _Functions:
        return _compiled(self._environment)


class _Functions(NamedTuple):
    start: Callable[..., Array]
    step: Callable[..., Array]
    read: Callable[[Rows], tuple[Any, Rows]]


@lru_cache(maxsize=64)
def _compiled(environment: Environment[Any]) -> _Functions:
    def with_observation(state: State) -> tuple[State, Array]:
        return state, environment.observe(state)

    template = with_observation(environment.reset(jax.random.key(0)))
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, template))
    ends = np.cumsum([leaf.size for leaf in leaves])
    _, unpack = ravel_pytree(template)

    def pack(state: State) -> Array:
        return ravel_pytree(with_observation(state))[0].astype(jnp.float32)

    def start(seed: Array) -> Array:
        return pack(environment.reset(jax.random.key(seed)))

    def step(inputs: Array, row: Array, simulator: Any) -> Array:
        return pack(environment.advance(inputs[1:], unpack(row)[0], inputs[0].astype(jnp.int32), simulator))

    def read(rows: Rows) -> tuple[Any, Rows]:
        parts = [
            rows[:, end - leaf.size : end].reshape(-1, *leaf.shape).astype(leaf.dtype)
            for end, leaf in zip(ends, leaves, strict=True)
        ]
        state, observations = jax.tree.unflatten(structure, parts)
        return state, observations

    return _Functions(jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step, (0, 0, None))), read)
