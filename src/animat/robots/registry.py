"""The robots by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from animat.registry import Registry
from animat.robots.base import Robot

Kind = TypeVar("Kind", bound=type[Robot[Any]])

REGISTRY: Registry[Robot[Any]] = Registry("robot", Robot)  # type: ignore[type-abstract]
"""An installed package announces its robots in the entry point group `animat.robots`."""

ROBOTS = REGISTRY.kinds
"""The robots registered so far, by their names."""


def register_robot(kind: Kind) -> Kind:
    """Make a robot known by its name, so that its policies can be saved and loaded; a decorator of its class.

    Args:
        kind: a frozen dataclass of all parameters, with the methods of `Robot`.

    Raises:
        InvalidArgument: for another class, one that lacks a method, or a name that another robot has.
    """
    REGISTRY.register(kind)
    return kind


def robot_named(name: str, /, **parameters: float) -> Robot[Any]:
    """The robot of this name, with these parameters in place of its defaults, `pole_mass_kg=0.55`.

    Args and errors: as `animat.registry.Registry.named`.
    """
    return REGISTRY.named(name, **parameters)


def robot_to_dict(robot: Robot[Any]) -> dict[str, Any]:
    """The robot as JSON data (`animat.registry.Registry.to_dict`)."""
    return REGISTRY.to_dict(robot)


def robot_from_dict(data: Mapping[str, Any]) -> Robot[Any]:
    """The robot that `robot_to_dict` made this of (`animat.registry.Registry.from_dict`)."""
    return REGISTRY.from_dict(data)
