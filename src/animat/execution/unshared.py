"""Tasks on workers without a shared folder: the files they read are sent along, and the files they write come back."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from animat.errors import InvalidFile
from animat.execution.receipts import digest_of
from animat.execution.task import Task, TaskResult, carry_out
from animat.writing import write_whole

STORE = "animat-files"
"""Folder of the files that a worker was sent, in its own folder."""


@dataclass(frozen=True)
class UnsharedResult:
    """The result of a task, with the contents of the files that it wrote."""

    result: TaskResult
    contents: dict[str, bytes]


def store(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Store contents in a worker's folder, each under its digest."""
    (folder / STORE).mkdir(exist_ok=True)
    for digest, content in contents.items():
        write_whole(folder / STORE / digest, content)


def carry_out_unshared(task: Task, reads: Mapping[str, str], folder: Path) -> UnsharedResult:
    """`carry_out` in a temporary folder made of files in the worker's `folder` (`store`), their digests by place."""
    with tempfile.TemporaryDirectory(dir=folder, prefix="animat-task-") as temporary:
        root = Path(temporary)
        for place, digest in reads.items():
            (root / place).parent.mkdir(parents=True, exist_ok=True)
            try:
                # A link is enough, as tasks replace files and never modify them.
                (root / place).hardlink_to(folder / STORE / digest)
            except FileNotFoundError as error:
                raise InvalidFile(f"{place}: expected it to be sent to the worker, got nothing") from error
        result = carry_out(task, root, root / ".notice" / "task.json")
        return UnsharedResult(result, {place: (root / place).read_bytes() for place in result.files})


def bring_back(unshared: UnsharedResult, folder: Path) -> TaskResult:
    """Write the files that came back into the folder; raises InvalidFile if one differs from what the worker wrote."""
    for place, content in unshared.contents.items():
        if digest_of(write_whole(folder / place, content)) != unshared.result.files[place]:
            raise InvalidFile(f"{folder / place}: expected the file that the worker wrote, got a different one")
    return unshared.result
