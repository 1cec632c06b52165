"""The extension of a Dask worker (`--preload animat.execution.dask_worker`): a pinned process for each thread."""

from __future__ import annotations

import fcntl
import importlib.metadata
import os
import pickle
import platform
import sys
import tempfile
import time
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor, wait
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TextIO

from animat.errors import AnimatError, InvalidFile
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import store
from animat.process import own_cores

VERSIONS_PREFIX, PLACE_PREFIX = "animat:", "animat-place:"
"""Prefixes of the resources whose names give a worker's software versions and its identity."""
_LOOK_EVERY_S = 0.2
_REPORTED_BYTES = 2**16


@dataclass(frozen=True)
class CallResult:
    """The outcome of a call: its value, the exception it raised, or how its process ended; and its duration."""

    value: Any = None
    error: Exception | None = None
    ended: str | None = None
    took_s: float = 0.0


class _Core:
    """A core and its process, which serves one client only, as the files of another client may differ."""

    def __init__(self, number: int) -> None:
        self._number, self._client = number, ""
        self._processes = PinnedProcesses([number])

    def work(self, call: bytes, client: str, worker: Any, key: object) -> CallResult:
        if client != self._client:
            self._renew()
            self._client = client
        began_s = time.monotonic()
        future = self._processes.submit(_answer, call)
        while not wait([future], _LOOK_EVERY_S).done:
            if not _is_wanted(worker, key):
                self._renew()
                raise AnimatError("nobody is waiting for it any more")
        took_s = time.monotonic() - began_s
        try:
            return CallResult(future.result(), took_s=took_s)
        except BrokenExecutor as error:
            return CallResult(ended=f"{error}, on {platform.node()}", took_s=took_s)
        except Exception as error:
            return CallResult(error=error, took_s=took_s)

    def _renew(self) -> None:
        self._processes.kill_workers()
        self._processes = PinnedProcesses([self._number])


_FREE: SimpleQueue[_Core] = SimpleQueue()
_HELD: list[TextIO] = []


def dask_setup(worker: Any) -> None:
    """Prepare a Dask worker for animat, before the scheduler knows it; called by Dask."""
    threads = worker.state.nthreads
    for core in _own_cores(threads):
        _FREE.put(_Core(core))
    # The second is unique: a worker that replaces this one has a different name.
    for resource in (versions_tag(), f"{PLACE_PREFIX}{uuid.uuid4().hex}"):
        worker.state.total_resources[resource] = worker.state.available_resources[resource] = threads


def work(calls: Sequence[bytes], client: str, longest_s: float, contents: Mapping[str, bytes]) -> list[bytes]:
    """Do pickled calls one after the other on one core, in a thread of a Dask worker; returns the pickled answers.

    Each answer is also reported to the client immediately, unless it is large. If nobody is waiting any more, as the
    client or the scheduler has gone, the process is ended. After `longest_s` no further call is begun. The `contents`
    are files to store in the worker's folder beforehand.
    """
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()
    if contents:
        store(Path(worker.local_directory), contents)
    began_s, answers = time.monotonic(), list[bytes]()
    core = _FREE.get()
    try:
        for call in calls:
            if answers and time.monotonic() - began_s > longest_s:
                break
            answers.append(pickle.dumps(core.work(call, client, worker, key)))
            if len(answers) < len(calls):
                answer = answers[-1] if len(answers[-1]) < _REPORTED_BYTES else None
                worker.log_event(topic_of(client), {"batch": key, "number": len(answers) - 1, "answer": answer})
    finally:
        _FREE.put(core)
    return answers


def topic_of(client: str) -> str:
    """The topic of events about a client's calls."""
    return f"animat-{client}"


@cache
def versions_tag() -> str:
    """The versions on which bits and pickles depend, as the name of one of a worker's `resources`."""
    versions = {name: importlib.metadata.version(name) for name in ("animat", "jax", "jaxlib", "numpy", "optax")}
    return "/".join(f"{name}:{version}" for name, version in {**versions, "Python": platform.python_version()}.items())


def _answer(call: bytes) -> Any:
    function, args, kwargs = pickle.loads(call)
    return function(*args, **kwargs)


def _is_wanted(worker: Any, key: object) -> bool:
    task = worker.state.tasks.get(key)
    return task is not None and task.state == "executing" and worker.status.name in ("running", "paused")


def _own_cores(threads: int) -> list[int]:
    """Cores that no other worker on this machine has; if there are too few, some are shared."""
    folder = Path(tempfile.gettempdir()) / f"animat-cores-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise InvalidFile(f"{folder}: expected a folder of this user, got another user's or a link: remove it")
    allowed, own = own_cores(), []
    for core in allowed:
        # Links are not followed, so that another user's link cannot lead to a file of ours.
        file = os.fdopen(os.open(folder / str(core), os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600), "r+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        # The lock is held until this process ends.
        _HELD.append(file)
        own.append(core)
        if len(own) == threads:
            return own
    print(f"animat: this worker shares cores with others: {threads} needed, {len(own)} free", file=sys.stderr)
    return own + [allowed[i % len(allowed)] for i in range(threads - len(own))]
