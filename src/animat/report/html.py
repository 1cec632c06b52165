"""A report as one HTML file that needs no network: text, tables and figures, all inside."""

from __future__ import annotations

import base64
import math
import os
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from animat.errors import InvalidFile
from animat.report.style import PNG_DPI
from animat.writing import write_whole

TEMPLATE = "report.html.j2"
MINUS = "\u2212"

# Not within a word, a range such as 2-10, an option or a file's name; the exponent's of 1.5e-05 is one.
_HYPHEN = re.compile(r"(?:(?<![\w.\-/+])-(?=\.?\d))|(?<=\de)-(?=\d)")


def with_minus(text: str) -> str:
    """A text with a minus sign before each negative number, in place of a hyphen, and one sign before an error."""
    return _HYPHEN.sub(MINUS, text).replace("+- ", "± ")


def with_links(text: str, files: Sequence[str] = ()) -> str:
    """The same as HTML, in which each of these files is a link where it is named."""
    from markupsafe import Markup, escape

    # The longest first: another's name can be its end.
    names = "|".join(re.escape(with_minus(file)) for file in sorted(files, key=len, reverse=True))
    parts = re.split(f"({names})", with_minus(text)) if names else [with_minus(text)]
    # Every second part is a name.
    linked = (Markup('<a href="{0}">{0}</a>').format(part) if i % 2 else escape(part) for i, part in enumerate(parts))
    return Markup("").join(linked)


@dataclass(frozen=True)
class Picture:
    """A figure of the page.

    Attributes:
        file: the PNG.
        title: in a few words; also the text for those who cannot see it.
        caption: what is to be seen in it.
        beside: names of the same figure in other formats, and of its numbers, relative to the page.
        narrow: the PNG for a telephone, which fits its width; None: the same, which scrolls there.
    """

    file: Path
    title: str
    caption: str
    beside: tuple[str, ...] = ()
    narrow: Path | None = None

    @property
    def data(self) -> str:
        """The PNG as a data address."""
        return _address(self.file)

    @property
    def narrow_data(self) -> str | None:
        """The PNG for a telephone as a data address, where there is one of its own."""
        return None if self.narrow is None else _address(self.narrow)

    @property
    def width_px(self) -> int:
        """Width on the page: a hundred pixels an inch, so that text in figures is as large as text around them."""
        # The first chunk of a PNG starts with the width.
        (width,) = struct.unpack(">I", _bytes(self.file)[16:20])
        return int(width * 100 // PNG_DPI)


@dataclass(frozen=True)
class Table:
    """A table of the page.

    Attributes:
        title: above it.
        head: names of the columns.
        rows: cells: text, numbers (written with three digits) or None (written as a dash).
        note: under it.
        beside: the file that holds all digits, relative to the page.
        marked: rows that stand out, by index.
        folded: shown when its title is clicked, as it is long and something else tells the same.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""
    beside: str = ""
    marked: tuple[int, ...] = ()
    folded: bool = False

    def is_text(self, column: int) -> bool:
        """Whether any row has a text in a column, by index; head and cells then stand at the left."""
        return any(isinstance(row[column], str) for row in self.rows)


Columns: TypeAlias = list[tuple[str, "str | Callable[[Any], Any]"]]
"""Of a table of records: their names, and the field or a function of a record that gives the cell."""


def columns_of(*fields: str) -> Columns:
    """Columns that are called as their fields are, in words."""
    return [(name.replace("_", " "), name) for name in fields]


def table_of(title: str, records: Sequence[Any], columns: Columns, **more: Any) -> Table:
    """A table with a row a record; `more` as of `Table`."""
    rows = tuple(tuple(of(each) if callable(of) else getattr(each, of) for _, of in columns) for each in records)
    return Table(title, tuple(name for name, _ in columns), rows, **more)


@dataclass(frozen=True)
class Section:
    """A section of the page: paragraphs, then points of a list, figures, tables, and a text as it stands in a file.

    Files of `links`, relative to the page, are links where paragraphs and points name them.
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    points: tuple[tuple[str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    verbatim: str = ""
    links: tuple[str, ...] = ()

    @property
    def anchor(self) -> str:
        """Its address on the page."""
        return "".join(letter if letter.isalnum() else "-" for letter in self.title.lower())


def write_page(
    path: str | os.PathLike[str], title: str, lead: str, sections: Sequence[Section], colophon: Sequence[str]
) -> Path:
    """Write the page, complete or absent; each section has an entry in the list of contents.

    The lead stands under the title; the colophon is lines at the end, with versions and seeds.

    Raises:
        InvalidFile: if a figure cannot be read or the page cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("animat.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = cell
    environment.filters["prose"] = with_links
    text = environment.get_template(TEMPLATE).render(title=title, lead=lead, sections=sections, colophon=colophon)
    return write_whole(Path(path), text)


def _bytes(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise InvalidFile(f"{file}: expected a figure, got none: {error.strerror or error}") from error


def _address(file: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(_bytes(file)).decode()


def cell(value: Any) -> str:
    """A cell as text: whole numbers as they are, others with three digits, a dash for None and what is no number."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return with_minus(str(value))
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    whole = value == int(value) and abs(value) < 1e6
    # With the zeros at the end: 23.0 beside 22.4.
    return (f"{int(value):,}" if whole else f"{value:#.3g}".rstrip(".")).replace("-", MINUS)


def with_error(value: float, error: float | None) -> str:
    """A value and its error, to the second digit of the error but no more than three decimals."""
    if error is None or not (math.isfinite(value) and math.isfinite(error)):
        return f"{cell(value)}\u00a0±\u00a0{cell(error)}"
    decimals = min(3, max(0, 1 - math.floor(math.log10(error)))) if error > 0 else 1
    rounded = f"{error:.{decimals}f}"
    told = rounded if error == 0 or float(rounded) else f"<\u00a0{10.0**-decimals:.{decimals}f}"
    return f"{value:.{decimals}f}\u00a0±\u00a0{told}".replace("-", MINUS)
