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
    """The action whose mean command is nearest to that of the robot's `heuristic`, which sees only the robot.

    Attributes:
        actions: the environment's input for each action, shape (1, actions), for one actor; None where any command can
            be given (without neurons, continuous ones).
        means: the mean command of each action, the same shape, or (1, actions, commands) for several commands.
    """

    actions: Array | None = None
    means: Float[Array, "..."] | None = None

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        of_robot = (observation * environment.scales)[:, : len(environment.robot.observation_spec)]
        wanted: Array = jax.vmap(capability(environment.robot, "heuristic"))(of_robot)
        return nearest_action(self.actions, self.means, wanted)


def heuristic_policy(environment: Environment[Any], simulator: NeuronSimulator | None) -> HeuristicPolicy:
    """The heuristic policy for an environment and the neurons in it, as one actor for `roll_out`.

    Raises:
        InvalidArgument: for a robot without a `heuristic`.
    """
    capability(environment.robot, "heuristic")
    if environment.n_actions is None:
        return HeuristicPolicy()
    actions, means = mean_commands(environment, simulator)
    return HeuristicPolicy(jnp.asarray(actions)[None], jnp.asarray(means, jnp.float32)[None])
