"""What a Dask worker does with its work: `dask worker ADDRESS --preload animat.execution.dask_worker`.

Each of its threads has a core of its own, and a pinned process on it (`PinnedProcesses`) that does the work: compiled
programs leave with it, its death is told apart, and the worker goes on answering the scheduler meanwhile.
"""

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
from animat.execution.apart import store
from animat.execution.pinned import PinnedProcesses

MADE_OF, PLACE = "animat:", "animat-place:"
"""What a worker is made of, and which one it is, as names of its resources."""
_LOOK_EVERY_S = 0.2
_REPORTED_BYTES = 2**16


@dataclass(frozen=True)
class Answer:
    """What came of a call: what it returned, what it raised instead, or how its process ended; and how long it took."""

    value: Any = None
    error: Exception | None = None
    ended: str | None = None
    took_s: float = 0.0


class _Core:
    """A core, and the process on it, which works for one client only: another one's files may have changed."""

    def __init__(self, number: int) -> None:
        self._number, self._client = number, ""
        self._processes = PinnedProcesses([number])

    def work(self, call: bytes, client: str, worker: Any, key: object) -> Answer:
        if client != self._client:
            self._renew()
            self._client = client
        began_s, starved = time.monotonic(), _times_starved()
        future = self._processes.submit(_answer, call)
        while not wait([future], _LOOK_EVERY_S).done:
            if not _is_wanted(worker, key):
                self._renew()
                raise AnimatError("nobody waits for it any more")
        took_s = time.monotonic() - began_s
        try:
            return Answer(future.result(), took_s=took_s)
        except BrokenExecutor as error:
            memory = ", as the machine ran out of memory" if _times_starved() > starved else ""
            return Answer(ended=f"{error}{memory}, on {platform.node()}", took_s=took_s)
        except Exception as error:
            return Answer(error=error, took_s=took_s)

    def _renew(self) -> None:
        self._processes.kill_workers()
        self._processes = PinnedProcesses([self._number])


_FREE: SimpleQueue[_Core] = SimpleQueue()
_HELD: list[TextIO] = []


def dask_setup(worker: Any) -> None:
    """Make a Dask worker one of ours, before the scheduler hears of it; called by Dask."""
    threads = worker.state.nthreads
    for core in _own_cores(threads):
        _FREE.put(_Core(core))
    # The second is of this one alone, and of none that is started in its place.
    for resource in (made_of(), f"{PLACE}{uuid.uuid4().hex}"):
        worker.state.total_resources[resource] = worker.state.available_resources[resource] = threads


def work(calls: Sequence[bytes], client: str, longest_s: float, contents: Mapping[str, bytes]) -> list[bytes]:
    """Do calls one after the other, in a process of its own on a core of its own; in a thread of a Dask worker.

    The client is told of each at once, but for large answers. If nobody waits for them any more, since the client or
    the scheduler has gone, the process is ended.

    Args:
        calls: of each a function, its arguments and its named ones, pickled.
        client: who asks.
        longest_s: what has not begun after so long is left undone, but for the first.
        contents: what is stored in the worker's folder before (`animat.execution.apart.store`).

    Returns:
        The pickled answer (`Answer`) to each call that was done, the first ones.
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
    """Under which a client hears of its calls."""
    return f"animat-{client}"


@cache
def made_of() -> str:
    """The versions that bits and pickles depend on, as the name of one of a worker's `resources`."""
    versions = {name: importlib.metadata.version(name) for name in ("animat", "jax", "jaxlib", "numpy", "optax")}
    return "/".join(f"{name}:{version}" for name, version in {**versions, "Python": platform.python_version()}.items())


def _answer(call: bytes) -> Any:
    function, args, kwargs = pickle.loads(call)
    return function(*args, **kwargs)


def _is_wanted(worker: Any, key: object) -> bool:
    task = worker.state.tasks.get(key)
    return task is not None and task.state == "executing" and worker.status.name in ("running", "paused")


def _times_starved() -> int:
    """How often the kernel of this machine ended a process for want of memory."""
    try:
        counts = dict(line.split() for line in Path("/proc/vmstat").read_text().splitlines())
        return int(counts["oom_kill"])
    except (OSError, ValueError, KeyError):
        return 0


def _own_cores(threads: int) -> list[int]:
    """Cores that no other worker on this machine has; where there are too few, some are shared."""
    folder = Path(tempfile.gettempdir()) / f"animat-cores-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise InvalidFile(f"{folder}: expected a folder of this user's, got another's or a link: remove it")
    allowed, own = sorted(os.sched_getaffinity(0)), []
    for core in allowed:
        # No other user can have put a link there that leads to a file of ours.
        file = os.fdopen(os.open(folder / str(core), os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o600), "r+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        # Until this process ends.
        _HELD.append(file)
        own.append(core)
        if len(own) == threads:
            return own
    print(f"animat: this worker shares cores with others: {threads} needed, {len(own)} free", file=sys.stderr)
    return own + [allowed[i % len(allowed)] for i in range(threads - len(own))]
