"""A rule made by hand in place of a trained policy: is learning needed, or do the robot and the mapping do it all?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.animat import Environment
from animat.evaluation.commands import commands_of
from animat.evaluation.rollouts import Actor
from animat.neurons.simulator import NeuronSimulator
from animat.robots.steering import steering


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HandMade(Actor):
    """Full power to the side that the robot should move to: the action whose mean command lies farthest that way.

    The side is that of `animat.robots.steering`.

    Attributes:
        left, right: the actions with the smallest and the largest mean command, each of one number.
    """

    left: Array
    right: Array

    def act(
        self,
        environment: Environment[Any],
        observation: Float[Array, "episodes observations"],
        uniforms: Float[Array, " episodes"],
    ) -> Array:
        side = steering(environment.robot, observation * environment.scales, jnp)
        return jnp.where(side > 0, self.right, self.left)


def hand_made(environment: Environment[Any], simulator: NeuronSimulator | None) -> HandMade:
    """The rule for an environment and the neurons in it, as one actor for `roll_out`.

    Raises:
        InvalidArgument: for a robot that no rule is known for.
    """
    # It raises for a robot that there is no rule for.
    steering(environment.robot, np.zeros(len(environment.robot.quantities)))
    commands = commands_of(environment, simulator)
    means = np.sum(commands.levels * commands.probabilities, axis=1)
    left, right = (commands.actions[[i]] for i in (int(means.argmin()), int(means.argmax())))
    return HandMade(jnp.asarray(left), jnp.asarray(right))
