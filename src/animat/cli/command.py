"""What commands share: how they are run, and the options that come last in the help of each."""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar


@dataclass(frozen=True)
class Command(abc.ABC):
    """A command, whose options are its fields."""

    last: ClassVar[tuple[str, ...]] = ("json",)
    """The options that come last in help, in this order, wherever they are declared."""

    json: bool = field(default=False, kw_only=True)
    """End with a line of JSON"""

    @abc.abstractmethod
    def run(self) -> dict[str, Any]:
        """Do the work, print results, and return them as data for JSON."""


@dataclass(frozen=True)
class FolderCommand(Command):
    """A command that leaves its work in a folder as it goes; the others finish theirs only at their end."""

    last = ("workers", "cluster", "shared_folder", "tensorboard", "out", "watch", "json")

    out: Path = field(kw_only=True)
    watch: bool = field(default=False, kw_only=True)
    """Serve a live page for a browser on this machine; needs animat[watch]"""
