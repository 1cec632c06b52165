"""The replay of a policy: stored transitions, one packed row each, the oldest overwritten first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from animat.environment import Environment
from animat.neurons.simulator import Index
from animat.training.settings import SAC

PerEnvironment: TypeAlias = Float[Array, " environments"]
Flags: TypeAlias = Bool[Array, " environments"]
States: TypeAlias = Float[Array, "environments state"]
Rows: TypeAlias = Float[Array, "environments row"]


class Batch(NamedTuple):
    """A batch of transitions; observations and rewards are scaled, actions and `ended` are floats.

    A state ends with the time left, from 1 at the start of an episode to -1 at its limit, which the actor does not see.
    """

    state: Float[Array, "batch state"]
    next_state: Float[Array, "batch state"]
    action: Float[Array, "batch *commands"]
    reward: Float[Array, " batch"]
    ended: Float[Array, " batch"]

    @property
    def observation(self) -> Float[Array, "batch _"]:
        return self.state[:, :-1]

    @property
    def next_observation(self) -> Float[Array, "batch _"]:
        return self.next_state[:, :-1]


def pack_transitions(
    settings: SAC, state: States, next_state: States, action: Array, reward: PerEnvironment, ended: Flags
) -> Rows:
    """Rows of the replay, from which `draw_batch` unpacks a `Batch`."""
    of_action = action.reshape(len(state), -1).astype(jnp.float32)
    row = jnp.stack([settings.reward_scale * reward, ended], axis=1, dtype=jnp.float32)
    return jnp.concatenate([state, next_state, of_action, row], axis=1)


@jax.custom_batching.custom_vmap
def remember(
    replay: Float[Array, "*policies transitions row"], rows: Float[Array, "*policies environments row"], at: Index
) -> Float[Array, "*policies transitions row"]:
    """Write rows into a replay from row `at` on, which is the same for all policies that are trained side by side.

    `jax.vmap` by itself would scatter them, for which XLA rewrites all replays on a GPU in each round.
    """
    return jax.lax.dynamic_update_slice(replay, rows, (*[jnp.int32(0)] * (replay.ndim - 2), at, jnp.int32(0)))


@remember.def_vmap
def _remember_each(size: int, is_batched: Sequence[bool], *arguments: Array) -> tuple[Array, bool]:
    if tuple(is_batched) != (True, True, False):
        raise ValueError("remember: expected a replay and rows of each policy, and one position for all")
    return remember(*arguments), True


def draw_batch(
    environment: Environment[Any], replay: Float[Array, "n row"], available: Index, uniforms: Float[Array, " batch"]
) -> Batch:
    """Draw transitions from the first `available` ones of a replay."""
    n, n_drawn = len(environment.observation_spec) + 1, environment.n_drawn
    rows = replay[(uniforms * available).astype(jnp.int32)]
    action = rows[:, 2 * n : 2 * n + n_drawn] if environment.n_actions is None else rows[:, 2 * n]
    return Batch(rows[:, :n], rows[:, n : 2 * n], action, rows[:, -2], rows[:, -1])
