"""The view of a watched folder; each kind of folder has its own view."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from animat.errors import InvalidArgument, InvalidFile, first_line
from animat.folder_kinds import MARKERS, Kind
from animat.progress import Speed
from animat.watch.files import json_of

_MOST_SPAN_S = 60.0
"""Longest span shown at once, and over which the speed of work is measured."""


class View(abc.ABC):
    """A folder of one `kind` that is viewed repeatedly; `file` identifies it."""

    kind: ClassVar[Kind]

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / MARKERS[self.kind][0]
        self._speed = Speed(_MOST_SPAN_S)

    def about(self) -> dict[str, Any]:
        """What does not change while work goes on; errors are those of `view`."""
        with self._reading():
            return self._about()

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The current view, of the seconds before a time (None: now, or the end); most views have no clock.

        Raises InvalidFile if the folder's files cannot be read, or hold something else.
        """
        if not 0 < span_s <= _MOST_SPAN_S:
            raise InvalidArgument(f"span: expected above 0 and at most {_MOST_SPAN_S:g} s, got {span_s:g}")
        with self._reading():
            return self._view(to_s, span_s)

    def close(self) -> None:  # noqa: B027 - most keep nothing open
        """Close files."""

    def _about(self) -> dict[str, Any]:
        return {"generation": 0, "title": self._title()}

    @abc.abstractmethod
    def _title(self) -> str: ...

    @abc.abstractmethod
    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]: ...

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Raise InvalidFile for any other error: anything may be in a file."""
        try:
            yield
        except InvalidFile:
            raise
        except Exception as error:
            raise InvalidFile(f"{self.file}: cannot be shown: {first_line(error)}") from error

    def _manifest(self) -> dict[str, Any]:
        """The content of the file that describes the folder."""
        content = json_of(self.file)
        if not content:
            raise InvalidFile(f"{self.file}: expected the description of a {self.kind}, got none")
        return content


def in_blocks(state: dict[str, Any], blocks: Sequence[dict[str, Any]], damage: str = "") -> dict[str, Any]:
    """A view made of blocks, with the state of the work."""
    return {"generation": 0, **state, "damage": damage, "blocks": list(blocks)}
