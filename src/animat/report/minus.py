"""One kind of minus: the sign that axes have stands before the numbers of texts too."""

from __future__ import annotations

import re

MINUS = "\u2212"

# Not within a word, a range such as 2-10, an option or a file's name; the exponent's of 1.5e-05 is one.
_HYPHEN = re.compile(r"(?:(?<![\w.\-/])-(?=\.?\d))|(?<=\de)-(?=\d)")


def with_minus(text: str) -> str:
    """A text with a minus sign before each negative number, in place of a hyphen."""
    return _HYPHEN.sub(MINUS, text)
