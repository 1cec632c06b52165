"""Tasks that train a group of policies: alone on a core, or together with others of their kind on a GPU."""

from __future__ import annotations

import abc
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from animat.execution.task import UNFINISHED, Done, Task, carried_out
from animat.progress import Part, Progress
from animat.training.folder import write_description
from animat.training.group import CHECKPOINT_S, AddPart, Group, save_policies, train_groups
from animat.training.memory import parts_that_fit
from animat.training.policy import Policy
from animat.training.specification import CHUNKS, Training


@dataclass(frozen=True, eq=False)
class Work:
    """A group of policies that is to be trained.

    Attributes:
        group: which, and on what.
        place: the folder of its policies.
        checkpoint: the file of its checkpoint, where it is trained alone.
        checkpoint_s: seconds between checkpoints.
        add_part: as of `animat.training.group.train_group`.
        description: to be written beside the policies; None: it is there already.
    """

    group: Group
    place: Path
    checkpoint: Path
    checkpoint_s: float = CHECKPOINT_S
    add_part: AddPart | None = None
    description: dict[str, Any] | None = None

    def leave(self, policies: Sequence[Policy]) -> list[Path]:
        """Write what came of it; returns the files."""
        files = save_policies(self.group, policies, self.place)
        return files if self.description is None else [*files, write_description(self.place, self.description)]


class Trains(Task):
    """A task that trains a group of policies."""

    @property
    @abc.abstractmethod
    def training(self) -> Training | None:
        """What is trained, as far as it is known before anything is read; None: policies are left as they begin."""

    @abc.abstractmethod
    def prepare(self, folder: Path) -> Work:
        """Read what it needs, with robots and mappings registered; in the process that trains."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        return train_alone(self.prepare(folder), progress)


def train_alone(work: Work, progress: Progress) -> list[Path]:
    """Train a group of policies, going on from its checkpoint; returns the files that are left."""
    progress.update(0, CHUNKS, "compiling")
    files = _trained([work], work.checkpoint, progress)[0]
    work.checkpoint.unlink(missing_ok=True)
    return files


def train_at_once(tasks: Sequence[Trains], folder: Path, notices: Sequence[Path]) -> list[Done]:
    """Carry out tasks that one program does: all of their policies at once, or as many as there is memory for.

    Killed at any moment before it returns and called again with the same tasks, it leaves the same bits. Arguments and
    errors are those of `animat.execution.task.carried_out`.
    """

    def run(progress: Progress) -> list[list[Path]]:
        progress.update(0, CHUNKS, "compiling")
        works = [task.prepare(folder) for task in tasks]
        parts = parts_that_fit([work.group for work in works])
        files, checkpoints = [], []
        for number, part in enumerate(parts):
            of_part = [works[i] for i in part]
            # A checkpoint is of these and no others.
            who = "".join(f"{work.group.fingerprint}{work.group.members}" for work in of_part)
            checkpoints.append(folder / UNFINISHED / f"at-once-{hashlib.sha256(who.encode()).hexdigest()[:16]}.npz")
            of_all = Part(progress, number * CHUNKS, CHUNKS, len(parts) * CHUNKS)
            files += _trained(of_part, checkpoints[-1], of_all, keeps_end=True)
        # Only now: the parts before one that is killed are not trained again.
        for checkpoint in checkpoints:
            checkpoint.unlink(missing_ok=True)
        return files

    return carried_out(tasks, folder, notices, run)


def _trained(
    works: Sequence[Work], checkpoint: Path, progress: Progress, *, keeps_end: bool = False
) -> list[list[Path]]:
    policies = train_groups(
        [work.group for work in works],
        checkpoint,
        progress,
        # Writing one takes time in proportion to the policies.
        checkpoint_s=works[0].checkpoint_s * len(works),
        add_parts=[work.add_part for work in works],
        keeps_end=keeps_end,
    )
    return [work.leave(each) for work, each in zip(works, policies, strict=True)]
