"""Learning curves on their way: processes that train write the rows to files, which the one that waits reads."""

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
    """The file of a group of policies, by the number of its first, which begins anew with the process that trains."""

    def __init__(self, folder: Path, first: int) -> None:
        self._path = _file(folder, first)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text("")

    def add(self, part: Float64[ndarray, "policies columns"]) -> None:
        """Add a part of the training, a row a policy."""
        with self._path.open("a") as file:
            file.write(json.dumps(part.tolist()) + "\n")


class Curves:
    """The rows that were told already, and those that are new; as a progress, it looks for them at each report.

    A training may have no folder. The groups are numbers of policies; each callback is called with each row.
    """

    def __init__(
        self,
        folder: Path | None,
        groups: Sequence[Sequence[int]],
        callbacks: Sequence[TrainingCallback],
        progress: Progress,
    ) -> None:
        self._folder, self._groups, self._callbacks, self._progress = folder, groups, callbacks, progress
        self._told = dict.fromkeys((member for members in groups for member in members), 0)
        self._read: dict[int, int] = {}
        """Of each group's file, how many bytes it had when it was read last."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """Tell the rows that are new, and pass the report on."""
        self.look()
        self._progress.update(done, total, note)

    def look(self) -> None:
        """Tell the rows that are new in the files."""
        if self._folder is None or not self._callbacks:
            return
        for members in self._groups:
            text = _text_of(_file(self._folder, members[0]))
            # The same file again, or a new one as long as the old: its rows were told.
            if len(text) == self._read.get(members[0]):
                continue
            self._read[members[0]] = len(text)
            # The last line may not be whole yet.
            parts = [json.loads(line) for line in text.split("\n")[:-1]]
            for column, member in enumerate(members):
                for part in parts[self._told[member] :]:
                    self._tell(member, part[column])

    def add(self, members: Sequence[int], part: Float64[ndarray, "policies columns"]) -> None:
        """Tell a part of a group that is trained in this process."""
        for member, row in zip(members, part.tolist(), strict=True):
            self._tell(member, row)

    def _tell(self, member: int, row: Sequence[float]) -> None:
        self._told[member] += 1
        iterations, episodes, *numbers = row
        told = CurveRow(f"p{member}", int(iterations), int(episodes), *numbers)
        for callback in self._callbacks:
            callback(told)

    def finish(self, policies: dict[str, Policy]) -> None:
        """Tell the rows that are left: also of policies that were trained before."""
        for member in self._told if self._callbacks else ():
            for row in policies[f"p{member}"].learning_curve[self._told[member] :].tolist():
                self._tell(member, row)


def _file(folder: Path, first: int) -> Path:
    return folder / UNFINISHED / _FOLDER / f"from-p{first}.jsonl"


def _text_of(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:
        return ""
