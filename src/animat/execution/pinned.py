"""An executor of processes on this machine, each pinned to a core before anything is imported in it."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, TypeVar, final

P = ParamSpec("P")
T = TypeVar("T")

_LARGEST_MIB = 800
"""A process that has grown beyond it makes way for a new one: compiled programs and tables of past work stay in it."""


@final
class PinnedProcesses(ThreadPoolExecutor):
    """Threads of which each hands its work to a process of its own, on a core of its own.

    A process stays for more work until it has grown large, and ends when the one that made it ends. Left by an error,
    as a context manager, the executor ends what still runs. Work whose process ends raises a `BrokenExecutor`.

    Args:
        cores: one process for each, which is started when there is work for it; a core named twice gets two. None: a
            process that is pinned to no core and may use the GPU.
    """

    def __init__(self, cores: Sequence[int | None]) -> None:
        super().__init__(len(cores), initializer=self._settle)
        self._cores = list(reversed(cores))
        self._mine = threading.local()
        self._processes: list[_Process] = []
        self._lock, self._is_killed = threading.Lock(), False

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """As any executor's; what is called, and with what, is pickled at once."""
        return super().submit(self._hand_over, pickle.dumps((fn, args, kwargs)))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As any executor's."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        for process in self._processes if wait else ():
            process.end()

    def kill_workers(self) -> None:
        """End everything at once, also what runs; as in the executors of Python 3.14."""
        with self._lock:
            self._is_killed = True
            for process in self._processes:
                process.kill()
        self.shutdown(cancel_futures=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill_workers()

    def _settle(self) -> None:
        self._mine.core, self._mine.process = self._cores.pop(), None

    def _hand_over(self, call: bytes) -> Any:
        process: _Process | None = self._mine.process
        if process is None or process.is_spent:
            with self._lock:
                if self._is_killed:
                    raise BrokenExecutor("its process was ended before it began")
                if process is not None:
                    self._processes.remove(process)
                    self._mine.process = None
                    process.end()
                process = self._mine.process = _Process(self._mine.core)
                self._processes.append(process)
        value, error = process.answer(call)
        if error is not None:
            raise error
        return value


def own_cores(most: int | None = None) -> list[int]:
    """The cores that this process may use, or so many of them at most."""
    return sorted(os.sched_getaffinity(0))[:most]


class _Process:
    """A process of `animat.execution.worker`, which imports from where this one does."""

    def __init__(self, core: int | None) -> None:
        self._core = core
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "animat.execution.worker", "gpu" if core is None else str(core)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # In a group of its own: Ctrl-C reaches this process alone, which then ends the other without a word.
            process_group=0,
            # A script's own folder, or the working one: robots may lie there.
            env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if isinstance(p, str))},
        )
        self.kill = self._popen.kill

    def answer(self, call: bytes) -> tuple[Any, Exception | None]:
        """What a call returned, or raised."""
        assert self._popen.stdin is not None and self._popen.stdout is not None
        try:
            pickle.dump(call, self._popen.stdin)
            self._popen.stdin.flush()
            answer = pickle.load(self._popen.stdout)
        except (BrokenPipeError, EOFError, pickle.UnpicklingError) as error:
            if isinstance(error, pickle.UnpicklingError):
                self.kill()  # It may well go on, with nobody to hear it.
            raise BrokenExecutor(f"its process ended with status {self._popen.wait()}") from error
        value, raised = pickle.loads(answer)
        return value, raised

    @property
    def is_spent(self) -> bool:
        """Whether it has ended, or grown large, as what there is for a GPU is from the start."""
        if self._popen.poll() is not None:
            return True
        if self._core is None:
            return False
        resident_pages = int(Path(f"/proc/{self._popen.pid}/statm").read_text().split()[1])
        return resident_pages * os.sysconf("SC_PAGE_SIZE") / 2**20 > _LARGEST_MIB

    def end(self) -> None:
        """End it, and let go of it."""
        self.kill()
        # It closes both pipes, one of which may be broken.
        with suppress(BrokenPipeError), self._popen:
            pass
