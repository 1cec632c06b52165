"""The view of a watched folder; each kind of folder has its own view."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.progress import Speed
from animat.watch.files import json_of

_SPAN_S = 60.0
"""Over which the speed of work is measured."""


class View(abc.ABC):
    """A folder that is viewed repeatedly."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._speed = Speed(_SPAN_S)

    @abc.abstractmethod
    def about(self) -> dict[str, Any]:
        """What does not change while work goes on."""

    @abc.abstractmethod
    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The current view, of the seconds before a time; most views have no clock."""

    def close(self) -> None:  # noqa: B027 - most keep nothing open
        """Close files."""

    def _described(self, name: str, what: str) -> dict[str, Any]:
        """The content of the file that describes every folder of this kind."""
        content = json_of(self.folder / name)
        if not isinstance(content, dict):
            raise InvalidFile(f"{self.folder / name}: expected the description of a {what}, got none")
        return content


def titled(title: str) -> dict[str, Any]:
    """The description of an item with only a title."""
    return {"generation": 0, "title": title}


def in_blocks(state: dict[str, Any], blocks: Sequence[dict[str, Any]], damage: str = "") -> dict[str, Any]:
    """A view made of blocks, with the state of the work."""
    return {"generation": 0, **state, "damage": damage, "blocks": list(blocks)}
