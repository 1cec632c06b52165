"""An executor of processes on this machine, each pinned to a core before anything is imported in it."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from typing import Any, ParamSpec, TypeVar, final

from animat.process import Process

P = ParamSpec("P")
T = TypeVar("T")


@final
class PinnedProcesses(ThreadPoolExecutor):
    """Threads that each pass their work to their own process, pinned to its own core; None: not pinned, with the GPU.

    A process is started when there is work for it, and reused until it has grown large. If a `with` block is left by an
    error, running work is ended. Work whose process ends raises a `BrokenExecutor`.
    """

    def __init__(self, cores: Sequence[int | None]) -> None:
        super().__init__(len(cores), initializer=self._init_thread)
        self._cores = list(reversed(cores))
        self._local = threading.local()
        self._processes: list[Process] = []
        self._lock, self._is_killed = threading.Lock(), False

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        return super().submit(self._run, pickle.dumps((fn, args, kwargs)))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        super().shutdown(wait, cancel_futures=cancel_futures)
        for process in self._processes if wait else ():
            process.end()

    def kill_workers(self) -> None:
        """Kill all processes immediately, including running ones; as in the executors of Python 3.14."""
        with self._lock:
            self._is_killed = True
            for process in self._processes:
                process.kill()
        self.shutdown(cancel_futures=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.shutdown()
        else:
            self.kill_workers()

    def _init_thread(self) -> None:
        self._local.core, self._local.process = self._cores.pop(), None

    def _run(self, call: bytes) -> Any:
        process: Process | None = self._local.process
        if process is None or process.is_spent:
            with self._lock:
                if self._is_killed:
                    raise BrokenExecutor("its process was ended before it began")
                if process is not None:
                    self._processes.remove(process)
                    self._local.process = None
                    process.end()
                process = self._local.process = Process("gpu" if self._local.core is None else self._local.core)
                self._processes.append(process)
        return process.answer(call)
