"""The Animat as two compiled functions from arrays to arrays: what the environments step.

A call into compiled code costs by the number of arrays that go in and out, more than by what it computes. So an
iteration takes and gives one row of float32 per environment, with the state packed inside.
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

from animat.animat import Animat, Outcome
from animat.gym.setup import Setup

Rows = Float32[np.ndarray, "environments numbers"]


class Step(NamedTuple):
    """What one iteration gave, each of shape (environments, ...); rates in Hz, commands in [-1, 1].

    Of several readouts rates and commands have an axis of them.
    """

    states: Rows
    observations: Rows
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    delivered: np.ndarray
    rate_hz: np.ndarray
    command: np.ndarray


class CompiledAnimat:
    """Starts and steps any number of Animats on numpy arrays, every random number drawn from a numpy generator."""

    def __init__(self, setup: Setup) -> None:
        """Compilation waits for the first call, and is shared by all environments of the same Animat."""
        self._animat, self._simulator = setup.animat, setup.simulator
        self._noise_size = setup.animat.noise_size

    def __getstate__(self) -> dict[str, Any]:
        """Compiled functions stay behind when an environment is pickled; they are made again where it arrives."""
        return {name: value for name, value in vars(self).items() if name != "_functions"}

    def start(self, n: int, rng: np.random.Generator) -> tuple[Rows, Rows]:
        """(states, observations) at the start of `n` episodes."""
        seeds = rng.integers(0, 2**32, n, dtype=np.uint32)
        rows = np.asarray(self._functions.start(seeds))
        return self._split(rows, self._size)

    def step(self, states: Rows, actions: Int64[np.ndarray, " environments"], rng: np.random.Generator) -> Step:
        """One iteration of each."""
        n = len(states)
        given = np.empty((n, 1 + self._noise_size), np.float32)
        given[:, 0] = actions
        given[:, 1:] = rng.random((n, self._noise_size), np.float32)
        rows = np.asarray(self._functions.step(given, states, self._simulator))
        states, rest = self._split(rows, self._size)
        n_commands = self._animat.robot.n_commands
        observations, outcome = self._split(rest, rest.shape[1] - 4 - 2 * n_commands)
        reward, terminated, truncated, delivered, *answered = outcome.T
        rate_hz, command = answered if n_commands == 1 else np.split(outcome[:, 4:], 2, axis=1)
        return Step(
            states,
            observations,
            reward,
            terminated != 0,
            truncated != 0,
            delivered.astype(np.int64),
            rate_hz,
            command,
        )

    @staticmethod
    def _split(rows: Rows, at: int) -> tuple[Rows, Rows]:
        # The second part is copied: what users keep of it must not hold on to, or change with, the rest.
        return rows[:, :at], rows[:, at:].copy()

    @cached_property
    def _functions(self) -> _Functions:
        return _compiled(self._animat)

    @cached_property
    def _size(self) -> int:
        return self._functions.state_size


class _Functions(NamedTuple):
    state_size: int
    start: Callable[..., Array]
    step: Callable[..., Array]


@lru_cache(maxsize=64)
def _compiled(animat: Animat[Any]) -> _Functions:
    template = animat.reset(jax.random.key(0))
    flat, unpack = ravel_pytree(template)

    def pack(state: Any) -> Array:
        return ravel_pytree(state)[0].astype(jnp.float32)

    def start(seed: Array) -> Array:
        state = animat.reset(jax.random.key(seed))
        return jnp.concatenate([pack(state), animat.observe(state)])

    def step(given: Array, state: Array, simulator: Any) -> Array:
        outcome: Outcome = animat.advance(given[1:], unpack(state), given[0].astype(jnp.int32), simulator)
        numbers = [jnp.ravel(x).astype(jnp.float32) for x in outcome[1:]]
        return jnp.concatenate([pack(outcome.state), animat.observe(outcome.state), *numbers])

    return _Functions(flat.size, jax.jit(jax.vmap(start)), jax.jit(jax.vmap(step, (0, 0, None))))
