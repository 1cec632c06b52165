"""Tasks: picklable pieces of work in a folder, and what becomes of one wherever it is carried out."""

from __future__ import annotations

import abc
import fcntl
import json
import os
import platform
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from animat.errors import AnimatError, InvalidFile, first_line, out_of_memory
from animat.execution.receipts import digest_of
from animat.progress import Progress

SILENT_S = 60.0
"""After which a process is taken for frozen."""
UNFINISHED = ".unfinished"
"""Of a folder: checkpoints, and what tasks report while they run; gone when everything is done."""
PLANNED = ".planned.json"
"""In there, of all jobs what they cost, by name, for whoever looks how far it is."""


class Task(abc.ABC):
    """A piece of work: a picklable value without any state, which is carried out in any process."""

    @property
    @abc.abstractmethod
    def grows_with(self) -> Mapping[str, object]:
        """The settings that its memory grows with, and what they are."""

    @property
    def reads_elsewhere(self) -> bool:
        """Whether it reads files that are not in the folder."""
        return False

    @abc.abstractmethod
    def run(self, folder: Path, progress: Progress) -> list[Path]:
        """Do it and return the files that it left, each written whole; done again, they are the same
        (`animat.execution.receipts.digest_of`).

        Args:
            folder: in which all its files are.
            progress: told how far it is.
        """


@dataclass(frozen=True)
class Done:
    """What came of a task: the digest of each file that it left, by its place in the folder; processor seconds."""

    files: dict[str, str]
    cpu_s: float


def carry_out_alone(task: Task, folder: Path, notice: Path) -> Done:
    """`carry_out`, when no other process does: one whose client or scheduler was killed may not have heard of it.

    Raises:
        InvalidFile: if the folder of the notice, which is in that of all files, is not seen here.
        AnimatError: if it fails.
    """
    if not notice.parent.is_dir():
        raise InvalidFile(
            f"{folder}: expected a folder that all workers see, at the same place; {platform.node()} does not see it"
        )
    with notice.with_suffix(".lock").open("a") as lock, _shown_to_live(lock):
        return carry_out(task, folder, notice)


@contextmanager
def _shown_to_live(lock: IO[str]) -> Iterator[None]:
    """Hold a lock, whose file shows all the while that this process lives: nobody waits for one that is frozen.

    Where the file system has no locks, or such a one goes on, two may do the same: each file is whole, and of the same
    bytes.
    """
    seen, seen_s = 0.0, time.monotonic()
    while not _has_locked(lock):
        if (changed := os.fstat(lock.fileno()).st_mtime) != seen:
            seen, seen_s = changed, time.monotonic()
        elif time.monotonic() - seen_s > SILENT_S:
            break
        time.sleep(0.2)
    ended = threading.Event()

    def show() -> None:
        while not ended.wait(SILENT_S / 12):
            os.utime(lock.fileno())

    shows = threading.Thread(target=show, daemon=True)
    shows.start()
    try:
        yield
    finally:
        ended.set()
        shows.join()


def _has_locked(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def carry_out(task: Task, folder: Path, notice: Path) -> Done:
    """Run a task, which tells in a file how far it is (`told`): what an executor is handed, in whatever process.

    Raises:
        AnimatError: if it fails; in one line, also where nobody foresaw it.
    """
    return carried_out([task], folder, [notice], lambda progress: [task.run(folder, progress)])[0]


def carried_out(
    tasks: Sequence[Task], folder: Path, notices: Sequence[Path], run: Callable[[Progress], list[list[Path]]]
) -> list[Done]:
    """Have tasks done together, with arguments and errors as of `carry_out`; `run` returns the files that each left."""
    progress = _Notice(notices)
    progress.update(0, 1)
    began_s = time.process_time()
    try:
        left = run(progress)
    except AnimatError:
        raise
    except Exception as error:
        memory = out_of_memory(error)
        raise AnimatError(_unforeseen(error) if memory is None else f"{memory}: {memory_of(tasks[0])}") from error
    sums = [{file.relative_to(folder).as_posix(): digest_of(file) for file in sorted(files)} for files in left]
    cpu_s = (time.process_time() - began_s) / len(tasks)
    return [Done(each, cpu_s) for each in sums]


class _Notice:
    """A progress in files, each of which is whole whenever it is read; words only in the first of several."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def update(self, done: float, total: float, note: str = "") -> None:
        for path in self._paths:
            # Where it cannot be written, no work is lost.
            with suppress(OSError):
                report(path, (done / total, note if path == self._paths[0] else None))


def report(path: Path, words: Any) -> None:
    """Put something into a file for other processes to see (`reported`); OSError where it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".new")
    beside.write_text(json.dumps(words))
    beside.replace(path)


def reported(path: Path) -> Any:
    """What was reported last (`report`); None if nothing was."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None


def memory_of(task: Task) -> str:
    """What memory is needed for, as a sentence's end."""
    settings = ", ".join(f"{name} ({value!r})" for name, value in task.grows_with.items())
    return f"it grows with {settings}: ask for less, or use a machine with more memory"


def _unforeseen(error: Exception) -> str:
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{first_line(error)} (in {place.name}, {Path(place.filename).name}, line {place.lineno})"
