"""An environment as two compiled functions from arrays to arrays: what Gymnasium's environments step.

A call into compiled code costs by the number of arrays that go in and out, more than by what it computes. So an
iteration takes and gives one row of float32 per environment, with the state and what is observed packed inside.
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
    """Starts and steps any number of Animats on numpy arrays, every random number drawn from a numpy generator."""

    def __init__(self, setup: Setup) -> None:
        """Compilation waits for the first call, and is shared by all environments of the same Animat."""
        self._environment, self._simulator = setup.environment, setup.simulator

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions stay behind when an environment is pickled; they are made again where it arrives."""
        return {name: value for name, value in vars(self).items() if name != "_functions"}

    def start(self, n: int, rng: np.random.Generator) -> Rows:
        """The start of `n` episodes."""
        return np.asarray(self._functions.start(rng.integers(0, 2**32, n, dtype=np.uint32)))

    def step(self, rows: Rows, actions: Int64[np.ndarray, " environments"], rng: np.random.Generator) -> Rows:
        """One iteration of each."""
        n, noise_size = len(rows), self._environment.noise_size
        given = np.empty((n, 1 + noise_size), np.float32)
        given[:, 0] = actions
        given[:, 1:] = rng.random((n, noise_size), np.float32)
        return np.asarray(self._functions.step(given, rows, self._simulator))

    def read(self, rows: Rows) -> tuple[Any, Rows]:
        """The `State` in them and what is observed, in copies of numpy, shape (environments, ...)."""
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

    def step(given: Array, row: Array, simulator: Any) -> Array:
        return pack(environment.advance(given[1:], unpack(row)[0], given[0].astype(jnp.int32), simulator))

    def read(rows: Rows) -> tuple[Any, Rows]:
        parts = [
            rows[:, end - leaf.size : end].reshape(-1, *leaf.shape).astype(leaf.dtype)
            for end, leaf in zip(ends, leaves, strict=True)
        ]
        state, observations = jax.tree.unflatten(structure, parts)
        return state, observations

    return _Functions(jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step, (0, 0, None))), read)
