"""The robots by name."""

from __future__ import annotations

from typing import Any, TypeVar

from animat.registry import Registry
from animat.robots.base import Robot

Kind = TypeVar("Kind", bound=type[Robot[Any]])

REGISTRY: Registry[Robot[Any]] = Registry("robot", Robot)  # type: ignore[type-abstract]
"""An installed package announces its robots in the entry point group `animat.robots`."""

ROBOTS = REGISTRY.kinds
"""The registered robots, by name."""

robot_named, robot_to_dict, robot_from_dict = REGISTRY.named, REGISTRY.to_dict, REGISTRY.from_dict


def register_robot(kind: Kind) -> Kind:
    """Class decorator that registers a robot by its name, so that its policies can be saved and loaded.

    Raises InvalidArgument for anything but a frozen dataclass of all parameters with the methods of `Robot`, or if
    another robot has its name.
    """
    REGISTRY.register(kind)
    return kind
