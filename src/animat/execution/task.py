"""Tasks, picklable pieces of work in a folder, and how they are carried out and report progress."""

from __future__ import annotations

import abc
import fcntl
import json
import os
import platform
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from animat.errors import AnimatError, InvalidFile, as_invalid_file, first_line, out_of_memory
from animat.execution.receipts import digest_of
from animat.progress import Progress
from animat.writing import write_whole

SILENT_S = 60.0
"""Silence after which a process is considered frozen."""
UNFINISHED = ".unfinished"
"""Subfolder for checkpoints and the progress of running tasks; removed when everything is done."""
PLANNED = ".planned.json"
"""File in it with the cost of each job by name, from which others compute the progress."""
NOTICES = ".notices"
"""Folder in it with the last progress of each job."""
_STORE = "animat-files"
"""Folder of the files that a worker was sent, in its own folder."""


class Task(abc.ABC):
    """A piece of work: a picklable value without state, which can be carried out in any process."""

    @property
    @abc.abstractmethod
    def grows_with(self) -> Mapping[str, object]:
        """The settings with which its memory grows, and their values."""

    @property
    def reads_elsewhere(self) -> bool:
        """Whether it reads files outside the folder."""
        return False

    @abc.abstractmethod
    def run(self, folder: Path, progress: Progress) -> list[Path]:
        """Run the task in the folder of all its files, and return those it wrote, each atomically and reproducibly."""


@dataclass(frozen=True)
class TaskResult:
    """The result of a task: the digest of each file that it wrote, by its place in the folder, and CPU seconds."""

    files: dict[str, str]
    cpu_s: float


def carry_out_alone(task: Task, folder: Path, notice: Path) -> TaskResult:
    """`carry_out`, once no other process does: the worker of a client that was killed may still be running the task."""
    if not notice.parent.is_dir():
        raise InvalidFile(
            f"{folder}: expected a folder that all workers see, at the same place; {platform.node()} does not see it, "
            "or it was removed during the work"
        )
    with notice.with_suffix(".lock").open("a") as lock, _holding(lock):
        return carry_out(task, folder, notice)


@contextmanager
def _holding(lock: IO[str]) -> Iterator[None]:
    """Hold a lock and keep its file's time current, so that nobody waits for a frozen process.

    If the file system has no locks, or a frozen process continues, two processes may do the same work: each file is
    then written atomically, with the same bytes.
    """
    last_mtime, since_s = 0.0, time.monotonic()
    while not _try_lock(lock):
        if (mtime := os.fstat(lock.fileno()).st_mtime) != last_mtime:
            last_mtime, since_s = mtime, time.monotonic()
        elif time.monotonic() - since_s > SILENT_S:
            break
        time.sleep(0.2)
    ended = threading.Event()

    def touch() -> None:
        while not ended.wait(SILENT_S / 12):
            os.utime(lock.fileno())

    thread = threading.Thread(target=touch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _try_lock(lock: IO[str]) -> bool:
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        # The file system has no locks: see `_holding`.
        pass
    return True


def carry_out(task: Task, folder: Path, notice: Path) -> TaskResult:
    """Run a task, which reports its progress in the file `notice`; every error is an AnimatError in one line."""
    return carry_out_together([task], folder, [notice], lambda progress: [task.run(folder, progress)])[0]


def carry_out_together(
    tasks: Sequence[Task], folder: Path, notices: Sequence[Path], run: Callable[[Progress], list[list[Path]]]
) -> list[TaskResult]:
    """`carry_out` for tasks that `run` does together; it returns the files that each task wrote."""
    progress = _Notice(notices)
    progress.update(0, 1)
    began_s = time.process_time()
    try:
        written = run(progress)
    except AnimatError:
        raise
    except Exception as error:
        if (memory := out_of_memory(error)) is not None:
            raise AnimatError(f"{memory}: {memory_of(tasks[0])}") from error
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"(in {place.name}, {Path(place.filename).name}, line {place.lineno})"
        raise AnimatError(f"{first_line(error, with_place=False)} {where}") from error
    digests = [{file.relative_to(folder).as_posix(): digest_of(file) for file in sorted(files)} for files in written]
    cpu_s = (time.process_time() - began_s) / len(tasks)
    return [TaskResult(files, cpu_s) for files in digests]


class _Notice:
    """A progress that writes to files, each atomically; only the first of several gets the note."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def update(self, done: float, total: float, note: str = "") -> None:
        for path in self._paths:
            # Losing a notice loses no work.
            with suppress(InvalidFile):
                report(path, (done / total, note if path == self._paths[0] else None))


def report(path: Path, data: Any) -> None:
    """Write data to a file for other processes (`reported`); raises InvalidFile if it cannot be written."""
    with as_invalid_file(path, "cannot be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        new = path.with_suffix(".new")
        new.write_text(json.dumps(data))
        new.replace(path)


def reported(path: Path) -> Any:
    """The data last written by `report`; None if there is none."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None


def memory_of(task: Task) -> str:
    """The settings that determine a task's memory, as the end of a sentence."""
    settings = ", ".join(f"{name} ({value!r})" for name, value in task.grows_with.items())
    return f"it grows with {settings}: reduce these, or use a machine with more memory"


def store(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Store contents in a worker's folder, each under its digest."""
    (folder / _STORE).mkdir(exist_ok=True)
    for digest, content in contents.items():
        write_whole(folder / _STORE / digest, content)


def carry_out_unshared(task: Task, reads: Mapping[str, str], folder: Path) -> tuple[TaskResult, dict[str, bytes]]:
    """`carry_out` in a temporary folder of files in the worker's `folder` (`store`), with what it wrote."""
    with tempfile.TemporaryDirectory(dir=folder, prefix="animat-task-") as temporary:
        root = Path(temporary)
        for place, digest in reads.items():
            (root / place).parent.mkdir(parents=True, exist_ok=True)
            try:
                # A link is enough, as tasks replace files and never modify them.
                (root / place).hardlink_to(folder / _STORE / digest)
            except FileNotFoundError as error:
                raise InvalidFile(f"{place}: expected it to be sent to the worker, got nothing") from error
        result = carry_out(task, root, root / ".notice" / "task.json")
        return result, {place: (root / place).read_bytes() for place in result.files}


def bring_back(folder: Path, result: TaskResult, contents: Mapping[str, bytes]) -> TaskResult:
    """Write the files that came back from a worker into the folder; raises InvalidFile for a damaged one."""
    for place, content in contents.items():
        if digest_of(write_whole(folder / place, content)) != result.files[place]:
            raise InvalidFile(f"{folder / place}: expected the file that the worker wrote, got a different one")
    return result
