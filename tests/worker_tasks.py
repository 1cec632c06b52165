"""Tasks that go wrong or grow, for workers in other processes to import."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from animat.errors import InvalidFile
from animat.studies.jobs import Report, Task
from animat.studies.specification import Study

HELD: list[bytearray] = []


@dataclass(frozen=True)
class TellProcess(Task):
    """Leaves a file named after the process that ran it, which afterwards holds so much memory."""

    holds_mib: int = 0

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        print("a library that talks")
        HELD.append(bytearray(os.urandom(1024)) * 1024 * self.holds_mib)
        report(0.5, "half")
        path = folder / f"{os.getpid()}"
        path.write_text(str(sorted(os.sched_getaffinity(0))))
        return [path]


@dataclass(frozen=True)
class Die(Task):
    """Ends its process."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        os._exit(7)


@dataclass(frozen=True)
class Fail(Task):
    """Fails with an error that says why."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        raise InvalidFile("a.nwb: expected a recording, got none")


@dataclass(frozen=True)
class Stumble(Task):
    """Fails with an error that nobody foresaw."""

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        raise TypeError("expected an int, got a float\nand so on")


@dataclass(frozen=True)
class Starve(Task):
    """Asks numpy for more memory than any machine has."""

    grows_with = ("policies", "culture.channels")

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        np.zeros(2**58, np.uint8)
        return []
