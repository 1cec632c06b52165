"""Figures of a study's pages: written in every format, and shown as PNG with links to the others."""

from __future__ import annotations

from pathlib import Path

from animat.report.html import Picture
from animat.report.style import FORMATS, Figure, save_figure


def save_formats(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure in every format, the PNG first; returns the files."""
    return [save_figure(figure, folder / f"{name}.{ending}") for ending in FORMATS]


def picture_of(folder: Path, name: str, title: str, caption: str, *numbers: str, narrow: Path | None = None) -> Picture:
    """A saved figure for the page in a folder, with links to its other formats and to the files of its numbers."""
    beside = (*(f"{name}.{ending}" for ending in FORMATS[1:]), *numbers)
    return Picture(folder / f"{name}.{FORMATS[0]}", title, caption, beside, narrow)
