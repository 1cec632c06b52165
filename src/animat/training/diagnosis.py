"""Diagnostics of a learner between two chunks, to explain its learning curve; they do not affect what is learned."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from animat.compilation import jit_side_by_side
from animat.environment import Environment
from animat.training.exploration import entropy_factor
from animat.training.networks import forward, squashed_normal
from animat.training.replay import draw_batch
from animat.training.sac import Learner, continuous_losses, discrete_losses
from animat.training.settings import SAC

_TRANSITIONS = 512
"""Number of transitions drawn for a diagnosis, which then takes less than 1 % of a chunk of the usual length."""


class Diagnosis(NamedTuple):
    """The diagnosis of one policy, on transitions drawn from its replay.

    Attributes:
        entropy: mean of H(pi(.|o)), nats; for continuous actions the mean of -log pi(a|o), one action drawn per state.
    """

    entropy: Float[Array, ""]
    alpha: Float[Array, ""]
    critic_loss: Float[Array, ""]


def diagnose(environment: Environment[Any], settings: SAC, learner: Learner, available: Int[Array, ""]) -> Diagnosis:
    """Diagnose a learner, always with the same random numbers; NaN if its replay has no transitions available."""
    n_drawn = environment.n_drawn
    uniforms = jax.random.uniform(jax.random.key(0), (1 + 2 * n_drawn, _TRANSITIONS))
    batch = draw_batch(environment, learner.replay, available, uniforms[0])
    noise = uniforms[1:].reshape(2, n_drawn, _TRANSITIONS).swapaxes(1, 2)
    outputs = forward(learner.trained.actor, batch.observation)
    paid = entropy_factor(learner.exploration)
    if environment.n_actions is None:
        critic_loss, _, _ = continuous_losses(learner.trained, learner.targets, batch, noise, settings, paid)
        _, log_pi = squashed_normal(outputs, noise[1])
    else:
        critic_loss, _, _ = discrete_losses(learner.trained, learner.targets, batch, settings, paid)
        log_pi = jnp.sum(jax.nn.softmax(outputs) * jax.nn.log_softmax(outputs), axis=-1)
    numbers = -jnp.mean(log_pi), jnp.exp(learner.trained.log_alpha), critic_loss
    return Diagnosis(*(jnp.where(available > 0, number, jnp.nan) for number in numbers))


@lru_cache(maxsize=8)
def diagnosis_program(environment: Environment[Any], algorithm: SAC) -> Callable[..., Any]:
    """`diagnose` for several policies, compiled when it is first called."""
    return jit_side_by_side(partial(diagnose, environment, algorithm), (0, None))
