"""Reads text tables: a header line and one line per row, separated by commas, semicolons or tabs, gzipped or not."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from animat.errors import InvalidFile, counted
from animat.plain_file import expect_plain_file
from animat.recordings.findings import Finding, left_out_findings

GZIP = b"\x1f\x8b"
UNPACKED_BYTES, UNPACKED_RATIO = 2**22, 20
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+", re.ASCII)


@dataclass(frozen=True, eq=False)
class TextTable:
    """A table with its header and cells as text, unchanged from the file.

    `lines` are those of the file on which rows end, counted from 1; `used` are the columns that were looked up.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    used: set[int] = field(default_factory=set)
    findings: list[Finding] = field(default_factory=list)

    def place(self, names: Sequence[str]) -> int | None:
        """The column of the first of several names in the header, as written or `folded`; None if there is none."""
        for name in names:
            heads = self.header if name in self.header else [folded(head) for head in self.header]
            columns = [column for column, head in enumerate(heads) if head == name]
            if len(columns) > 1:
                twice = " and ".join(repr(self.header[i]) for i in columns[:2])
                raise InvalidFile(f"{self.path}, line 1: expected one column {name}, got {twice}; rename one")
            if columns:
                if (head := self.header[columns[0]]) != name:
                    self._note_once("headers-read-as", f"{head!r} of {self.path.name} is read as {name}")
                self.used.add(columns[0])
                return columns[0]
        return None

    def text(self, column: int) -> list[str]:
        """The cells of a column, without surrounding spaces."""
        return [row[column].strip() for row in self.rows]

    def numbers(self, column: int, name: str, *, required: bool = False) -> Float64[np.ndarray, " rows"]:
        """The numbers of a column that errors call `name`, NaN for an empty cell; if required, all must be finite."""
        cells = self.text(column)
        try:
            values = as_numbers(cells)
        except ValueError:
            values = self._with_decimal_commas(cells, name)
        if required and not np.all(np.isfinite(values)):
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            got = repr(cells[row]) if cells[row] else "an empty field"
            raise self.wrong(row, f"{name}: expected a finite number, got {got}")
        return values

    def wrong(self, row: int, what: str) -> InvalidFile:
        """An error about a row, with its line."""
        return InvalidFile(f"{self.path}, line {self.lines[row]}: {what}")

    def _with_decimal_commas(self, cells: list[str], name: str) -> Float64[np.ndarray, " rows"]:
        commas = [row for row, cell in enumerate(cells) if _DECIMAL_COMMA.fullmatch(cell)]
        for row, cell in enumerate(cells):
            if cell and not is_number(cell) and not _DECIMAL_COMMA.fullmatch(cell):
                raise self.wrong(row, f"{name}: expected a number, got {cell!r}")
        # 1,234 may have a thousands separator; 0,123 and 12,5 cannot, and one of these settles it for all. A dot in any
        # cell means that commas are not decimal points.
        if any("." in cell for cell in cells) or all(_THOUSANDS.fullmatch(cells[row]) for row in commas):
            row = commas[0] if commas else 0
            raise self.wrong(row, f"{name}: expected a number with a decimal point, got {cells[row]!r}")
        self._note_once("decimal-commas", f"{name} of {self.path.name} has decimal commas, read as points")
        return as_numbers([cell.replace(",", ".") for cell in cells])

    def note_left_out(self, missing: Sequence[str]) -> None:
        """Add a finding on columns that were not looked up, which may be one of the missing, misspelt."""
        # A line that ends with a separator has an empty column there.
        left_out = [
            name
            for column, name in enumerate(self.header)
            if column not in self.used and (name or any(row[column] for row in self.rows))
        ]
        self.findings.extend(left_out_findings("columns", left_out, self.path.name, missing))

    def _note_once(self, name: str, message: str) -> None:
        if not any(finding.message == message for finding in self.findings):
            self.findings.append(Finding(name, "note", message))


def read_table(path: Path, bare: str | None = None) -> TextTable:
    """Read a text table in UTF-8, gzipped or not, with as many fields in each row as in the header.

    A file without a header may be a single column, whose name is `bare`.
    """
    text = _text(path)
    separator = max(",;\t", key=text.lstrip("\r\n").partition("\n")[0].count)
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    rows, lines = [], []
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise InvalidFile(f"{path}: expected CSV (text in columns), got something else ({error})") from error
    if not rows:
        raise InvalidFile(f"{path}: expected a header line and one line per event, got an empty file")
    # To the reader, a quote that is not closed goes on to the end.
    if (spanned := rows[-1][-1].rstrip().count("\n")) and not text.rstrip().endswith('"'):
        line = text.rstrip().count("\n") + 1 - spanned
        raise InvalidFile(f"{path}, line {line}: expected a quote to be closed, got none")
    header = [name.strip() for name in rows[0]]
    if bare is not None and len(header) == 1 and is_number(header[0]):
        header = [bare]
    else:
        del rows[0], lines[0]
    for row, line in zip(rows, lines, strict=True):
        # Spreadsheets end lines with the separators of empty cells.
        while len(row) > len(header) and not row[-1].strip():
            row.pop()
        if len(row) != len(header):
            missing = "is a field missing, or the file cut off?"
            advice = _advice(row, separator) if len(row) > len(header) else missing
            expected = f"{counted(len(header), 'field')}, as in the header"
            raise InvalidFile(f"{path}, line {line}: expected {expected}, got {len(row)}: {advice}")
    return TextTable(path, header, rows, lines)


def folded(name: str) -> str:
    """A header in lower case, with underscores for spaces and without brackets: `Time (s)` is `time_s`."""
    return re.sub(r"[\s_\-]+", "_", re.sub(r"[()\[\]{}\"']", "", name).strip().casefold())


def as_numbers(cells: Sequence[str]) -> Float64[np.ndarray, " cells"]:
    """Cells as numbers, NaN for an empty one; raises ValueError for any other text, and for 1_2, Python's 12."""
    if any("_" in cell for cell in cells):
        raise ValueError("expected numbers, got text")
    return np.array([cell or "nan" for cell in cells], dtype=np.str_).astype(np.float64)


def whole_numbers(cell: str) -> list[int]:
    """The whole numbers in a cell, separated by spaces; raises ValueError for other text, OverflowError for 65 bits."""
    if "_" in cell:
        raise ValueError("expected whole numbers, got text")
    return [np.int64(word).item() for word in cell.split()]


def is_number(cell: str) -> bool:
    """Whether a cell is a number, including NaN and infinity."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _advice(row: list[str], separator: str) -> str:
    if separator == "," and all(is_number(cell) for cell in row if cell.strip()):
        return "write numbers with decimal points, or separate the columns by semicolons if they have decimal commas"
    return "quote text that contains the separator, or remove the extra field"


def _text(path: Path) -> str:
    try:
        content = expect_plain_file(path).read_bytes()
        if content.startswith(GZIP):
            limit = UNPACKED_BYTES + UNPACKED_RATIO * len(content)
            with gzip.open(io.BytesIO(content)) as packed:
                content = packed.read(limit + 1)
            if len(content) > limit:
                raise InvalidFile(f"{path}: unpacks to over {limit:,} bytes, too many for its size: it is damaged")
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        why = f"got something else ({error.reason}); save it as CSV in UTF-8"
        raise InvalidFile(f"{path}: expected CSV (text in UTF-8), {why}") from error
    except (OSError, EOFError, zlib.error) as error:
        why = f"it cannot be read or is cut off ({error}); copy it again"
        raise InvalidFile(f"{path}: expected a complete file, but {why}") from error
