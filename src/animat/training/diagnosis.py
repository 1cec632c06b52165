"""How a learner stands between two chunks: what tells whoever follows a training why its return goes as it does.

It is computed apart, on what the chunk left: no bit of what is learned depends on it, and no gradient step is slower.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment
from animat.training.exploration import paid_for_entropy
from animat.training.networks import forward, squashed_normal
from animat.training.replay import batch_of
from animat.training.sac import Learner, continuous_losses, discrete_losses
from animat.training.settings import SAC

_TRANSITIONS = 512
"""Drawn anew for each diagnosis; with them it takes less than a hundredth of a chunk of the usual length."""


class Diagnosis(NamedTuple):
    """Of one policy, on transitions drawn from its replay.

    Attributes:
        entropy: mean of H(pi(.|o)), nats; of continuous actions that of -log pi(a|o), one action drawn in each.
        alpha: the weight of the entropy bonus.
        critic_loss: what the critics' gradient steps make smaller, as in `animat.training.sac.discrete_losses`.
    """

    entropy: Float[Array, ""]
    alpha: Float[Array, ""]
    critic_loss: Float[Array, ""]


def diagnose(environment: Environment[Any], settings: SAC, learner: Learner, available: Int[Array, ""]) -> Diagnosis:
    """How a learner stands, always by the same random numbers.

    Args:
        environment, settings: of its training (static).
        learner: after a chunk.
        available: how many transitions its replay has; none give NaN.
    """
    n_drawn = environment.n_drawn
    uniforms = jax.random.uniform(jax.random.key(0), (1 + 2 * n_drawn, _TRANSITIONS))
    batch = batch_of(environment, learner.replay, available, uniforms[0])
    noise = uniforms[1:].reshape(2, n_drawn, _TRANSITIONS).swapaxes(1, 2)
    outputs = forward(learner.trained.actor, batch.observation)
    paid = paid_for_entropy(learner.exploration)
    if environment.n_actions is None:
        critic_loss, _, _ = continuous_losses(learner.trained, learner.targets, batch, noise, settings, paid)
        _, log_pi = squashed_normal(outputs, noise[1])
    else:
        critic_loss, _, _ = discrete_losses(learner.trained, learner.targets, batch, settings, paid)
        log_pi = jnp.sum(jax.nn.softmax(outputs) * jax.nn.log_softmax(outputs), axis=-1)
    found = -jnp.mean(log_pi), jnp.exp(learner.trained.log_alpha), critic_loss
    return Diagnosis(*(jnp.where(available > 0, number, jnp.nan) for number in found))


@lru_cache(maxsize=8)
def diagnosing(environment: Environment[Any], algorithm: SAC) -> Callable[..., Any]:
    """`diagnose` for several policies side by side, to be compiled when it is first called."""
    return jax.jit(
        jax.vmap(partial(diagnose, environment, algorithm), in_axes=(0, None)), compiler_options=COMPILER_OPTIONS
    )
