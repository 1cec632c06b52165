"""What is shown of a folder that is watched; each kind of folder has a view of its own."""

from __future__ import annotations

import abc
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from animat.errors import InvalidFile
from animat.watch.files import json_of


class View(abc.ABC):
    """A folder, looked at again and again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._speed = Speed()

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


_SPAN_S, _EVERY_S = 60.0, 1.0


class Speed:
    """Amounts of work that were seen to be done, and when."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()

    def see(self, done: float) -> None:
        """Note that so much is done by now."""
        now_s = time.monotonic()
        if self._seen and done < self._seen[-1][1]:
            self._seen.clear()
        if not self._seen or now_s - self._seen[-1][0] >= _EVERY_S:
            self._seen.append((now_s, done))
        while len(self._seen) > 2 and now_s - self._seen[0][0] > _SPAN_S:
            self._seen.popleft()

    @property
    def per_s(self) -> float | None:
        """In the last minute; None while nothing was seen to be done."""
        if len(self._seen) < 2:
            return None
        (from_s, before), (to_s, after) = self._seen[0], self._seen[-1]
        return (after - before) / (to_s - from_s) if after > before else None

    def left_s(self, left: float) -> float | None:
        """Until so much more is done; None where that is not known."""
        return None if self.per_s is None else left / self.per_s
