"""Assessments: episodes without exploration on fixed configurations, from which the best policy so far is known."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from animat.neurons.simulator import NeuronSimulator
from animat.training.networks import Network, likeliest_action
from animat.training.varied import Varied
from animat.wrappers import EpisodeLimit


def assess(
    environment: Varied[Any], episodes: int, actor: Network, simulator: NeuronSimulator | None, key: PRNGKeyArray
) -> tuple[Float[Array, " episodes"], Bool[Array, " episodes"]]:
    """Run a policy's most probable actions on the configurations that `key` decides.

    Args:
        environment: what is varied, and between what.
        episodes: how many (static).
        actor: the policy's network.
        simulator: the neurons; None without.
        key: the same in each assessment of a training, so that policies and minutes compare.

    Returns:
        of each episode the return, and whether it succeeded.
    """
    limited = EpisodeLimit(environment)
    of_starts, of_iterations = jax.random.split(key)
    started = jax.vmap(limited.reset)(jax.random.split(of_starts, episodes)).carried
    none = jnp.zeros(episodes)

    def iteration(at: tuple[Any, ...]) -> tuple[Any, ...]:
        index, state, going, returns, succeeded = at
        uniforms = jax.random.uniform(jax.random.fold_in(of_iterations, index), (episodes, limited.noise_size))
        action = likeliest_action(limited, actor, jax.vmap(limited.observe)(state) / limited.scales)
        after = jax.vmap(limited.advance, (0, 0, 0, None))(uniforms, state, action, simulator)
        ends = going & jnp.logical_or(*after.ended)
        succeeded |= ends & jax.vmap(environment.succeeded)(after)
        return (
            index + 1,
            after.carried,
            going & ~ends,
            returns + jnp.where(going, after.reward, 0.0),
            succeeded,
        )

    first = (jnp.int32(0), started, none == 0, none, none > 0)
    *_, returns, succeeded = jax.lax.while_loop(lambda at: jnp.any(at[2]), iteration, first)
    return returns, succeeded
