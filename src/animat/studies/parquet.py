"""Records as a Parquet table, for programs that read millions of rows; where fastparquet is installed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from animat.writing import atomic_write

MISSING = "fastparquet is not installed: pip install 'animat[parquet]'"


def write_parquet(path: Path, named: Sequence[tuple[str, Any]], kind: type, name: str) -> bool:
    """Write records, as `write_named_records` takes them, complete or absent; numbers that may be None are NaN there.

    Returns whether it was written: not where fastparquet is missing.
    """
    try:
        import fastparquet
    except ImportError:
        return False
    import pandas as pd

    hints = get_type_hints(kind)
    dtypes = {int: "int64", str: object, str | None: object}
    columns = {name: pd.Series([first for first, _ in named], dtype=object)}
    for each in fields(kind):
        values = [getattr(row, each.name) for _, row in named]
        columns[each.name] = pd.Series(values, dtype=dtypes.get(hints[each.name], "float64"))
    strings = [column for column, values in columns.items() if values.dtype == object]
    encodings = {column: "utf8" if column in strings else "infer" for column in columns}
    with atomic_write(path) as beside:
        fastparquet.write(str(beside), pd.DataFrame(columns), object_encoding=encodings, write_index=False)
    return True
