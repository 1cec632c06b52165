"""Learning curves during training: training processes write the rows to files, which the waiting process reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float64
from numpy import ndarray

from animat.execution.task import UNFINISHED
from animat.progress import Progress
from animat.training.callbacks import CurveRow, TrainingCallback
from animat.training.policy import Policy

_FOLDER = "curves"


class CurveFile:
    """The file of a group of policies, named by its first policy; each training process starts it again."""

    def __init__(self, folder: Path, first: int) -> None:
        self._path = _file(folder, first)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text("")

    def add(self, chunk: Float64[ndarray, "policies columns"]) -> None:
        """Add one chunk of the training, one row per policy."""
        with self._path.open("a") as file:
            file.write(json.dumps(chunk.tolist()) + "\n")


class Curves:
    """Passes each row to the callbacks once; used as a progress, it looks for new rows at each update.

    Args:
        folder: the training's folder; None for a training in memory.
        groups: numbers of the policies of each group.
        callbacks: functions that are called with each row.
        progress: the progress to which updates are passed on.
    """

    def __init__(
        self,
        folder: Path | None,
        groups: Sequence[Sequence[int]],
        callbacks: Sequence[TrainingCallback],
        progress: Progress,
    ) -> None:
        self._folder, self._groups, self._callbacks, self._progress = folder, groups, callbacks, progress
        self._n_reported = dict.fromkeys((member for members in groups for member in members), 0)
        self._n_bytes: dict[int, int] = {}
        """Size of each group's file when it was last read."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Report new rows, and pass the update on."""
        self.poll()
        self._progress.update(done, total, note)

    def poll(self) -> None:
        """Report the rows that are new in the files."""
        if self._folder is None or not self._callbacks:
            return
        for members in self._groups:
            text = _text_of(_file(self._folder, members[0]))
            # The same file, or a new one of the same size: its rows have been reported.
            if len(text) == self._n_bytes.get(members[0]):
                continue
            self._n_bytes[members[0]] = len(text)
            # The last line may be incomplete.
            chunks = [json.loads(line) for line in text.split("\n")[:-1]]
            for column, member in enumerate(members):
                for chunk in chunks[self._n_reported[member] :]:
                    self._report(member, chunk[column])

    def add(self, members: Sequence[int], chunk: Float64[ndarray, "policies columns"]) -> None:
        """Report one chunk of a group that is trained in this process."""
        for member, row in zip(members, chunk.tolist(), strict=True):
            self._report(member, row)

    def _report(self, member: int, numbers: Sequence[float]) -> None:
        self._n_reported[member] += 1
        iterations, episodes, *others = numbers
        row = CurveRow(f"p{member}", int(iterations), int(episodes), *others)
        for callback in self._callbacks:
            callback(row)

    def finish(self, policies: dict[str, Policy]) -> None:
        """Report the remaining rows, including those of policies that were trained earlier."""
        for member in self._n_reported if self._callbacks else ():
            for row in policies[f"p{member}"].learning_curve[self._n_reported[member] :].tolist():
                self._report(member, row)


def _file(folder: Path, first: int) -> Path:
    return folder / UNFINISHED / _FOLDER / f"from-p{first}.jsonl"


def _text_of(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
