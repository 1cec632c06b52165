"""Where jobs are run: one narrow interface, and processes on this machine, one a core."""

from __future__ import annotations

import abc
import contextlib
import json
import os
import pickle
import selectors
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

from animat.errors import AnimatError
from animat.studies.jobs import Job
from animat.studies.specification import Study
from animat.training.worker import start_worker


@dataclass(frozen=True)
class Event:
    """What an executor tells of a job.

    Attributes:
        kind: `"progress"`, `"done"` or `"failed"`.
        share: of the job that is done, for progress.
        words: a remark for progress; what went wrong for a failure.
        files: that it left, when it is done.
        cpu_s: seconds of processor time that it took, when it is done.
    """

    job: str
    kind: Literal["progress", "done", "failed"]
    share: float = 0.0
    words: str = ""
    files: tuple[str, ...] = ()
    cpu_s: float = 0.0


class Executor(abc.ABC):
    """Runs jobs somewhere that sees the study's folder; another machine's engine needs these four and no more."""

    @property
    @abc.abstractmethod
    def free(self) -> int:
        """How many more jobs can be started now."""

    @abc.abstractmethod
    def start(self, job: Job, study: Study, folder: Path) -> None:
        """Start a job whose needs are done; only where `free` is above 0."""

    @abc.abstractmethod
    def wait(self) -> list[Event]:
        """Wait until something is to be told, and tell it."""

    @abc.abstractmethod
    def close(self) -> None:
        """End everything that still runs."""


@final
class Processes(Executor):
    """Processes on this machine, each pinned to a core of its own; they stay for more jobs until they are too large.

    Args:
        workers: how many, at most one a core; None: one a core.
    """

    def __init__(self, workers: int | None = None) -> None:
        cores = sorted(os.sched_getaffinity(0))
        self._cores = cores[: workers or len(cores)]
        self._idle: list[int] = list(reversed(self._cores))
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._jobs: dict[int, str] = {}
        self._needs: dict[int, str] = {}
        self._selector = selectors.DefaultSelector()

    @property
    def free(self) -> int:
        return len(self._idle)

    def start(self, job: Job, study: Study, folder: Path) -> None:
        core = self._idle.pop()
        if core not in self._processes:
            self._processes[core] = self._spawn(core)
        pipe = self._processes[core].stdin
        assert pipe is not None
        self._jobs[core] = job.name
        self._needs[core] = job.task.needs(study)
        try:
            pickle.dump((job.task, study, folder), pipe)
            pipe.flush()
        except BrokenPipeError as error:
            raise self._ended(core) from error

    def wait(self) -> list[Event]:
        told = []
        for key, _ in self._selector.select():
            core: int = key.data
            pipe = self._processes[core].stdout
            assert pipe is not None
            line = pipe.readline()
            if not line:
                raise self._ended(core)
            words = json.loads(line)
            words["files"] = tuple(words.get("files", ()))
            if words.pop("leaves", False):
                self._dismiss(core)
            event = Event(job=self._jobs[core], **words)
            if event.kind != "progress":
                del self._jobs[core]
                self._idle.append(core)
            told.append(event)
        return told

    def close(self) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()
        self._processes.clear()
        self._selector.close()

    def _dismiss(self, core: int) -> None:
        """Let a worker go that has grown too large; the core's next job gets a new one."""
        process = self._processes.pop(core)
        assert process.stdin is not None and process.stdout is not None
        self._selector.unregister(process.stdout)
        process.wait()
        process.stdin.close()
        process.stdout.close()

    def _spawn(self, core: int) -> subprocess.Popen[bytes]:
        process = start_worker("animat.studies.worker", core, subprocess.PIPE)
        assert process.stdout is not None
        self._selector.register(process.stdout, selectors.EVENT_READ, core)
        return process

    def _ended(self, core: int) -> AnimatError:
        status = self._processes[core].wait()
        return AnimatError(
            f"{self._jobs.get(core, 'a worker')}: its process ended with status {status} (is there memory "
            f"enough? {self._needs.get(core, 'it is not known what for')}); start again to go on"
        )
