"""What is shown of a folder that is watched; each kind of folder has a view of its own."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.progress import Speed
from animat.watch.files import json_of

_SPAN_S = 60.0
"""Over which it is measured how fast work goes on."""


class View(abc.ABC):
    """A folder, looked at again and again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._speed = Speed(_SPAN_S)

    @abc.abstractmethod
    def about(self) -> dict[str, Any]:
        """What does not change while it goes on."""

    @abc.abstractmethod
    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """How it is, in the seconds before a time; most have no clock of their own."""

    def close(self) -> None:  # noqa: B027 - most keep nothing open
        """Let go of files."""

    def _described(self, name: str, what: str) -> dict[str, Any]:
        """What the file of this name tells, which every folder of this kind has."""
        found = json_of(self.folder / name)
        if not isinstance(found, dict):
            raise InvalidFile(f"{self.folder / name}: expected the description of a {what}, got none")
        return found


def titled(title: str) -> dict[str, Any]:
    """About what never changes but in its title."""
    return {"generation": 0, "title": title}


def in_blocks(state: dict[str, Any], blocks: Sequence[dict[str, Any]], damage: str = "") -> dict[str, Any]:
    """A view that is made of blocks, below how the work stands."""
    return {"generation": 0, **state, "damage": damage, "blocks": list(blocks)}
