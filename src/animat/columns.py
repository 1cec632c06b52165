"""Tables for a terminal: columns under their names."""

from __future__ import annotations

from collections.abc import Sequence


def align_columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, indented: the first column and the last, which are words, to the left, the others to the right.

    A column that needs no name has an empty one.
    """
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for first, *numbers, last in (head, *rows):
        middle = (cell.rjust(width) for cell, width in zip(numbers, widths[1:-1], strict=True))
        lines.append("  ".join(["", first.ljust(widths[0]), *middle, last]).rstrip())
    return lines
