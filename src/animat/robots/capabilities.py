"""What a robot may be able to do besides: methods that may be missing, and what is left out without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from animat.errors import InvalidArgument
from animat.robots.base import Robot

WITHOUT = {
    "heuristic": "no heuristic policy among the controls",
    "value_grid": "no optimal return",
    "draw": "no pictures of the robot",
    "draw_paths": "no figure of paths",
}
"""What is left out for a robot without a method of this name (see `animat.Robot`)."""


def lacking(robot: Robot[Any]) -> dict[str, str]:
    """What is left out for this robot: a sentence for each method that it has not, by the method's name."""
    return {
        name: f"{without}: {robot.name} has no method `{name}`"
        for name, without in WITHOUT.items()
        if not hasattr(robot, name)
    }


def capability(robot: Robot[Any], name: str) -> Callable[..., Any]:
    """The method of this name.

    Raises:
        InvalidArgument: for a robot without it.
    """
    if not hasattr(robot, name):
        raise InvalidArgument(f"robot: {robot.name} has no method `{name}`")
    return getattr(robot, name)  # type: ignore[no-any-return]
