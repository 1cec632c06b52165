"""Records that are written to files: pydantic checks every field, and the first error is reported in one line."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, dataclass_transform, get_args

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails

from animat.errors import InvalidArgument, did_you_mean, shown
from animat.writing import write_whole

T = TypeVar("T")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


Whole = Annotated[int, Strict(), BeforeValidator(_plain)]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False), BeforeValidator(_plain)]
Flag = Annotated[bool, Strict(), BeforeValidator(_plain)]
"""Strict types, from a file or from numpy: a whole number is accepted as a number; nothing else is converted."""
Positive = Annotated[Number, Field(gt=0)]
FromZero = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Seed = Annotated[Whole, Field(ge=0, le=2**32 - 1)]
"""JAX uses 32 bits of a seed: beyond them, two seeds would give the same draws."""

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
"""What was expected, by the type of pydantic's error."""


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def record(kind: type[T]) -> type[T]:
    """A decorator that makes a class a frozen dataclass whose fields are checked, whether set by Python or a file.

    Invalid values raise InvalidArgument, naming the field, what was expected and what came. What annotations cannot
    express is checked in `__post_init__`, which also raises InvalidArgument.
    """
    # An instance of a subclass is copied: its attributes could change after they were checked.
    config = ConfigDict(extra="forbid", revalidate_instances="subclass-instances")
    made: Any = dataclass(frozen=True, config=config)(kind)
    checked = made.__init__

    def __init__(self: Any, /, *arguments: Any, **named: Any) -> None:
        try:
            checked(self, *arguments, **named)
        except ValidationError as error:
            raise InvalidArgument(_message(error, made)) from error

    made.__init__ = __init__
    return made  # type: ignore[no-any-return]


_adapter: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)
"""Building one takes much longer than checking with it."""


def read_record(kind: type[T], data: Any, where: str = "") -> T:
    """A record, or any other type, from plain data as in a file; missing fields take their defaults.

    InvalidArgument names the key (in `where`, the name of the whole), what was expected and what came.
    """
    try:
        return _adapter(kind).validate_python(data)  # type: ignore[no-any-return]
    except ValidationError as error:
        raise InvalidArgument(_message(error, kind, where)) from error


def json_data(text: str, what: str, like: str = "JSON") -> Any:
    """Plain data from JSON, called `what` in messages; InvalidArgument for other text, or for a repeated name."""
    try:
        return json.loads(text, object_pairs_hook=_each_once)
    except InvalidArgument as error:
        raise InvalidArgument(f"{what}: {error}") from error
    except (ValueError, RecursionError) as error:
        # Also for a number with more digits than Python reads; its advice on that is cut off.
        reason = str(error).partition("; use sys.")[0]
        if isinstance(error, RecursionError):
            # In the same words by all versions of Python.
            reason = "maximum recursion depth exceeded"
        raise InvalidArgument(f"{what}: expected {like}, got malformed text: {reason}") from error


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; of a repeated name, one value would be dropped silently."""
    if repeated := [name for name, times in Counter(name for name, _ in pairs).items() if times > 1]:
        raise InvalidArgument(f"expected each name once, got {_key(repeated[0])} twice")
    return dict(pairs)


def as_json(value: Any) -> Any:
    """The same plain data with None for numbers that JSON cannot express (NaN, infinity)."""
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any) -> Path:
    """Write plain data as JSON (see `as_json`), complete or absent; returns the path."""
    return write_whole(path, json.dumps(as_json(value), indent=1, sort_keys=True) + "\n")


def _message(error: ValidationError, kind: Any, within: str = "") -> str:
    """The first error: where it is, what was expected, and what came."""
    mistake = error.errors(include_url=False)[0]
    loc = mistake["loc"]
    if mistake["type"] == "unexpected_positional_argument":
        return f"{within}{': ' if within else ''}expected at most {len(kind.__pydantic_fields__)} values"
    if loc and isinstance(loc[0], int) and hasattr(kind, "__pydantic_fields__"):
        # A positional argument is located by its number: use its name.
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
        cause = mistake["ctx"]["error"]
        # The error of a nested record begins with the field's name.
        return f"{where}{'.' if isinstance(cause, InvalidArgument) else ': '}{cause}" if where else str(cause)
    return f"{where}{': ' if where else ''}expected {_expected(mistake)}"


def _expected(mistake: ErrorDetails) -> str:
    if mistake["type"] == "missing":
        last = mistake["loc"][-1]
        return "to be given, got nothing" if isinstance(last, str) else f"at least {last + 1} values"
    words = _EXPECTED.get(mistake["type"], mistake["msg"])
    expected, given = words.format(**mistake.get("ctx", {})), shown(mistake["input"])
    if mistake["type"].startswith(("greater", "less")):
        # On the command line whole numbers become floats, such as 5.0.
        expected, given = expected.removesuffix(".0"), given.removesuffix(".0")
    return f"{expected}, got {given}"


def _key(key: str) -> str:
    """A key for a message; in a file a quoted key can be any text."""
    return key if key.isprintable() and len(key) < 60 else shown(key)
