"""A rule made by hand in place of a trained policy: is learning needed, or do the robot and the mapping do it all?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.animat import Environment
from animat.errors import InvalidArgument
from animat.evaluation.commands import commands_of
from animat.evaluation.rollouts import Actor
from animat.neurons.simulator import NeuronSimulator
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

LOOK_AHEAD_S = 0.1
"""The cartpole's rule goes by where the pole will lean so much later, at the speed it falls with now."""


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HandMade(Actor):
    """Full power to the side that the robot should move to: the action whose mean command lies farthest that way.

        cartpole:   to the side the pole will lean to in 0.1 s (leaning right, push right)
        navigation: to the side the goal lies on

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
        side = _side(environment.robot, observation * environment.scales)
        return jnp.where(side > 0, self.right, self.left)


def hand_made(environment: Environment[Any], simulator: NeuronSimulator | None) -> HandMade:
    """The rule for an environment and the neurons in it, as one actor for `roll_out`.

    Raises:
        InvalidArgument: for a robot that no rule is known for.
    """
    if not isinstance(environment.robot, Cartpole | Navigation):
        raise InvalidArgument(
            f"robot: expected cartpole or navigation for a rule by hand, got {environment.robot.name}"
        )
    commands = commands_of(environment, simulator)
    means = np.sum(commands.levels * commands.probabilities, axis=1)
    left, right = (commands.actions[[i]] for i in (int(means.argmin()), int(means.argmax())))
    return HandMade(jnp.asarray(left), jnp.asarray(right))


def _side(robot: Robot[Any], observation: Float[Array, "episodes observations"]) -> Float[Array, " episodes"]:
    """Which way to go: above 0 for right (the cartpole) or clockwise (navigation)."""
    if isinstance(robot, Cartpole):
        return observation[:, 2] + LOOK_AHEAD_S * observation[:, 3]
    assert isinstance(robot, Navigation)
    x, y, heading = observation.T
    # The sine of the angle from the heading to the goal, times the distance.
    across: Array = jnp.cos(heading) * (robot.goal_y_m - y) - jnp.sin(heading) * (robot.goal_x_m - x)
    return across
