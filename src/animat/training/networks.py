"""Small networks for many policies: stacked layers, their forward pass, and actions drawn from a squashed normal."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, PRNGKeyArray

from animat.environment import Environment


class Layer(NamedTuple):
    """Weights and biases of one layer; leading axes stack networks."""

    weight: Float[Array, "*stack inputs outputs"]
    bias: Float[Array, "*stack 1 outputs"]


Network = tuple[Layer, ...]
Observations: TypeAlias = Float[Array, "batch observations"]
Commands: TypeAlias = Float[Array, "batch commands"]


def initial_networks(key: PRNGKeyArray, *shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> list[Network]:
    """New networks with the given sizes (inputs, hidden, ..., outputs) and stacks (number of networks).

    Weights are uniform in +-1/sqrt(inputs), a hundred times smaller in the last layer: a policy starts undecided.
    """
    counts = [math.prod(stack) * sum(i * o for i, o in itertools.pairwise(sizes)) for sizes, stack in shapes]
    # Drawn together and divided: a random generator in the program costs more to compile than to run.
    draws = jax.random.uniform(key, (sum(counts),), minval=-1.0, maxval=1.0)
    networks = []
    for sizes, stack in shapes:
        layers = []
        for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
            shape = (*stack, inputs, outputs)
            used, draws = draws[: math.prod(shape)], draws[math.prod(shape) :]
            limit = (0.01 if i == len(sizes) - 2 else 1.0) / math.sqrt(inputs)
            layers.append(Layer(limit * used.reshape(shape), jnp.zeros((*stack, 1, outputs))))
        networks.append(tuple(layers))
    return networks


def forward(network: Network, inputs: Float[Array, "*_ batch inputs"]) -> Float[Array, "*_ batch outputs"]:
    """Hidden layers of rectified units, then a linear layer."""
    hidden = inputs
    for layer in network[:-1]:
        hidden = jax.nn.relu(hidden @ layer.weight + layer.bias)
    return hidden @ network[-1].weight + network[-1].bias


def squashed_normal(
    outputs: Float[Array, "batch means_and_deviations"], uniforms: Commands
) -> tuple[Commands, Float[Array, " batch"]]:
    """A continuous action a = tanh(z) and log p(a), where the z of its commands are independent normal numbers.

    The first half of the actor's outputs are their means, the second half their log standard deviations.
    """
    mean, log_std = jnp.split(outputs, 2, axis=-1)
    log_std = jnp.clip(log_std, -5.0, 2.0)
    standard = ndtri(jnp.clip(uniforms, 1e-6, 1.0 - 1e-6))
    z = mean + jnp.exp(log_std) * standard
    log_normal = -0.5 * standard**2 - log_std - 0.5 * math.log(2.0 * math.pi)
    # log(1 - tanh(z)^2), in the form that keeps its precision for large |z|
    log_slope = 2.0 * (math.log(2.0) - z - jax.nn.softplus(-2.0 * z))
    return jnp.tanh(z), jnp.sum(log_normal - log_slope, axis=-1)


def draw_action(
    environment: Environment[Any], actor: Network, observation: Observations, uniforms: Float[Array, "batch drawn"]
) -> Array:
    """Draw an action from the policy for each scaled observation, by inverse transform sampling."""
    outputs = forward(actor, observation)
    if environment.n_actions is None:
        return as_commands(environment, squashed_normal(outputs, uniforms)[0])
    below = jnp.cumsum(jax.nn.softmax(outputs), axis=-1)[:, :-1]
    return jnp.sum(uniforms >= below, axis=-1)


def likeliest_action(environment: Environment[Any], actor: Network, observation: Observations) -> Array:
    """The most probable action for each scaled observation; for continuous commands tanh of the mean."""
    outputs = forward(actor, observation)
    if environment.n_actions is not None:
        return jnp.argmax(outputs, axis=-1)
    return as_commands(environment, jnp.tanh(outputs[:, : environment.n_drawn]))


def as_commands(environment: Environment[Any], actions: Commands) -> Float[Array, "batch *commands"]:
    """Continuous actions as the robot takes them: a single command is a number."""
    return actions[:, 0] if environment.robot.n_commands == 1 else actions
