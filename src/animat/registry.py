"""Robots and mappings by name (registered, announced by an installed package, or imported) and as plain data."""

from __future__ import annotations

import copyreg
import dataclasses
import importlib
import importlib.metadata
import json
import pickle
import re
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from animat.errors import InvalidArgument, did_you_mean, first_line, shown, some_of, within

Thing = TypeVar("Thing")

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,40}")
_PLACE = re.compile(r"[\w.]{1,200}:[\w.<>]{1,200}")
_MAIN = ("__main__", "__mp_main__")
"""What the module of a script is called where it was started, and in processes that import it as their own."""
_IN_MEMORY = "train in memory: train(training, timeline, None)"

_registries: dict[type, Registry[Any]] = {}
"""By base class."""


class Registry(Generic[Thing]):
    """The classes of one noun by name, ours and the user's.

    Args:
        noun: its name in messages, and the command-line option that selects one: `robot`.
        base: the base class of all; each subclass has a `name`, and is a frozen dataclass of its parameters.
        ours: instances that animat knows by name, several of which share a class.
        reserved: names that none may have.
    """

    def __init__(
        self, noun: str, base: type[Thing], ours: Mapping[str, Thing] | None = None, reserved: Collection[str] = ()
    ) -> None:
        self.noun, self.entry_points = noun, f"animat.{noun}s"
        self.base, self._ours, self._reserved = base, dict(ours or {}), (*(ours or {}), *reserved)
        self._registered: dict[str, type[Thing]] = {}
        self._families: dict[str, type[Any]] = {}
        self.kinds: Mapping[str, type[Thing]] = MappingProxyType(self._registered)
        """The classes registered so far, by name."""
        _registries[base] = self

    def __reduce__(self) -> tuple[Any, ...]:
        # Unpickling the base imports its module or package, which creates the registry.
        return _registry_of, (self.base,)

    def register(self, kind: type[Thing]) -> None:
        """Register a class under its name; InvalidArgument for a wrong kind, a missing method, or a name taken."""
        noun = self.noun
        if not (isinstance(kind, type) and issubclass(kind, self.base)):
            raise InvalidArgument(f"{noun}: expected a subclass of animat.{self.base.__name__}, got {shown(kind)}")
        place = place_of(kind)
        if missing := sorted(getattr(kind, "__abstractmethods__", ())):
            raise InvalidArgument(
                f"{place}: expected the methods of a {noun}, got a class without {', '.join(missing)}"
            )
        if not getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
            raise InvalidArgument(f"{place}: expected a frozen dataclass, got a class without @dataclass(frozen=True)")
        name = getattr(kind, "name", None)
        if not (isinstance(name, str) and _NAME.fullmatch(name)):
            raise InvalidArgument(f"{place}.name: expected letters, digits, - and _, a letter first, got {shown(name)}")
        other = place_of(self._registered[name]) if name in self._registered else "part of animat"
        if name in (*self._reserved, *self._families) or (name in self._registered and other != place):
            raise InvalidArgument(
                f"{place}.name: expected a name that no other {noun} has, got {name!r}, which is {other}"
            )
        self._registered[name] = kind
        if kind.__module__ in _MAIN:
            # In a worker, __main__ is the worker; classes of a script are imported there by the script's file name.
            copyreg.pickle(kind, self._reduce)

    def add_family(self, name: str, family: type[Any]) -> None:
        """Register a family of things from elsewhere, each by its name there: `gymnasium:Pendulum-v1`.

        Args:
            name: the prefix of their names, before a colon; in files it is the name of all of them.
            family: their class. `family.import_module(own_name)` imports the module that defines a thing;
                `family.named(own_name, **parameters)` looks it up; all parameters, as in files, need no look-up.
        """
        self._families[name] = family

    def named(self, name: str, /, **parameters: Any) -> Thing:
        """The robot or mapping with this name, with parameters that replace its defaults, such as `pole_mass_kg=0.55`.

        Args:
            name: registered, or announced by an installed package (entry points `animat.robots`, `animat.mappings`); or
                the place to import it from, `my_package.robots:Rover`, which also registers it.

        Raises:
            InvalidArgument: for an unknown name or parameter, a refused value, or a class that cannot be imported or
                registered.
        """
        if isinstance(name, str) and name in self._ours and not parameters:
            return self._ours[name]
        if (family := self._family_of(name)) is not None:
            return family.named(name.partition(":")[2], **parameters)  # type: ignore[no-any-return]
        kind = self.class_named(name)
        known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
        for parameter in parameters:
            if parameter not in known:
                raise InvalidArgument(
                    f"{name}: expected parameters among {', '.join(known) or 'none'}, got {shown(parameter)}"
                    f"{did_you_mean(parameter, known)}"
                )
        try:
            return kind(**parameters)
        except InvalidArgument as error:
            raise InvalidArgument(f"{name}: {error}") from error
        except Exception as error:
            with_what = f"with {parameters}" if parameters else "without parameters"
            raise InvalidArgument(f"{name}: expected it to be created {with_what}, got {first_line(error)}") from error

    def names(self) -> tuple[str, ...]:
        """All known names: ours, then the user's in the order of registration, then those announced by packages."""
        of_animat = sorted(name for name, kind in self._registered.items() if kind.__module__.startswith("animat."))
        announced = (point.name for point in importlib.metadata.entry_points(group=self.entry_points))
        return tuple(dict.fromkeys([*self._ours, *of_animat, *self._registered, *announced]))

    def name_of(self, name: str) -> str:
        """The registered name for any form of `name` that `named` accepts; raises as `named` does."""
        if (family := self._family_of(name)) is not None:
            # Its class is not looked up: it may need parameters that are not known here.
            family.import_module(name.partition(":")[2])
            return name
        return name if name in self._ours else str(self.class_named(name).name)  # type: ignore[attr-defined]

    def _family_of(self, name: Any) -> type[Any] | None:
        family, colon, _ = str(name).partition(":")
        return self._families.get(family) if colon else None

    def class_named(self, name: str) -> type[Thing]:
        """The class of this name; arguments and errors as in `named`."""
        kind = self._family_of(name) or self._kind(name)
        if kind is None:
            others = "".join(f", and those of {family.capitalize()} by {family}:ID" for family in self._families)
            raise InvalidArgument(
                f"{self.noun}: expected one of {', '.join(self.names())}, got {shown(name)}"
                + (did_you_mean(str(name), self.names()) or f"; name your own by its module:Class{others}")
            )
        return kind

    def to_dict(self, thing: Thing) -> dict[str, Any]:
        """As JSON data with all parameters: `{"name": "cartpole", "parameters": {"force_n": 1.0, ...}}`.

        If it is not ours, the place to import it from is added: `"import": "my_package.robots:Rover"`.
        """
        name = thing.name if self._family_of(thing.name) is None else thing.name.partition(":")[0]  # type: ignore[attr-defined]
        data = {"name": name, "parameters": dataclasses.asdict(thing)}  # type: ignore[call-overload]
        return data if is_ours(thing) else data | {"import": place_of(type(thing))}

    def from_dict(self, data: Mapping[str, Any]) -> Thing:
        """The inverse of `to_dict`.

        Raises:
            InvalidArgument: for malformed data, or an unknown name or parameter; for a class that is not registered it
                says what to import. Nothing is imported because a file says so.
        """
        noun = self.noun
        if (
            not isinstance(data, Mapping)
            or not {"name", "parameters"} <= set(data) <= {"name", "parameters", "import"}
            or not isinstance(data["parameters"], Mapping)
            or not isinstance(data["name"], str)
            or ":" in data["name"]
        ):
            raise InvalidArgument(f'{noun}: expected {{"name": ..., "parameters": {{...}}}}, got {shown(data)}')
        if "import" in data and not _PLACE.fullmatch(place := str(data["import"])):
            raise InvalidArgument(f"{noun}: expected an import from module:Class, got {shown(data['import'])}")
        if "import" in data and self._kind(data["name"]) is None:
            raise InvalidArgument(
                f"{noun}: expected a registered one, got {shown(data['name'])}: import {place.partition(':')[0]} "
                f"first (on the command line: --{noun} {place})"
            )
        parameters = {name: _frozen(value) for name, value in data["parameters"].items()}
        if data["name"] in self._families:
            with within(data["name"]):
                return self._families[data["name"]](**parameters)  # type: ignore[no-any-return]
        return self.named(data["name"], **parameters)

    def expect_loadable(self, thing: Thing, *, in_workers: bool = False) -> None:
        """Refuse a thing that could not be loaded again from a file, or imported (`in_workers`) by a worker process."""
        noun, kind, name = self.noun, type(thing), thing.name  # type: ignore[attr-defined]
        if (name in self._ours and self._ours[name] == thing) or self._family_of(name) is not None:
            return
        is_registered = self._registered.get(name) is kind
        if is_registered and (back := self.from_dict(json.loads(json.dumps(self.to_dict(thing))))) != thing:
            names = [field.name for field in dataclasses.fields(thing)]  # type: ignore[arg-type]
            changed = [name for name in names if getattr(back, name) != getattr(thing, name)]
            expected = "parameters that a policy's file can hold, such as numbers and text"
            raise InvalidArgument(f"{noun}: expected {expected}, got others when read back: {some_of(changed)}")
        if not is_registered:
            raise InvalidArgument(
                f"{noun}: expected a registered one, as a policy's file stores the name of its {noun}, got "
                f"{kind.__name__}, which is not registered: write @animat.register_{noun} above its class, or "
                f"{_IN_MEMORY}"
            )
        place = place_of(kind)
        if in_workers and ("<locals>" in place or place.startswith("__main__:")):
            raise InvalidArgument(
                f"{noun}: expected a class at the top level of a file, which worker processes can import, got {place}: "
                f"put it into a file, or {_IN_MEMORY}"
            )
        if in_workers:
            try:
                pickle.dumps(thing)
            except Exception as error:
                # A user's class may keep anything: a lambda, a lock, an open file.
                raise InvalidArgument(
                    f"{noun}: expected one that can be sent to worker processes (pickled), got {place}, which raised "
                    f"{first_line(error)}: keep only plain parameters in it, and make the rest where it is used, or "
                    f"{_IN_MEMORY}"
                ) from error

    def _kind(self, name: Any) -> type[Thing] | None:
        if not isinstance(name, str):
            return None
        if name in self._registered:
            return self._registered[name]
        if ":" in name:
            return self._import_class(name)
        for point in importlib.metadata.entry_points(group=self.entry_points, name=name):
            found: Any = self._import_class(point.value)
            if found.name != name:
                raise InvalidArgument(
                    f"{self.noun}: expected {point.value} to have the name {name!r}, got {found.name!r}"
                )
            return found  # type: ignore[no-any-return]
        return None

    def _import_class(self, place: str) -> type[Thing]:
        for kind in self._registered.values():
            if place_of(kind) == place:
                return kind
        found: type[Thing] = imported(self.noun, place)
        self.register(found)
        return found

    def _reduce(self, thing: Thing) -> tuple[Any, ...]:
        return self._recreate, (place_of(type(thing)), dataclasses.asdict(thing))  # type: ignore[call-overload]

    def _recreate(self, place: str, parameters: dict[str, Any]) -> Thing:
        try:
            return self._import_class(place)(**parameters)
        except InvalidArgument as error:
            need = "what the script runs under `if __name__ == '__main__':`, as worker processes import it"
            raise InvalidArgument(f"{self.noun}: expected {need}; {error}") from error


def _registry_of(base: type) -> Registry[Any]:
    return _registries[base]


def imported(noun: str, place: str) -> Any:
    """What is at a `module:Name`; InvalidArgument, which calls it a `noun`, if it cannot be imported."""
    module, _, name = place.partition(":")
    if module.endswith(".py"):
        meant = f"{Path(module).stem}:{name}"
        raise InvalidArgument(f"{noun}: expected a module and its class, such as {meant}, got a file, {shown(place)}")
    try:
        return getattr(importlib.import_module(module), name)
    except InvalidArgument:
        raise
    except (Exception, SystemExit) as error:
        # Anything may go wrong in a third-party module. The name of a class has no hyphen.
        is_id = noun == "robot" and re.search(r"-v\d+$", name)
        hint = f"; a Gymnasium environment is gymnasium:{place}" if is_id else ""
        raise InvalidArgument(f"{noun}: expected {place} to be importable, got {first_line(error)}{hint}") from error


def place_of(kind: type) -> str:
    """Where a class can be imported from, as `module:Class`; the module of a script is named after its file."""
    module = kind.__module__
    if module in _MAIN:
        main = sys.modules[module]
        spec, file = getattr(main, "__spec__", None), getattr(main, "__file__", None)
        module = spec.name if spec else Path(file).stem if file else module
    return f"{module}:{kind.__qualname__}"


def is_ours(thing: object) -> bool:
    """Whether it is part of animat, so that its name alone identifies it."""
    return type(thing).__module__.startswith("animat.")


def _frozen(value: Any) -> Any:
    """Turn JSON's lists back into tuples, as parameters must be hashable."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
