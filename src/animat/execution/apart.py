"""Tasks where workers see no common folder: what they read goes along with them, and what they leave comes back."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from animat.errors import InvalidFile
from animat.execution.receipts import digest_of
from animat.execution.task import Done, Task, carry_out
from animat.writing import write_whole

STORE = "animat-files"
"""Folder of what a worker was sent, in its own folder."""


@dataclass(frozen=True)
class DoneApart:
    """What came of a task, with what is in the files that it left."""

    done: Done
    contents: dict[str, bytes]


def store(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Keep contents, each under its digest, in a worker's folder."""
    (folder / STORE).mkdir(exist_ok=True)
    for digest, content in contents.items():
        write_whole(folder / STORE / digest, content)


def carry_out_apart(task: Task, reads: Mapping[str, str], folder: Path) -> DoneApart:
    """`carry_out` in a folder of its own, which is made of what was sent and is gone afterwards.

    In the worker's folder lies what the task reads, of each file, by its place, under what it was stored (`store`).

    Raises:
        InvalidFile: if something was not sent.
        AnimatError: if it fails.
    """
    with tempfile.TemporaryDirectory(dir=folder, prefix="animat-task-") as own:
        at = Path(own)
        for place, digest in reads.items():
            (at / place).parent.mkdir(parents=True, exist_ok=True)
            try:
                # No copy: a task writes files whole, in place of others.
                (at / place).hardlink_to(folder / STORE / digest)
            except FileNotFoundError as error:
                raise InvalidFile(f"{place}: expected it to be sent to the worker, got nothing") from error
        done = carry_out(task, at, at / ".notice" / "task.json")
        return DoneApart(done, {place: (at / place).read_bytes() for place in done.files})


def bring_back(came: DoneApart, folder: Path) -> Done:
    """Write what came back into the folder; raises InvalidFile if it is not what the worker left."""
    for place, content in came.contents.items():
        if digest_of(write_whole(folder / place, content)) != came.done.files[place]:
            raise InvalidFile(f"{folder / place}: expected what the worker left, got something else")
    return came.done
