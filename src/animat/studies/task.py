"""The base class of a study's tasks, whose files depend only on the study and on the jobs that they need."""

from __future__ import annotations

import abc
import hashlib
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import ClassVar

from animat.execution.task import Task
from animat.progress import Progress
from animat.studies.specification import Study


def derived_seed(*names: object) -> int:
    """A seed derived from the names of what is drawn."""
    return int.from_bytes(hashlib.sha256(repr(names).encode()).digest()[:4], "big") >> 1


def study_seed(study: Study, *names: object) -> int:
    """A seed for what a study draws; none share random numbers, as tests take arms and cultures for independent."""
    return derived_seed(study.seed, study.culture.name, *names)


@dataclass(frozen=True)
class StudyTask(Task):
    """A task that is specified by a study."""

    sizes: ClassVar[tuple[str, ...]] = ("policies", "episodes")
    """Settings of the study with which its memory grows."""

    study: Study

    @property
    def grows_with(self) -> dict[str, object]:
        return {name: attrgetter(name)(self.study) for name in self.sizes}

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        for spec in self.study.robots:
            spec.robot()  # Registers custom robots, so that policies can be loaded.
        return self.make(folder, progress)

    @abc.abstractmethod
    def make(self, folder: Path, progress: Progress) -> list[Path]:
        """Do the work, as `Task.run`, with all robots of the study registered."""
