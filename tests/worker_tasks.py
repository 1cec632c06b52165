"""Tasks and calls that go wrong, grow or wait, for workers in other processes to import."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from animat.errors import InvalidFile, UnsafeStimulus
from animat.execution.task import Task
from animat.progress import Progress

HELD: list[bytearray] = []


def describe_process(holds_mib: int = 0) -> tuple[int, list[int]]:
    """The process and the cores that it may use; afterwards it holds so much memory."""
    print("a library that talks")
    HELD.append(bytearray(os.urandom(1024)) * 1024 * holds_mib)
    return os.getpid(), sorted(os.sched_getaffinity(0))


def refuse(limit: str) -> None:
    """Raise an error that is made of other arguments than its message."""
    raise UnsafeStimulus(limit, "too much")


def rest(seconds: float) -> float:
    """Take so long."""
    time.sleep(seconds)
    return seconds


def die() -> None:
    """End its process."""
    os._exit(7)


class Sized(Task):
    """Its memory grows with something."""

    @property
    def grows_with(self) -> dict[str, object]:
        return {"policies": 10, "culture.channels": 256}


@dataclass(frozen=True)
class Join(Sized):
    """Leaves a file of its name in brackets, around what the files of others hold.

    Attributes:
        log: file that logs when it began, and when it ended.
        until: file for which it waits before it ends.
    """

    name: str
    of: tuple[str, ...] = ()
    log: Path | None = None
    takes_s: float = 0.0
    until: Path | None = None

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        held = "".join((folder / other).read_text() for other in self.of)
        progress.update(1, 2, "half")
        self._say("begins")
        time.sleep(self.takes_s)
        while self.until is not None and not self.until.exists():
            time.sleep(0.01)
        path = folder / self.name
        path.write_text(f"({self.name}{held})")
        self._say("ends")
        return [path]

    def _say(self, what: str) -> None:
        if self.log is not None:
            with self.log.open("a") as file:
                file.write(f"{self.name} {what}\n")


@dataclass(frozen=True)
class Die(Sized):
    """Ends its process."""

    status: int = 7

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        os._exit(self.status)


class Killed(Sized):
    """Is ended as `kill` ends it."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        signal.raise_signal(signal.SIGTERM)
        time.sleep(60.0)
        return []


class Fail(Sized):
    """Fails with an error that says why."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        raise InvalidFile("a.nwb: expected a recording, got none")


class Stumble(Sized):
    """Fails with an error that nobody foresaw."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        raise TypeError("expected an int, got a float\nand so on")


class Starve(Sized):
    """Asks numpy for more memory than any machine has."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        np.zeros(2**58, np.uint8)
        return []
