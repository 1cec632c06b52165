"""A study as a TOML file: reading it strictly, with each mistake in one line; expanding its lists; and writing it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

from animat import plain_file
from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, InvalidFile, in_file
from animat.records import read_record
from animat.studies.source import MOST_ENTRIES
from animat.studies.specification import Arm, Compared, RobotSpec, Study
from animat.training.settings import FORMER as FORMER_SETTINGS

MOST_BYTES = 2**20
"""Of a specification."""
TABLES = ("robots", "arms", "comparisons")
_KEYS = {
    table: {field.name for field in dataclasses.fields(kind)}
    for table, kind in zip(TABLES, (RobotSpec, Arm, Compared), strict=True)
}
FORMER = {
    "": {"conditions": "arms", "limit_resolution": "optimum_resolution", "limit_episodes": "optimum_episodes"},
    "robots": {"limit_resolution": "optimum_resolution"},
    "culture": {"presentations": "trials"},
    "simulators": {"despite": "allow"},
    "algorithm": FORMER_SETTINGS,
}
"""Former names of keys, by table ("" is the top level)."""


@checked_arguments
def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a study's specification.

    Keys are the attributes of `animat.studies.specification.Study` and of the tables in it. A key that is left out has
    its default; an unknown key is refused. Lists in robots, arms and comparisons stand for all combinations.
    Raises InvalidFile, naming the file, the key, what was expected and what came.
    """
    return study_from(read_specification(path), path)


def read_specification(path: str | os.PathLike[str]) -> dict[str, Any]:
    """A specification's file as plain data; raises InvalidFile if it cannot be read, is not TOML or is empty."""
    data = plain_file.read_toml(path, MOST_BYTES)
    if not data:
        raise InvalidFile(f"{path}: expected the settings of a study, got none (animat reproduce is the paper's)")
    return data


def study_from(data: dict[str, Any], path: str | os.PathLike[str]) -> Study:
    """The study from a file's plain data; raises as `read_study` does."""
    if "tune" in data:
        raise InvalidFile(f"{path}: expected a study, got the file of a tuning, with [tune]: use animat tune")
    for name in TABLES:
        if isinstance(table := data.get(name), dict):
            wrote = next((f"[{name}.{key}]" for key, value in table.items() if isinstance(value, dict)), f"[{name}]")
            raise InvalidFile(f"{path}: {name}: expected [[{name}]] for each, and its name in it, got {wrote}")
    with in_file(path):
        return read_record(Study, expand_lists(_with_current_keys(data)))


def _with_current_keys(data: dict[str, Any]) -> dict[str, Any]:
    data = _rename_keys(data, FORMER[""])
    data |= {name: _rename_keys(data[name], names) for name, names in FORMER.items() if name in data}
    culture = data.get("culture")
    # Former files have this in every culture, although only synthetic recordings used it.
    if isinstance(culture, dict) and culture.get("channels") == 256:
        data["culture"] = {key: value for key, value in culture.items() if key != "channels"}
    return data


def _rename_keys(table: Any, names: dict[str, str]) -> Any:
    """The table, or each in a list, with current keys; anything else is refused later."""
    if isinstance(table, list):
        return [_rename_keys(each, names) for each in table]
    if not isinstance(table, dict):
        return table
    # If both names are present, the former one stays and is refused as an unknown key.
    return {key if names.get(key, key) in table else names[key]: value for key, value in table.items()}


def study_to_toml(study: Study) -> str:
    """The study as TOML with every setting; `read_study` returns the same study.

    How a culture is recorded is left out where its recordings are given.
    """
    settings = dataclasses.asdict(study)
    if study.culture.kind == "files":
        settings["culture"] = {key: settings["culture"][key] for key in ("kind", "files", "folders")}
    return "\n".join(_lines(settings, ())) + "\n"


def _lines(table: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    """A table's lines: first its plain values, as TOML requires, then the tables in it."""
    plain: list[str] = []
    inner: list[str] = []
    for key, value in table.items():
        name = ".".join((*path, key))
        if isinstance(value, dict) and value:
            inner += ["", f"[{name}]", *_lines(value, (*path, key))]
        elif isinstance(value, tuple | list) and value and isinstance(value[0], dict):
            for each in value:
                inner += ["", f"[[{name}]]", *_lines(each, (*path, key))]
        elif value is not None:
            plain.append(f"{key} = {_format_value(value)}")
    return plain + inner


def _format_value(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(_format_value(each) for each in value)}]"
    # JSON's text, numbers and booleans are valid TOML except for one character; an empty table is {} in both.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def expand_lists(data: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data with each combination of listed values as a separate entry; in its name `{key}` becomes the value."""
    expanded = dict(data)
    for table in TABLES:
        if isinstance(entries := data.get(table), list):
            expanded[table] = [each for entry in entries for each in _combinations(table, entry)]
            if len(expanded[table]) > MOST_ENTRIES:
                raise InvalidArgument(f"{table}: expected at most {MOST_ENTRIES:,}, got {len(expanded[table]):,}")
    return expanded


def _combinations(table: str, entry: Any) -> Iterator[Any]:
    lists = dict(_lists_in(entry)) if isinstance(entry, dict) else {}
    # Keys that do not exist are reported where the entry is read.
    lists = {path: values for path, values in lists.items() if path[0] in _KEYS[table]}
    if not lists:
        yield entry
        return
    if (n := math.prod(map(len, lists.values()))) > MOST_ENTRIES:
        raise InvalidArgument(f"{table}: expected at most {MOST_ENTRIES:,}, got {n:,} from the lists of one")
    name = entry.get("name")
    for path, values in lists.items():
        if not isinstance(name, str) or (len(values) > 1 and f"{{{path[-1]}}}" not in name):
            raise InvalidArgument(f"{table}.name: expected it to contain {{{path[-1]}}}, which is a list, got {name!r}")
    for product in itertools.product(*lists.values()):
        one = {**entry, **{key: dict(inner) for key, inner in entry.items() if isinstance(inner, dict)}}
        for path, value in zip(lists, product, strict=True):
            inside = one if len(path) == 1 else one[path[0]]
            inside[path[-1]] = value
            one["name"] = one["name"].replace(f"{{{path[-1]}}}", _name_part(value))
        yield one


def _lists_in(entry: dict[str, Any]) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """The lists of plain values by their keys, including those in a table such as `parameters`."""
    for key, value in entry.items():
        inner = {(key, name): each for name, each in value.items()} if isinstance(value, dict) else {(key,): value}
        for path, each in inner.items():
            if isinstance(each, list) and each and not any(isinstance(one, dict | list) for one in each):
                yield path, each


def _name_part(value: Any) -> str:
    if isinstance(value, str):
        # Classes of one's own, such as my_package.robots:Rover: names have no colons.
        return value.replace(":", ".")
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
