"""A study as a TOML file: read strictly, every mistake in one line; lists in it multiplied out; and written again."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

from animat import plain_file
from animat.errors import InvalidArgument, InvalidFile
from animat.records import read_record
from animat.studies.source import MOST_ENTRIES
from animat.studies.specification import Study
from animat.training.settings import FORMER as FORMER_SETTINGS

MOST_BYTES = 2**20
"""Of a specification."""
FORMER = {
    "": {"conditions": "arms", "limit_resolution": "optimum_resolution", "limit_episodes": "optimum_episodes"},
    "robots": {"limit_resolution": "optimum_resolution"},
    "culture": {"presentations": "trials"},
    "simulators": {"despite": "allow"},
    "algorithm": FORMER_SETTINGS,
}
"""What keys are called in files of before, table by table (at the top: none)."""
FORMER_CHANNELS = 256
"""Former files name that many channels of every culture, which only synthetic recordings used; it is ignored."""


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a study's specification.

    Keys are the attributes of `animat.studies.specification.Study` and of the tables in it; what is left out has its
    default; a key that is not known is refused. Lists in robots, arms and comparisons stand for their products
    (`expand_lists`).

    Raises:
        InvalidFile: naming the file, the key, what was expected and what came.
    """
    return study_from(read_toml(path), path)


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """A specification's file as plain data; raises InvalidFile if it cannot be read, is no TOML or is empty."""
    data = plain_file.read_toml(path, MOST_BYTES)
    if not data:
        raise InvalidFile(f"{path}: expected the settings of a study, got none (animat reproduce is the paper's)")
    return data


def study_from(data: dict[str, Any], path: str | os.PathLike[str]) -> Study:
    """The study of a file's plain data; errors as those of `read_study`."""
    if "tune" in data:
        raise InvalidFile(f"{path}: expected a study, got the file of a tuning, with [tune]: give it to animat tune")
    for name in ("robots", "arms", "comparisons"):
        if isinstance(table := data.get(name), dict):
            wrote = next((f"[{name}.{key}]" for key, value in table.items() if isinstance(value, dict)), f"[{name}]")
            raise InvalidFile(f"{path}: {name}: expected [[{name}]] for each, and its name in it, got {wrote}")
    try:
        return read_record(Study, expand_lists(_in_todays_words(data)))
    except InvalidArgument as error:
        raise InvalidFile(f"{path}: {error}") from error


def _in_todays_words(data: dict[str, Any]) -> dict[str, Any]:
    """The same with former keys by their names of today; whatever else is wrong is left for the checks."""
    data = _renamed(data, FORMER[""])
    for name, names in FORMER.items():
        table = data.get(name)
        if isinstance(table, dict):
            data[name] = _renamed(table, names)
        elif isinstance(table, list):
            data[name] = [_renamed(each, names) if isinstance(each, dict) else each for each in table]
    culture = data.get("culture")
    if isinstance(culture, dict) and culture.get("channels") == FORMER_CHANNELS:
        data["culture"] = {key: value for key, value in culture.items() if key != "channels"}
    return data


def _renamed(table: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    found = {}
    for key, value in table.items():
        today = names.get(key, key)
        # Where both are given, the former one is told as a key that is not known.
        found[key if today in table else today] = value
    return found


def study_to_toml(study: Study) -> str:
    """The study as TOML, every setting named; `read_study` gives the same study back."""
    return "\n".join(_lines(dataclasses.asdict(study), ())) + "\n"


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
    # JSON's text, numbers and booleans are TOML's too, but for one sign; an empty table is {} in both.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


TABLES = ("robots", "arms", "comparisons")


def expand_lists(data: Mapping[str, Any]) -> dict[str, Any]:
    """A specification's plain data with all products named, `{key}` in a name replaced by each value.

    What is no table of the right kind is left for the checks. Raises InvalidArgument for a name that does not tell
    products apart, or too many of them.
    """
    found = dict(data)
    for table in TABLES:
        if isinstance(entries := data.get(table), list):
            found[table] = [each for entry in entries for each in _products(table, entry)]
            if len(found[table]) > MOST_ENTRIES:
                raise InvalidArgument(f"{table}: expected at most {MOST_ENTRIES:,}, got {len(found[table]):,}")
    return found


def _products(table: str, entry: Any) -> Iterator[Any]:
    lists = dict(_lists_in(entry)) if isinstance(entry, dict) else {}
    if not lists:
        yield entry
        return
    if (n := math.prod(map(len, lists.values()))) > MOST_ENTRIES:
        raise InvalidArgument(f"{table}: expected at most {MOST_ENTRIES:,}, got {n:,} from the lists in one")
    name = entry.get("name")
    for path, values in lists.items():
        if not isinstance(name, str) or (len(values) > 1 and f"{{{path[-1]}}}" not in name):
            raise InvalidArgument(f"{table}.name: expected {{{path[-1]}}} in it, as that is a list, got {name!r}")
    for product in itertools.product(*lists.values()):
        one = {**entry, **{key: dict(inner) for key, inner in entry.items() if isinstance(inner, dict)}}
        for path, value in zip(lists, product, strict=True):
            inside = one if len(path) == 1 else one[path[0]]
            inside[path[-1]] = value
            one["name"] = one["name"].replace(f"{{{path[-1]}}}", _in_words(value))
        yield one


def _lists_in(entry: dict[str, Any]) -> Iterator[tuple[tuple[str, ...], list[Any]]]:
    """The lists of plain values, also in a table such as `parameters`, by where they are."""
    for key, value in entry.items():
        inner = {(key, name): each for name, each in value.items()} if isinstance(value, dict) else {(key,): value}
        for path, each in inner.items():
            if isinstance(each, list) and each and not any(isinstance(one, dict | list) for one in each):
                yield path, each


def _in_words(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
