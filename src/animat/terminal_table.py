"""Tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence


def align_columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Indented lines of a table: the first and last column, which are text, aligned left, the others right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for first, *numbers, last in (head, *rows):
        middle = (cell.rjust(width) for cell, width in zip(numbers, widths[1:-1], strict=True))
        lines.append("  ".join(["", first.ljust(widths[0]), *middle, last]).rstrip())
    return lines
