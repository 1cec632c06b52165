"""The robots by name, and robots as plain data for a policy's file; none of it needs JAX."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from animat.errors import InvalidArgument, shown
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

ROBOTS: Mapping[str, type[Robot[Any]]] = MappingProxyType({robot.name: robot for robot in (Cartpole, Navigation)})
"""Every robot there is, by its name."""


def robot_named(name: str, /, **parameters: float) -> Robot[Any]:
    """The robot of this name, with these parameters in place of its defaults.

    Args:
        name: `cartpole` or `navigation`.
        parameters: fields of the robot's class, `pole_mass_kg=0.55`.

    Raises:
        InvalidArgument: for a name or parameter that is not known, or a value that the robot refuses.
    """
    if not isinstance(name, str) or name not in ROBOTS:
        raise InvalidArgument(f"robot: expected one of {', '.join(ROBOTS)}, got {shown(name)}")
    robot = ROBOTS[name]
    known = [field.name for field in dataclasses.fields(robot)]  # type: ignore[arg-type]
    for parameter in parameters:
        if parameter not in known:
            raise InvalidArgument(f"{name}: expected parameters among {', '.join(known)}, got {shown(parameter)}")
    return robot(**parameters)


def robot_to_dict(robot: Robot[Any]) -> dict[str, Any]:
    """The robot as JSON data, all parameters named: `{"name": "cartpole", "parameters": {"force_n": 1.0, ...}}`."""
    return {"name": robot.name, "parameters": dataclasses.asdict(robot)}  # type: ignore[call-overload]


def robot_from_dict(data: Mapping[str, Any]) -> Robot[Any]:
    """The robot that `robot_to_dict` made this of.

    Raises:
        InvalidArgument: for data of another form, or a robot or parameter that is not known.
    """
    if (
        not isinstance(data, Mapping)
        or set(data) != {"name", "parameters"}
        or not isinstance(data["parameters"], Mapping)
    ):
        raise InvalidArgument(f'robot: expected {{"name": ..., "parameters": {{...}}}}, got {data!r}')
    return robot_named(data["name"], **data["parameters"])


def expect_loadable_robot(robot: Robot[Any]) -> None:
    """Refuse a robot that a file could name and nothing could give back.

    Raises:
        InvalidArgument: for a robot of one's own, which cannot be registered yet.
    """
    try:
        if robot_from_dict(robot_to_dict(robot)) == robot:
            return
    except (InvalidArgument, TypeError):
        pass
    raise InvalidArgument(
        f"robot: expected one that a policy's file can name ({', '.join(ROBOTS)}), got one of one's own "
        f"({type(robot).__name__}), with which no policy could be loaded again; until robots can be registered, train "
        "in memory: train(training, timeline, None)"
    )
