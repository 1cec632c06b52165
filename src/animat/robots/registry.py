"""The robots by name: registered, announced by an installed package, or imported; and robots as plain data."""

from __future__ import annotations

import copyreg
import dataclasses
import importlib
import json
import re
import sys
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from animat.errors import InvalidArgument, shown
from animat.robots.base import Robot

Kind = TypeVar("Kind", bound=type[Robot[Any]])

ENTRY_POINTS = "animat.robots"
"""The group in which an installed package announces its robots, `rover = "my_package.robots:Rover"`."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,40}")
_PLACE = re.compile(r"[\w.]{1,200}:[\w.<>]{1,200}")
_IN_MEMORY = "train in memory: train(training, timeline, None)"

_registered: dict[str, type[Robot[Any]]] = {}
ROBOTS: Mapping[str, type[Robot[Any]]] = MappingProxyType(_registered)
"""The robots registered so far, by their names."""


def register_robot(kind: Kind) -> Kind:
    """Make a robot known by its name, so that its policies can be saved and loaded; a decorator of its class.

    Args:
        kind: a frozen dataclass of all parameters, with the methods of `Robot`.

    Raises:
        InvalidArgument: for another class, one that lacks a method, or a name that another robot has.
    """
    if not (isinstance(kind, type) and issubclass(kind, Robot)):
        raise InvalidArgument(f"robot: expected a class made of animat.Robot, got {shown(kind)}")
    place = place_of(kind)
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise InvalidArgument(f"{place}: expected the methods of a robot, got a class without {', '.join(missing)}")
    if not getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
        raise InvalidArgument(f"{place}: expected a frozen dataclass, got a class without @dataclass(frozen=True)")
    name = getattr(kind, "name", None)
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise InvalidArgument(f"{place}.name: expected letters, digits, - and _, a letter first, got {shown(name)}")
    if name in _registered and (other := place_of(_registered[name])) != place:
        raise InvalidArgument(f"{place}.name: expected one that no other robot has, got {name!r}, which is {other}")
    _registered[name] = kind
    if kind.__module__ == "__main__":
        # In a worker, __main__ is the worker: what a script defines is found there by the name of its file.
        copyreg.pickle(kind, _reduced)
    return kind


def place_of(kind: type) -> str:
    """Where a class can be imported from, as `module:Class`; that of a script is by the name of its file."""
    module = kind.__module__
    if module == "__main__":
        main = sys.modules[module]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        module = spec.name if spec else Path(file).stem if file else module
    return f"{module}:{kind.__qualname__}"


def is_ours(robot: Robot[Any]) -> bool:
    """Whether every animat has it, so that its name alone tells which robot it is."""
    return type(robot).__module__.startswith("animat.robots.")


def robot_named(name: str, /, **parameters: float) -> Robot[Any]:
    """The robot of this name, with these parameters in place of its defaults.

    Args:
        name: `cartpole`, `navigation`, that of a robot that is registered or that an installed package announces
            (`ENTRY_POINTS`); or where to import one from, `my_package.robots:Rover`, which registers it.
        parameters: fields of the robot's class, `pole_mass_kg=0.55`.

    Raises:
        InvalidArgument: for a name or parameter that is not known, a value that the robot refuses, or a robot that
            cannot be imported or registered.
    """
    kind = robot_class(name)
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for parameter in parameters:
        if parameter not in known:
            raise InvalidArgument(f"{name}: expected parameters among {', '.join(known)}, got {shown(parameter)}")
    try:
        return kind(**parameters)
    except InvalidArgument as error:
        raise InvalidArgument(f"{name}: {error}") from error
    except Exception as error:
        raise InvalidArgument(f"{name}: expected it to be made of {parameters}, got {_said(error)}") from error


def robot_names() -> tuple[str, ...]:
    """The names that are known here: of robots that are registered, then of those that packages announce."""
    return tuple(dict.fromkeys([*_registered, *(point.name for point in entry_points(group=ENTRY_POINTS))]))


def robot_class(name: str) -> type[Robot[Any]]:
    """The class of the robot of this name; arguments and errors as those of `robot_named`."""
    kind = _kind_named(name)
    if kind is None:
        raise InvalidArgument(
            f"robot: expected one of {', '.join(robot_names())}, got {shown(name)}; "
            "one of your own is named by its module:Class"
        )
    return kind


def robot_to_dict(robot: Robot[Any]) -> dict[str, Any]:
    """The robot as JSON data, all parameters named: `{"name": "cartpole", "parameters": {"force_n": 1.0, ...}}`.

    Of one that is not ours it also says where it is imported from: `"import": "my_package.robots:Rover"`.
    """
    data = {"name": robot.name, "parameters": dataclasses.asdict(robot)}  # type: ignore[call-overload]
    return data if is_ours(robot) else data | {"import": place_of(type(robot))}


def robot_from_dict(data: Mapping[str, Any]) -> Robot[Any]:
    """The robot that `robot_to_dict` made this of.

    Raises:
        InvalidArgument: for data of another form, or a robot or parameter that is not known; of a robot that is not
            registered here it says what to import. Nothing is imported because a file says so.
    """
    if (
        not isinstance(data, Mapping)
        or not {"name", "parameters"} <= set(data) <= {"name", "parameters", "import"}
        or not isinstance(data["parameters"], Mapping)
        or ":" in str(data["name"])
    ):
        raise InvalidArgument(f'robot: expected {{"name": ..., "parameters": {{...}}}}, got {shown(data)}')
    if "import" in data and not _PLACE.fullmatch(str(data["import"])):
        raise InvalidArgument(f"robot: expected to be imported from module:Class, got {shown(data['import'])}")
    if "import" in data and _kind_named(data["name"]) is None:
        place = str(data["import"])
        raise InvalidArgument(
            f"robot: expected one that is registered, got {shown(data['name'])}: import {place.partition(':')[0]} "
            f"first (on the command line: --robot {place})"
        )
    return robot_named(data["name"], **{name: _frozen(value) for name, value in data["parameters"].items()})


def expect_loadable_robot(robot: Robot[Any], *, in_workers: bool = False) -> None:
    """Refuse a robot that a file could name and nothing could give back.

    Args:
        robot: of any class.
        in_workers: whether processes of their own have to import it.

    Raises:
        InvalidArgument: for one that is not registered, or that no worker could import.
    """
    kind = type(robot)
    if (
        _registered.get(robot.name) is not kind
        or robot_from_dict(json.loads(json.dumps(robot_to_dict(robot)))) != robot
    ):
        raise InvalidArgument(
            f"robot: expected one that is registered, as a policy's file names its robot, got {kind.__name__}, which "
            f"is not: write @animat.register_robot above its class, or {_IN_MEMORY}"
        )
    place = place_of(kind)
    if in_workers and ("<locals>" in place or place.startswith("__main__:")):
        raise InvalidArgument(
            f"robot: expected a class at the top of a file, which worker processes can import, got {place}: put it "
            f"into a file, or {_IN_MEMORY}"
        )


def _kind_named(name: Any) -> type[Robot[Any]] | None:
    if not isinstance(name, str):
        return None
    if name in _registered:
        return _registered[name]
    if ":" in name:
        return _imported(name)
    for point in entry_points(group=ENTRY_POINTS, name=name):
        if (kind := _imported(point.value)).name != name:
            raise InvalidArgument(f"robot: expected {point.value} to have the name {name!r}, got {kind.name!r}")
        return kind
    return None


def _imported(place: str) -> type[Robot[Any]]:
    for kind in _registered.values():
        if place_of(kind) == place:
            return kind
    module, _, name = place.partition(":")
    if module.endswith(".py"):
        meant = f"{Path(module).stem}:{name}"
        raise InvalidArgument(f"robot: expected a module and its class, such as {meant}, got a file, {shown(place)}")
    try:
        found = getattr(importlib.import_module(module), name)
    except InvalidArgument:
        raise
    except (Exception, SystemExit) as error:
        # Anything may go wrong in somebody else's module.
        raise InvalidArgument(f"robot: expected {place} to be importable, got {_said(error)}") from error
    return register_robot(found)  # type: ignore[no-any-return]


def _reduced(robot: Robot[Any]) -> tuple[Any, ...]:
    return _remade, (place_of(type(robot)), dataclasses.asdict(robot))  # type: ignore[call-overload]


def _remade(place: str, parameters: dict[str, Any]) -> Robot[Any]:
    try:
        return _imported(place)(**parameters)
    except InvalidArgument as error:
        hint = "what a script does belongs under `if __name__ == '__main__':`, as worker processes import it"
        raise InvalidArgument(f"{error}; {hint}") from error


def _frozen(value: Any) -> Any:
    """What was a tuple before it was JSON: a robot's parameters can be hashed, and lists cannot."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _said(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or ["no more is known"]
    return f"{type(error).__name__}: {lines[0]}"
