"""The distribution of commands that an action leads to, for expectations over the neurons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from animat.coding.decoder import decode
from animat.coding.mapping import Thresholds
from animat.environment import Animat, Environment, Neurons
from animat.errors import InvalidArgument
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import NeuronSimulator, Stored, to_jax
from animat.wrappers import ShuffledDelivery, unwrapped

CONTINUOUS_ACTIONS = 21
"""Number of evenly spaced commands that represent a continuous action."""
_QUANTILES = 2048
"""Number of responses of equal probability that represent a condition's distribution, for a continuous mapping."""
_MOST_LEVELS = 12
CLASSES = 6
"""Number of classes of the history state."""
_HISTORIES_PER_CLASS = 8
"""Number of histories that represent a class."""


@dataclass(frozen=True, eq=False)
class Commands:
    """For each action (the environment's input), the commands u it can lead to, with their probabilities."""

    actions: np.ndarray
    levels: Float64[np.ndarray, "actions levels"]
    probabilities: Float64[np.ndarray, "actions levels"]

    def with_noise(self, largest: float) -> Commands:
        """The same with uniform noise in [-largest, largest] added to each command.

        Two points at +-largest / sqrt(3) represent it: the mean of a cubic polynomial over them is exact.
        """
        shift = largest / np.sqrt(3)
        if shift == 0:
            return self
        levels = np.concatenate([self.levels - shift, self.levels + shift], axis=1)
        return Commands(self.actions, levels, np.concatenate([self.probabilities, self.probabilities], axis=1) / 2)

    def onto(self, nodes: Float64[np.ndarray, " nodes"], *, smooth: bool) -> Float64[np.ndarray, "actions nodes"]:
        """Weights that give the mean of a function over each action's commands from its values at a few commands.

            E[f(u) | action] = sum_k w_k f(u_k),    w_k = E[l_k(u) | action]

        with l_k the polynomials (smooth) or hat functions (otherwise) that are 1 at node k and 0 at the others. If all
        commands are nodes, which rise, the weights are their probabilities; those of polynomials may be negative.
        """
        if smooth or len(nodes) == 1:
            basis = np.ones((*self.levels.shape, len(nodes)))
            for k, at in enumerate(nodes):
                for other in np.delete(nodes, k):
                    basis[..., k] *= (self.levels - other) / (at - other)
        else:
            left = np.clip(np.searchsorted(nodes, self.levels, side="right") - 1, 0, len(nodes) - 2)
            part = np.clip((self.levels - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0)
            hats = np.eye(len(nodes))
            basis = (1 - part)[..., None] * hats[left] + part[..., None] * hats[left + 1]
        return np.asarray(np.einsum("al,alk->ak", self.probabilities, basis))


def commands_of(environment: Environment[Any], simulator: Neurons) -> Commands:
    """The commands that each action of an environment leads to.

    For thresholds the probabilities are exact: where a condition's distribution passes each threshold is found by
    bisection, to the last bit of a float32. For a continuous mapping 2048 responses of equal probability represent a
    condition; 21 evenly spaced commands represent a continuous action. An Animat needs a simulator (InvalidArgument).
    """
    animat = unwrapped(environment)
    if not isinstance(animat, Animat):
        n, start = environment.n_actions, environment.reset(jax.random.key(0))
        actions = jnp.arange(n) if n is not None else jnp.asarray(np.linspace(-1, 1, CONTINUOUS_ACTIONS), jnp.float32)
        step = jax.vmap(environment.advance, (None, None, 0, None))
        leads_to = step(jnp.zeros(environment.noise_size), start, actions, simulator).info["command"]
        return Commands(np.asarray(actions), np.asarray(leads_to, np.float64)[:, None], np.ones((len(actions), 1)))
    if simulator is None:
        raise InvalidArgument("simulator: expected a simulator, as an Animat acts through neurons, got None")
    animat.expect_simulator(simulator)
    if isinstance(animat.mapping, Thresholds):
        below = np.asarray(_shares_below(animat.mapping, simulator), np.float64)
        probabilities = np.diff(np.pad(below, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=1)
        levels = np.tile(np.array(animat.mapping.levels), (len(below), 1))
    else:
        commands = animat.mapping.command(simulator.evenly_drawn(_QUANTILES), simulator.percentiles)
        levels = np.asarray(commands, np.float64)
        probabilities = np.full(levels.shape, 1 / _QUANTILES)
    n_actions = animat.n_conditions
    if is_shuffled(environment):
        # The delivered condition does not depend on the choice: every action leads to the mixture of all.
        levels = np.tile(levels.reshape(1, -1), (n_actions, 1))
        probabilities = np.tile(probabilities.reshape(1, -1) / n_actions, (n_actions, 1))
    return Commands(np.arange(n_actions), levels, probabilities)


def mean_commands(
    environment: Environment[Any], simulator: Neurons
) -> tuple[np.ndarray, Float64[np.ndarray, "actions *commands"]]:
    """The environment's input for each action, and the mean command that it leads to; errors as in `commands_of`."""
    animat = unwrapped(environment)
    if isinstance(animat, Animat) and simulator is not None and animat.robot.n_commands > 1:
        animat.expect_simulator(simulator)
        commands = decode(animat.mapping, simulator.evenly_drawn(_QUANTILES), jnp.asarray(simulator.percentiles))
        return np.arange(animat.n_conditions), np.asarray(commands.mean(axis=1), np.float64)
    of_one = commands_of(environment, simulator)
    return of_one.actions, np.sum(of_one.levels * of_one.probabilities, axis=1)


def memory_simulator(environment: Environment[Any], simulator: Neurons) -> MemorySimulator | None:
    """The simulator, whose history is distinguished by class; None without memory; refuses a custom memory."""
    if not isinstance(unwrapped(environment), Animat) or simulator is None or not simulator.has_memory:
        return None
    if not isinstance(simulator, MemorySimulator):
        kind = type(simulator).__name__
        raise InvalidArgument(f"simulator: expected a MemorySimulator or one without memory, got {kind}")
    return simulator


def class_of(simulator: MemorySimulator, history: Float[Stored, "*histories 2"]) -> Int[np.ndarray, "*histories"]:
    """The class of each history, by its trace; each class has equally many of the recording's own histories.

    Loads are not distinguished: each class has the loads that were recorded with such traces.
    """
    ends, traces = to_jax(np.arange(1, CLASSES) / CLASSES), to_jax(_recorded_histories(simulator)[:, 0])
    return np.asarray(np.sum(np.asarray(history)[..., :1] >= np.asarray(jnp.quantile(traces, ends)), axis=-1))


def commands_after(environment: Environment[Any], simulator: Neurons) -> list[list[Commands]]:
    """For each class of the history, for each class of the next history: the commands that each action leads to.

    Their probabilities are joint with the next class and add up to 1 over both. Memory is approximated by six classes
    (`class_of`): 8 histories represent a class, and 2048 draws after each of them its responses. Without memory there
    is one class, with the commands of `commands_of`.
    """
    animat, memory = unwrapped(environment), memory_simulator(environment, simulator)
    if memory is None:
        return [[commands_of(environment, simulator)]]
    assert isinstance(animat, Animat)
    animat.expect_simulator(memory)
    levels, histories = _command_quantiles(animat, memory, _histories_of_classes(memory))
    levels, classes = np.asarray(levels, np.float64), class_of(memory, histories)
    if is_shuffled(environment):
        # The delivered condition does not depend on the choice: one action represents all.
        levels, classes = (x.reshape(len(x), 1, -1) for x in (levels, classes))
    actions, even = np.arange(levels.shape[1]), np.full(levels.shape[1:], 1 / levels.shape[-1])
    return [
        [Commands(actions, of_class, even * (then == of)) for of in range(len(levels))]
        for of_class, then in zip(levels, classes, strict=True)
    ]


def is_shuffled(environment: Environment[Any]) -> bool:
    """Whether the delivered condition is drawn at random, whatever is chosen."""
    return isinstance(unwrapped(environment, ShuffledDelivery), ShuffledDelivery)


def _recorded_histories(simulator: MemorySimulator) -> Float[np.ndarray, "responses 2"]:
    """The histories of all recorded responses, sorted by trace."""
    histories = np.asarray(simulator.histories)[np.isfinite(np.asarray(simulator.before))]
    return np.asarray(histories[np.argsort(histories[:, 0], kind="stable")])


def _histories_of_classes(simulator: MemorySimulator) -> Float[np.ndarray, "classes histories 2"]:
    """A few histories of each class, evenly spaced in rank among the recorded ones."""
    recorded = _recorded_histories(simulator)
    ends = np.searchsorted(class_of(simulator, recorded), np.arange(CLASSES + 1))
    within = (np.arange(_HISTORIES_PER_CLASS) + 0.5) / _HISTORIES_PER_CLASS
    # A class without recorded histories can only contain an episode's start; the nearest histories represent it.
    rows = (ends[:-1, None] + within * np.diff(ends)[:, None]).astype(np.int64)
    return recorded[np.minimum(rows, len(recorded) - 1)]


@partial(jax.jit, static_argnums=0)
def _command_quantiles(
    environment: Animat[Any], simulator: MemorySimulator, history: Float[Array, "classes histories 2"]
) -> tuple[Float[Array, "classes conditions draws"], Float[Array, "classes conditions draws 2"]]:
    """The commands and the next histories, at evenly spaced quantiles of each condition after each history."""
    uniforms = (jnp.arange(_QUANTILES, dtype=jnp.float32) + 0.5) / _QUANTILES
    answer = jax.vmap(jax.vmap(simulator.answer, (None, 0, None)), (None, None, 0))
    answers = jax.vmap(jax.vmap(answer, (0, None, None)), (None, None, 0))
    answered = answers(jnp.arange(simulator.n_conditions), uniforms, history)
    shape = len(history), simulator.n_conditions, -1
    x, then = answered.rate_hz.reshape(shape), answered.history.reshape(*shape, 2)
    return environment.mapping.command(x, simulator.percentiles), then


def nodes_for(cases: Sequence[Commands], n_smooth: int | None) -> tuple[Float64[np.ndarray, " nodes"], bool]:
    """The fewest commands from which the means over all cases' commands can be computed, and whether by polynomials.

    `n_smooth` is the number of Chebyshev nodes that describe a function of the command well; None: it is not smooth.
    """
    levels = np.unique(np.concatenate([np.ravel(case.levels[case.probabilities > 0]) for case in cases]))
    levels = levels[np.concatenate([[True], np.diff(levels) > 1e-6])]
    if len(levels) <= (_MOST_LEVELS if n_smooth is None else n_smooth):
        return levels, False
    if n_smooth is None:
        return np.linspace(-1.0, 1.0, CONTINUOUS_ACTIONS), False
    middle, half = (levels[-1] + levels[0]) / 2, (levels[-1] - levels[0]) / 2
    return middle - half * np.cos(np.pi * np.arange(n_smooth) / (n_smooth - 1)), True


@partial(jax.jit, static_argnums=0)
def _shares_below(mapping: Thresholds, simulator: NeuronSimulator) -> Float[Array, "conditions thresholds"]:
    """The quantiles at which the command steps up to each level except the lowest, by bisection."""
    conditions, levels = jnp.arange(simulator.n_conditions), jnp.asarray(mapping.levels[1:], jnp.float32)
    response = jax.vmap(jax.vmap(simulator.quantile, (None, 0)))

    def are_below(quantiles: Float[Array, "conditions thresholds"]) -> Array:
        # Levels are 0.2 apart.
        return jnp.asarray(mapping.command(response(conditions, quantiles), simulator.percentiles) < levels - 0.1)

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) / 2
        below = are_below(middle)
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    none = jnp.zeros((len(conditions), len(levels)))
    high = jax.lax.fori_loop(0, 40, halve, (none, jnp.ones_like(none)))[1]
    return jnp.where(are_below(none), high, 0.0)
