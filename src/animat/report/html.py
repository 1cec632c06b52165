"""A report as one HTML file that needs no network: text, tables and figures are embedded."""

from __future__ import annotations

import base64
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

from PIL import Image

from animat.errors import as_invalid_file
from animat.report.style import FORMATS, PNG_DPI
from animat.writing import write_whole

MINUS = "\u2212"
_DRAW_AGAIN = "; run the command again, which draws it again"

# Hyphens that are minus signs: not in words, ranges such as 2-10, options and file names, but in 1.5e-05.
_HYPHEN = re.compile(r"(?:(?<![\w.\-/+])-(?=\.?\d))|(?<=\de)-(?=\d)")


def with_minus(text: str) -> str:
    """The text with the hyphen of each negative number replaced by a minus sign, and "+- " by ±."""
    return _HYPHEN.sub(MINUS, text).replace("+- ", "± ")


def with_links(text: str, files: Sequence[str] = ()) -> str:
    """The text as HTML with minus signs, and with links to these files where they are named."""
    from markupsafe import Markup, escape

    # The longest first, as one name can contain another.
    names = "|".join(re.escape(file) for file in sorted(files, key=len, reverse=True))
    parts = re.split(f"({names})", text) if names else [text]
    link = Markup('<a href="{}">{}</a>')
    # Every second part is a name.
    linked = (link.format(quote(part), part) if i % 2 else escape(with_minus(part)) for i, part in enumerate(parts))
    return Markup("").join(linked)


@dataclass(frozen=True)
class Picture:
    """A figure of the page as PNG, whose title is also its alternative text.

    Attributes:
        beside: files with the same figure in other formats and with its numbers, relative to the page.
        narrow: the PNG for phones, as wide as their screen; None: the same PNG, which scrolls there.
    """

    file: Path
    title: str
    caption: str
    beside: tuple[str, ...] = ()
    narrow: Path | None = None

    @property
    def width_px(self) -> int:
        """Width on the page: 100 pixels per inch, so that text in figures is as large as text around them."""
        with as_invalid_file(self.file, ending=_DRAW_AGAIN), Image.open(self.file) as png:
            return png.width * 100 // PNG_DPI


def picture_of(folder: Path, name: str, title: str, caption: str, *numbers: str, narrow: Path | None = None) -> Picture:
    """A figure of `save_formats` on the page in this folder, with links to its formats and the files of its numbers."""
    beside = (*(f"{name}.{ending}" for ending in FORMATS[1:]), *numbers)
    return Picture(folder / f"{name}.{FORMATS[0]}", title, caption, beside, narrow)


@dataclass(frozen=True)
class Table:
    """A table of the page.

    Attributes:
        rows: of cells: text, numbers (written with three digits) or None (written as a dash).
        beside: the file with all digits, relative to the page.
        marked: highlighted rows, by index.
        folded: whether it is hidden until its title is clicked, as it is long and repeats what is shown elsewhere.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""
    beside: str = ""
    marked: tuple[int, ...] = ()
    folded: bool = False

    def is_text(self, column: int) -> bool:
        """Whether any row has text in the column of this index, which is then aligned to the left."""
        return any(isinstance(row[column], str) for row in self.rows)


Columns: TypeAlias = list[tuple[str, "str | Callable[[Any], Any]"]]
"""Columns of a table of records: the name of each, and the field or function of a record that gives its cell."""


def columns_of(*fields: str) -> Columns:
    """Columns named after their fields, with spaces, and minutes in parentheses."""
    return [(re.sub("_min$", " (min)", name).replace("_", " "), name) for name in fields]


def table_of(title: str, records: Sequence[Any], columns: Columns, **more: Any) -> Table:
    """A table with one row per record; `more` as for `Table`."""
    rows = tuple(tuple(of(each) if callable(of) else getattr(each, of) for _, of in columns) for each in records)
    return Table(title, tuple(name for name, _ in columns), rows, **more)


@dataclass(frozen=True)
class Section:
    """A section of the page: paragraphs, then list items, figures, tables, and verbatim text.

    Where paragraphs and points name files of `links`, which are relative to the page, they link to them.
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    points: tuple[tuple[str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    verbatim: str = ""
    links: tuple[str, ...] = ()


def anchors_of(sections: Sequence[Section]) -> list[str]:
    """A fragment identifier on the page for each section; of sections with nearly the same title each has its own."""
    anchors: list[str] = []
    for section in sections:
        anchor = "".join(letter if letter.isalnum() else "-" for letter in section.title.lower())
        while anchor in anchors:
            anchor += "-"
        anchors.append(anchor)
    return anchors


def write_page(
    path: str | os.PathLike[str], title: str, lead: str, sections: Sequence[Section], colophon: Sequence[str]
) -> Path:
    """Write the page atomically; each section has an entry in the table of contents.

    The lead follows the title, the colophon ends the page. InvalidFile if that cannot be written, or a figure not read.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader, strict = PackageLoader("animat.report", "."), StrictUndefined
    environment = Environment(loader=loader, autoescape=True, undefined=strict, trim_blocks=True, lstrip_blocks=True)
    # Names of files can contain `#` or `:`, which mean something else in a link.
    environment.filters |= {"cell": cell, "prose": with_links, "data_url": _data_url, "url": quote}
    page = environment.get_template("report.html.j2")
    filled = page.render(title=title, lead=lead, sections=sections, anchors=anchors_of(sections), colophon=colophon)
    return write_whole(Path(path), filled)


def _data_url(png: Path) -> str:
    with as_invalid_file(png, ending=_DRAW_AGAIN):
        content = png.read_bytes()
    return "data:image/png;base64," + base64.b64encode(content).decode()


def cell(value: Any) -> str:
    """A cell as text: integers in full, other numbers with at least three digits, a dash for None and NaN."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return with_minus(str(value))
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    whole = isinstance(value, int) or (abs(value) < 1e6 and (value == int(value) or abs(value) >= 999.5))
    # Trailing zeros stay: 23.0 next to 22.4.
    return (f"{value + 0:,.0f}" if whole else f"{value:#.3g}".rstrip(".")).replace("-", MINUS)


def with_error(value: float, error: float | None) -> str:
    """A value and its error, to the error's second significant digit but at most three decimals."""
    if error is None or not (math.isfinite(value) and math.isfinite(error)):
        return f"{cell(value)}\u00a0±\u00a0{cell(error)}"
    decimals = min(3, max(0, 1 - math.floor(math.log10(error)))) if error > 0 else 1
    rounded = f"{error:,.{decimals}f}"
    shown = rounded if error == 0 or round(error, decimals) else f"<\u00a0{10.0**-decimals:.{decimals}f}"
    return f"{value:z,.{decimals}f}\u00a0±\u00a0{shown}".replace("-", MINUS)
