"""A study as a TOML file: read strictly, every mistake in one line; and written, so that it can be changed and run."""

from __future__ import annotations

import dataclasses
import json
import os
import tomllib
import types
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from animat.errors import InvalidArgument, InvalidFile, shown
from animat.plain_file import read_plain_text
from animat.studies.specification import Study

T = TypeVar("T")

MOST_BYTES, MOST_ENTRIES = 2**20, 1_000
"""Of a specification, and of a list in it."""

_FORMER_KEYS = {"despite": "allow"}
"""What settings were called in files that are still read."""


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a study's specification.

    Keys are the attributes of `animat.studies.specification.Study` and of the tables in it; what is left out has its
    default; a key that is not known is refused.

    Raises:
        InvalidFile: naming the file, the key, what was expected and what came.
    """
    text = read_plain_text(path, MOST_BYTES)
    try:
        data = tomllib.loads(text)
    except RecursionError as error:
        raise InvalidFile(f"{path}: expected TOML, got lists or tables nested without end") from error
    except ValueError as error:
        # Also a number of more digits than Python reads.
        said = str(error).partition(";")[0]
        raise InvalidFile(f"{path}: expected TOML, got a mistake: {said}") from error
    if not data:
        raise InvalidFile(f"{path}: expected the settings of a study, got none (animat reproduce is the paper's)")
    try:
        return _read(Study, data, "")
    except InvalidArgument as error:
        raise InvalidFile(f"{path}: {error}") from error


def study_to_toml(study: Study) -> str:
    """The study as TOML, every setting named; `read_study` gives the same study back."""
    return "\n".join(_lines(dataclasses.asdict(study), ())) + "\n"


def _read(kind: type[T], data: dict[str, Any], where: str) -> T:
    hints = get_type_hints(kind)
    for former, key in _FORMER_KEYS.items():
        if former in data and key in data:
            raise InvalidArgument(f"{_join(where, former)}: expected {key} alone, which it was called before, got both")
    data = {_FORMER_KEYS.get(key, key): value for key, value in data.items()}
    for key in data:
        if key not in hints:
            place = f"in [{where}]" if where else "at the top"
            raise InvalidArgument(f"{_key(key)}: no such setting {place}; expected some of {', '.join(hints)}")
    required = [
        each.name
        for each in dataclasses.fields(kind)  # type: ignore[arg-type]
        if each.default is dataclasses.MISSING and each.default_factory is dataclasses.MISSING
    ]
    for name in required:
        if name not in data:
            raise InvalidArgument(f"{_join(where, name)}: expected to be given, got nothing")
    return kind(**{key: _value(hints[key], value, _join(where, key)) for key, value in data.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    """The value as its type says; whole numbers are good for numbers, nothing else is turned into anything."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _value(next(each for each in arguments if each is not type(None)), value, where)
    if origin is Literal:
        if value not in arguments:
            raise InvalidArgument(f"{where}: expected one of {', '.join(arguments)}, got {shown(value)}")
        return value
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise _wrong(where, "a table", value)
        return _read(hint, value, where)  # type: ignore[arg-type]
    if origin is tuple:
        return _tuple(arguments, value, where)
    if origin is dict:
        if not isinstance(value, dict):
            raise _wrong(where, "a table of numbers", value)
        return {key: _number(each, _join(where, key)) for key, each in value.items()}
    if hint is float:
        try:
            return float(_number(value, where))
        except OverflowError as error:
            raise _wrong(where, "a number", value) from error
    expected = {int: "a whole number", str: "text", bool: "true or false"}[hint]
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise _wrong(where, expected, value)
    return value


def _tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _wrong(where, "a list", value)
    if len(value) > MOST_ENTRIES:
        raise InvalidArgument(f"{where}: expected at most {MOST_ENTRIES:,} entries, got {len(value):,}")
    if arguments[-1] is Ellipsis:
        return tuple(_value(arguments[0], each, where) for each in value)
    if len(value) != len(arguments):
        raise _wrong(where, f"{len(arguments)} values", value)
    return tuple(_value(hint, each, where) for hint, each in zip(arguments, value, strict=True))


def _number(value: Any, where: str) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong(where, "a number", value)
    return value


def _wrong(where: str, expected: str, value: Any) -> InvalidArgument:
    return InvalidArgument(f"{where}: expected {expected}, got {shown(value)}")


def _join(where: str, key: str) -> str:
    return f"{where}.{_key(key)}" if where else _key(key)


def _key(key: str) -> str:
    """A key as a message names it; in quotes TOML lets it be any text."""
    return key if key.isprintable() and len(key) < 60 else shown(key)


def _lines(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    """TOML wants a table's plain values before the tables in it."""
    inner = {key: value for key, value in table.items() if _is_table(value) or _is_tables(value)}
    lines = [f"{key} = {_written(value)}" for key, value in table.items() if key not in inner and value is not None]
    for key, value in inner.items():
        name = ".".join((*path, key))
        if _is_table(value):
            lines += ["", f"[{name}]", *_lines(value, (*path, key))]
        else:
            for each in value:
                lines += ["", f"[[{name}]]", *_lines(each, (*path, key))]
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and bool(value)


def _is_tables(value: Any) -> bool:
    return isinstance(value, tuple | list) and bool(value) and isinstance(value[0], dict)


def _written(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(_written(each) for each in value)}]"
    # JSON's text, numbers and booleans are TOML's too; an empty table is {} in both.
    return json.dumps(value, ensure_ascii=False)
