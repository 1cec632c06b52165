"""Jobs: the parts of a study, each of which leaves files that follow from the study and from the jobs it needs."""

from __future__ import annotations

import abc
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar

from animat.errors import InvalidFile
from animat.studies.specification import Study
from animat.writing import written_whole

Report = Callable[[float, str], None]
"""Told now and then the share of a job that is done, and a few words."""


class Task(abc.ABC):
    """What a job does: a picklable value without any state."""

    grows_with: ClassVar[tuple[str, ...]] = ("policies", "episodes")
    """Settings of the study that its memory grows with."""

    def needs(self, study: Study) -> str:
        """What memory is needed for, in a sentence's end: the settings, with what they are in the study."""
        told = ", ".join(f"{name} ({attrgetter(name)(study)!r})" for name in self.grows_with)
        return f"it grows with {told}: ask for less, or use a machine with more memory"

    @abc.abstractmethod
    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        """Do it and return the files that it left, each written whole; done again, they are the same bytes.

        Args:
            study: the specification.
            folder: the study's.
            report: to be told how far it is.
        """


@dataclass(frozen=True)
class Job:
    """A task with a name, what must be done before it, and how long it takes.

    Attributes:
        name: such as `train/cartpole/1-threshold/p0`.
        task: what it does.
        needs: names of the jobs whose files it reads.
        cost_s: about how many seconds of one core it takes, for the order of jobs and the time left.
    """

    name: str
    task: Task
    needs: tuple[str, ...] = ()
    cost_s: float = 1.0


@dataclass(frozen=True)
class Receipt:
    """That a job is done: of which study, from which receipts, and which files it left.

    Attributes:
        inputs: digest of the receipt of each job it needed.
        outputs: SHA-256 of each file, by its place in the folder.
    """

    job: str
    study: str
    inputs: dict[str, str]
    outputs: dict[str, str]

    @property
    def digest(self) -> str:
        """Stands for all of it."""
        return hashlib.sha256(self._text().encode()).hexdigest()

    def _text(self) -> str:
        told: dict[str, Any] = {"job": self.job, "study": self.study, "inputs": self.inputs, "outputs": self.outputs}
        return json.dumps(told, indent=1, sort_keys=True) + "\n"

    def save(self, folder: Path) -> None:
        """Write it, after all files are there."""
        with written_whole(receipt_path(folder, self.job)) as beside:
            beside.write_text(self._text())

    def is_kept(self, folder: Path) -> bool:
        """Whether all files are there as they were left."""
        return not self.changed(folder)

    def changed(self, folder: Path) -> list[str]:
        """The files that are not there any more as they were left."""
        return [name for name, sum_ in self.outputs.items() if not _is_file_of(folder / name, sum_)]

    @staticmethod
    def load(folder: Path, job: str) -> Receipt | None:
        """The receipt of a job; None where there is none.

        Raises:
            InvalidFile: if it cannot be read.
        """
        path = receipt_path(folder, job)
        if not path.exists():
            return None
        try:
            told = json.loads(path.read_text())
            return Receipt(told["job"], told["study"], told["inputs"], told["outputs"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path}: expected a job's receipt, got a file that cannot be read; remove it") from error


def receipt_path(folder: Path, job: str) -> Path:
    """Where a job's receipt lies."""
    # A sign that no name holds: of two jobs none may have the other's.
    return folder / "jobs" / f"{job.replace('/', '+')}.json"


def receipt_of(job: Job, study: str, folder: Path, outputs: Sequence[Path], inputs: dict[str, str]) -> Receipt:
    """The receipt for files that a job just left."""
    sums = {path.relative_to(folder).as_posix(): sha256(path) for path in sorted(outputs)}
    return Receipt(job.name, study, inputs, sums)


def sha256(path: Path) -> str:
    """Of a file's contents."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_file_of(path: Path, sum_: str) -> bool:
    try:
        return sha256(path) == sum_
    except OSError:
        return False


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """Jobs so that each comes after what it needs; first the one that the longest chain of others waits for."""
    by_name = {job.name: job for job in jobs}
    waited_for: dict[str, list[str]] = {job.name: [] for job in jobs}
    for job in jobs:
        for need in job.needs:
            waited_for[need].append(job.name)
    urgency: dict[str, float] = {}

    def urgent(name: str) -> float:
        if name not in urgency:
            urgency[name] = by_name[name].cost_s + max((urgent(other) for other in waited_for[name]), default=0.0)
        return urgency[name]

    # A job is always more urgent than what waits for it, as it takes some time itself.
    return sorted(jobs, key=lambda job: -urgent(job.name))
