"""The files of a study's results: records as JSON, CSV and Parquet, arrays as NumPy's npz, all written atomically."""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints
from zipfile import BadZipFile

import numpy as np

from animat.errors import InvalidArgument, InvalidFile
from animat.extras import install_command
from animat.records import read_record
from animat.writing import atomic_write, write_whole

T = TypeVar("T")


def write_typed(path: Path, value: Any) -> Path:
    """Write records atomically, for `read_typed`."""
    plain = [asdict(each) for each in value] if isinstance(value, Sequence) else asdict(value)
    return write_whole(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_typed(path: Path, kind: type[T]) -> T:
    """Read what `write_typed` wrote; raises InvalidFile if it cannot be read, or is of another version."""
    try:
        return read_record(kind, json.loads(path.read_text()))
    except (OSError, ValueError, RecursionError, InvalidArgument) as error:
        raise InvalidFile(f"{path}: expected results of this study, got a file that cannot be read: {error}") from error


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> Path:
    """Write arrays by name as NumPy's npz, atomically and always as the same bytes."""
    with atomic_write(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return path


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what `write_arrays` wrote; raises InvalidFile if it cannot be read."""
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return dict(arrays)
    except (OSError, ValueError, TypeError, EOFError, BadZipFile, zlib.error) as error:
        raise InvalidFile(f"{path}: expected arrays of this study, got a file that cannot be read: {error}") from error


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Path:
    """Write a CSV file atomically; numbers with all digits, None and NaN as empty cells."""
    known = ([None if cell != cell else cell for cell in row] for row in rows)
    with atomic_write(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(known)
    return path


def write_records(path: Path, kind: type, rows: Iterable[Any]) -> Path:
    """Write records as a CSV file, one column per field."""
    return write_table(path, [field.name for field in fields(kind)], (astuple(row) for row in rows))


def write_of_cultures(path: Path, kind: type, of_each: Mapping[str, Iterable[Any]]) -> Path:
    """Write the records of each culture, by its name, as a CSV file with `culture` as its first column."""
    rows = ((culture, *astuple(row)) for culture, rows in of_each.items() for row in rows)
    return write_table(path, ["culture", *(field.name for field in fields(kind))], rows)


MISSING = f"fastparquet is not installed: {install_command('parquet')}"


def write_parquet(path: Path, kind: type, of_each: Mapping[str, Sequence[Any]]) -> Path | None:
    """Write records as `write_of_cultures` does, with None as NaN; returns None if fastparquet is missing."""
    try:
        import fastparquet
    except ImportError:
        return None
    import pandas as pd

    dtypes = {int: "int64", str: object, str | None: object}
    columns = {"culture": pd.Series([culture for culture, rows in of_each.items() for _ in rows], dtype=object)}
    for name, hint in get_type_hints(kind).items():
        values = [getattr(row, name) for rows in of_each.values() for row in rows]
        columns[name] = pd.Series(values, dtype=dtypes.get(hint, "float64"))
    encodings = {column: "utf8" if values.dtype == object else "infer" for column, values in columns.items()}
    with atomic_write(path) as beside:
        fastparquet.write(str(beside), pd.DataFrame(columns), object_encoding=encodings, write_index=False)
    return path
