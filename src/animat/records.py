"""Records that go to files: pydantic checks every field by its annotation, and the first mistake is told in a line."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar, dataclass_transform, get_args

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails

from animat.errors import InvalidArgument, InvalidFile, did_you_mean, shown
from animat.writing import write_whole

T = TypeVar("T")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


Whole = Annotated[int, Strict(), BeforeValidator(_plain)]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False), BeforeValidator(_plain)]
Flag = Annotated[bool, Strict()]
"""As a file has them, or numpy: a whole number is good for a number, and nothing else is turned into anything."""
Positive = Annotated[Number, Field(gt=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Seed = Annotated[Whole, Field(ge=0, le=2**32 - 1)]
"""JAX takes 32 bits of a seed: beyond them two seeds would give the same draws."""

_EXPECTED = {
    "bool_type": "true or false",
    "dataclass_type": "a table",
    "dict_type": "a table",
    "finite_number": "a finite number",
    "float_type": "a number",
    "greater_than": "more than {gt:,}",
    "greater_than_equal": "at least {ge:,}",
    "int_type": "a whole number",
    "invalid_key": "names as keys",
    "is_instance_of": "{class}",
    "less_than": "less than {lt:,}",
    "less_than_equal": "at most {le:,}",
    "list_type": "a list",
    "literal_error": "{expected}",
    "string_too_long": "at most {max_length:,} characters",
    "string_too_short": "at least {min_length:,} character",
    "multiple_argument_values": "it once",
    "string_type": "text",
    "string_unicode": "text",
    "too_long": "at most {max_length:,} entries",
    "too_short": "at least {min_length:,}",
    "tuple_type": "a list",
}
"""What a field is expected to be, by the type of pydantic's error."""


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def record(kind: type[T]) -> type[T]:
    """A decorator: makes a class a frozen dataclass whose fields are checked whoever makes it, Python or a file.

    Making one raises InvalidArgument, naming the field, what was expected and what came. What no annotation says is
    checked in `__post_init__`, which raises InvalidArgument too.
    """
    # A record of a subclass is made anew: its attributes could change after they were checked.
    config = ConfigDict(extra="forbid", revalidate_instances="subclass-instances")
    made: Any = dataclass(frozen=True, config=config)(kind)
    checked = made.__init__

    def __init__(self: Any, /, *arguments: Any, **named: Any) -> None:
        try:
            checked(self, *arguments, **named)
        except ValidationError as error:
            raise InvalidArgument(_told(error, made)) from error

    made.__init__ = __init__
    return made  # type: ignore[no-any-return]


def read_record(kind: type[T], data: Any, where: str = "") -> T:
    """A record, or any other type, from plain data as a file holds them; what is left out has its default.

    `where` is what a message calls the whole.

    Raises:
        InvalidArgument: naming the key, what was expected and what came.
    """
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        raise InvalidArgument(_told(error, kind, where)) from error


def json_data(text: str, what: str, like: str = "JSON") -> Any:
    """Plain data from JSON, which messages call `what`, and expect to be `like`.

    Raises:
        InvalidArgument: for what is not JSON, with the place of the mistake, or a name that is given twice.
    """
    try:
        return json.loads(text, object_pairs_hook=_each_once)
    except InvalidArgument as error:
        raise InvalidArgument(f"{what}: {error}") from error
    except (ValueError, RecursionError) as error:
        # Also a number of more digits than Python reads, where it advises to have it read more.
        said = str(error).partition("; use sys.")[0]
        raise InvalidArgument(f"{what}: expected {like}, got a mistake: {said}") from error


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; of a name that is given twice, one value would be dropped in silence."""
    if twice := [name for name, times in Counter(name for name, _ in pairs).items() if times > 1]:
        raise InvalidArgument(f"expected each name once, got {_key(twice[0])} twice")
    return dict(pairs)


@contextmanager
def in_file(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raises InvalidFile, which names the file, for an argument that is invalid within."""
    try:
        yield
    except InvalidArgument as error:
        raise InvalidFile(f"{path}: {error}") from error


def as_json(value: Any) -> Any:
    """The same plain data with None for numbers that JSON has no word for (NaN, infinite)."""
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any) -> Path:
    """Write plain data as JSON, complete or absent, None for numbers that it has no word for; returns the path."""
    return write_whole(path, json.dumps(as_json(value), indent=1, sort_keys=True) + "\n")


def _told(error: ValidationError, kind: Any, within: str = "") -> str:
    """The first mistake: where it is, what was expected, and what came."""
    mistake = error.errors(include_url=False)[0]
    loc = mistake["loc"]
    if mistake["type"] == "unexpected_positional_argument":
        return f"{within}{': ' if within else ''}expected at most {len(kind.__pydantic_fields__)} values"
    if loc and isinstance(loc[0], int) and hasattr(kind, "__pydantic_fields__"):
        # An argument that was given by its place.
        loc = (list(kind.__pydantic_fields__)[loc[0]], *loc[1:])
    where = ".".join([within] * bool(within) + [_key(part) for part in loc if isinstance(part, str)])
    if mistake["type"] == "unexpected_keyword_argument":
        for part in loc[:-1]:
            kind = get_args(kind)[0] if isinstance(part, int) else kind.__pydantic_fields__[part].annotation
        place = f"in [{where.rpartition('.')[0]}]" if "." in where else "at the top"
        known, given = kind.__pydantic_fields__, str(loc[-1])
        expected = f"expected some of {', '.join(known)}{did_you_mean(given, known)}"
        return f"{_key(given)}: no such setting {place}; {expected}"
    if mistake["type"] == "value_error":
        said = mistake["ctx"]["error"]
        # That of a record within this one begins with the field's name.
        return f"{where}{'.' if isinstance(said, InvalidArgument) else ': '}{said}" if where else str(said)
    return f"{where}{': ' if where else ''}expected {_expected(mistake)}"


def _expected(mistake: ErrorDetails) -> str:
    if mistake["type"] == "missing":
        last = mistake["loc"][-1]
        return "to be given, got nothing" if isinstance(last, str) else f"at least {last + 1} values"
    words = _EXPECTED.get(mistake["type"], mistake["msg"])
    return f"{words.format(**mistake.get('ctx', {}))}, got {shown(mistake['input'])}"


def _key(key: str) -> str:
    """A key as a message names it; in quotes a file lets it be any text."""
    return key if key.isprintable() and len(key) < 60 else shown(key)
