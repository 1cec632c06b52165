"""A rule made by hand for each robot: which way its command should point, without any learning."""

from __future__ import annotations

from typing import Any

import numpy as np

from animat.errors import InvalidArgument
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

FORESIGHT_S = 0.1
"""The cartpole's rule goes by where the pole will lean so much later, at the speed it falls with now."""
STEERED = (Cartpole, Navigation)
"""The robots that there is a rule for."""


def steering(robot: Robot[Any], observation: Any, xp: Any = np) -> Any:
    """What a hand-made rule goes by: above 0 where the command should be positive, below 0 where it should be negative.

        cartpole:   theta + 0.1 s * theta', the pole's angle 0.1 s from now, rad (leaning right, push right)
        navigation: d sin(a), the goal being d m away at an angle a from the heading (to the side the goal lies on)

    Args:
        robot: whose observation it is.
        observation: in the robot's own units, the observations on the last axis.
        xp: the array library, numpy or jax.numpy.

    Raises:
        InvalidArgument: for a robot that no rule was made for.
    """
    if isinstance(robot, Cartpole):
        return observation[..., 2] + FORESIGHT_S * observation[..., 3]
    if isinstance(robot, Navigation):
        x_m, y_m, heading_rad = observation[..., 0], observation[..., 1], observation[..., 2]
        return xp.cos(heading_rad) * (robot.goal_y_m - y_m) - xp.sin(heading_rad) * (robot.goal_x_m - x_m)
    names = ", ".join(kind.name for kind in STEERED)
    raise InvalidArgument(f"robot: expected one that a rule was made for by hand ({names}), got {robot.name}")
