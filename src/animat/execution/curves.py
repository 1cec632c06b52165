"""Learning curves during training: processes write rows to files, which the waiting one reads for callbacks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from animat.execution.task import UNFINISHED
from animat.progress import Progress
from animat.training.group import Chunk, Group
from animat.training.policy import Policy


@dataclass(frozen=True)
class CurveRow:
    """A row of a policy's learning curve, as in the policy's file: one chunk of the training.

    Attributes:
        policy: name of the policy, such as `p0`.
        iterations: iterations done at the end of the chunk.
        episodes: number of episodes that ended in the chunk.
        mean_return: their mean return; NaN if none ended.
        entropy: entropy of the actions at the end of the chunk, nats, over transitions drawn from the replay.
        alpha: weight of the entropy bonus at that time.
        critic_loss: critics' loss at that time, over the same transitions. Older files lack these three: NaN.
    """

    policy: str
    iterations: int
    episodes: int
    mean_return: float
    entropy: float
    alpha: float
    critic_loss: float


class TrainingCallback(Protocol):
    """A function that `train` calls with each row of each policy, in order, including those from before a continuation.

    It is called in the process that called `train`, and changes nothing that is learned. An exception that it raises
    ends the training, as Ctrl-C does; call `train` again to continue.
    """

    def __call__(self, row: CurveRow) -> None:
        """Process a row."""


class CurveFile:
    """The file of a group of policies, named by its first policy; each training process starts it again."""

    def __init__(self, folder: Path, first: int) -> None:
        self._path = _file(folder, first)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text("")

    def add(self, chunk: Chunk) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps(chunk.tolist()) + "\n")


class Curves:
    """Passes each row to the callbacks once; used as a progress, it looks for new rows in the folder at each update."""

    def __init__(
        self, folder: Path | None, groups: Sequence[Group], callbacks: Sequence[TrainingCallback], progress: Progress
    ) -> None:
        self._folder, self._callbacks, self._progress = folder, callbacks, progress
        self._n_reported = {group.members: 0 for group in groups}
        """The number of chunks of each group that the callbacks have."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Report the rows that are new in the files, and pass the update on."""
        if self._folder is not None and self._callbacks:
            for members, n_reported in self._n_reported.items():
                lines: list[str] = []
                # A file that is missing, or cannot be read just now, is read at a later update.
                with suppress(OSError):
                    # The last line may be incomplete.
                    lines = _file(self._folder, members[0]).read_text().split("\n")[:-1]
                for line in lines[n_reported:]:
                    self.add(members, np.array(json.loads(line)))
        self._progress.update(done, total, note)

    def add(self, members: tuple[int, ...], chunk: Chunk) -> None:
        self._n_reported[members] += 1
        for member, (iterations, episodes, *others) in zip(members, chunk.tolist(), strict=True):
            row = CurveRow(f"p{member}", int(iterations), int(episodes), *others)
            for callback in self._callbacks:
                callback(row)

    def finish(self, policies: dict[str, Policy]) -> None:
        """Report the remaining rows, including those of policies that were trained earlier."""
        for members, n_reported in self._n_reported.items() if self._callbacks else ():
            curves = np.stack([policies[f"p{member}"].learning_curve for member in members], axis=1)
            for chunk in curves[n_reported:]:
                self.add(members, chunk)


def _file(folder: Path, first: int) -> Path:
    return folder / UNFINISHED / "curves" / f"from-p{first}.jsonl"
