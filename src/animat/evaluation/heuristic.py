"""A heuristic policy as a control: is learning needed, or do the robot and the mapping suffice?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from animat.environment import Environment
from animat.evaluation.commands import mean_commands
from animat.evaluation.rollouts import Actor, Seen, Uniforms, nearest_action
from animat.neurons.simulator import NeuronSimulator
from animat.robots.base import capability


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HeuristicPolicy(Actor):
    """The action whose mean command is nearest to that of the robot's `heuristic`.

    Attributes:
        actions: the environment's input for each action, shape (1, actions), for one actor.
        means: the mean command of each action, the same shape, or (1, actions, commands) for several commands.
    """

    actions: Array
    means: Float[Array, "..."]

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        return nearest_action(self.actions, self.means, _wanted(environment, observation))


# Static: JAX confuses registered dataclasses without fields.
@final
@jax.tree_util.register_static
@dataclass(frozen=True)
class Heuristic(Actor):
    """The commands of the robot's `heuristic` themselves, where any can be given: without neurons, continuous ones."""

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        return _wanted(environment, observation)


def _wanted(environment: Environment[Any], observation: Seen) -> Array:
    """The commands of the robot's `heuristic`, which sees only the robot."""
    of_robot = (observation * environment.scales)[:, : len(environment.robot.observation_spec)]
    commands: Array = jax.vmap(capability(environment.robot, "heuristic"))(of_robot)
    return commands


def heuristic_policy(environment: Environment[Any], simulator: NeuronSimulator | None) -> Heuristic | HeuristicPolicy:
    """The heuristic policy for an environment and the neurons in it, as one actor for `roll_out`.

    Raises:
        InvalidArgument: for a robot without a `heuristic`.
    """
    capability(environment.robot, "heuristic")  # Raises if there is none.
    if environment.n_actions is None:
        return Heuristic()
    actions, means = mean_commands(environment, simulator)
    return HeuristicPolicy(jnp.asarray(actions)[None], jnp.asarray(means, jnp.float32)[None])
