"""Lists in the place of one value in robots, arms and comparisons of a specification: each of their products is one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

from animat.errors import InvalidArgument
from animat.studies.source import MOST_ENTRIES

TABLES = ("robots", "arms", "comparisons")


def without_lists(data: Mapping[str, Any]) -> dict[str, Any]:
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
