"""An executor on a Dask cluster (https://distributed.dask.org), and a cluster on this machine, to try one out."""

from __future__ import annotations

import itertools
import json
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures import wait as wait_for
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, final

from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, as_invalid_file, first_line
from animat.execution.dask_worker import VERSIONS_PREFIX, versions_tag, work
from animat.execution.dispatch import LONGEST_S, Call, Dispatch
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Task, TaskResult, bring_back, carry_out_alone, carry_out_unshared
from animat.extras import expect_extra
from animat.process import own_cores

P = ParamSpec("P")
T = TypeVar("T")
_CONNECT_S = 60
_ATTEMPT_S = 2.0
_PATIENCE_S = 10.0
_RUN_MODULE = """
import runpy, sys
from animat.process import end_with_parent
end_with_parent()
runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
"""
"""Runs a module that ends with this process; nothing runs between fork and exec, which is unsafe with JAX's threads."""


def expect_distributed() -> Any:
    """Import Dask's package for clusters; raises AnimatError if it is not installed."""
    return expect_extra("distributed", package="Dask", extra="cluster")


@final
class Cluster(Executor):
    """The workers of a Dask cluster that have the same software versions as this process.

    Args:
        where: the scheduler's address, or the file to which it wrote its address (`dask scheduler --scheduler-file`).
        longest_s: longest duration of a batch of small calls; 0: no batches.
        has_shared_folder: whether workers see a task's folder at the same place; if not, files go through this process.

    Raises:
        AnimatError: if Dask is not installed, or no scheduler answers.
        InvalidArgument, InvalidFile: if `where` is neither.
        Mismatch: if no worker has the same versions.
    """

    def __init__(
        self, where: str | os.PathLike[str], *, longest_s: float = LONGEST_S, has_shared_folder: bool = True
    ) -> None:
        distributed = expect_distributed()
        address = _address(where)
        self._refused: set[str] = set()
        self._futures: set[Future[Any]] = set()
        self._has_shared_folder, self._local = has_shared_folder, PinnedProcesses(own_cores()[-1:])
        with ExitStack() as closing:
            # `Dispatch` reports losses itself.
            for logger in map(logging.getLogger, ("distributed", "distributed.client")):
                closing.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
            try:
                _expect_listener(address)
                self._client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
            except (OSError, ValueError) as error:
                raise AnimatError(f"cluster: {where}: no scheduler answers ({first_line(error)}); start it") from error
            closing.callback(self._client.close)
            workers = self._client.scheduler_info()["workers"]
            if workers and not self._usable(workers):
                raise Mismatch(f"cluster: {_why_refused(*next(iter(workers.items())))}, and there is no other")
            self._closing = closing.pop_all()
        if not workers:
            print("cluster: waiting for workers", file=sys.stderr)
        self._dispatch = Dispatch(self._client, self._usable, longest_s)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Submit a call, which is pickled immediately; raises AnimatError if the scheduler has ended."""
        pickled = pickle.dumps((fn, args, kwargs))
        return self._submit(Call(fn.__name__, lambda _: pickled))

    def submit_task(
        self, task: Task, folder: Path, notice: Path, *, name: str, cost_s: float, reads: Mapping[str, str]
    ) -> Future[TaskResult]:
        """Submit a job's task (`carry_out_alone`); `reads` has the digests of the files in the folder that it reads."""
        if self._has_shared_folder:
            pickled = pickle.dumps((carry_out_alone, (task, folder, notice), {}))
            return self._submit(Call(name, lambda _: pickled, cost_s))
        if task.reads_elsewhere:
            return self._local.submit(carry_out_alone, task, folder, notice)
        return self._submit(
            Call(
                name,
                lambda worker_folder: pickle.dumps((carry_out_unshared, (task, dict(reads), worker_folder), {})),
                cost_s,
                reads={digest: folder / place for place, digest in reads.items()},
                finish=lambda came_back: bring_back(folder, *came_back),
            )
        )

    def cores(self) -> int:
        """The number of cores that its workers have now; 1 if there is no worker yet."""
        return max(1, sum(map(int, self._client.nthreads().values())))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Shut the executor down; running calls are ended unless `wait`."""
        if wait and not cancel_futures:
            wait_for(list(self._futures))
            self._local.shutdown()
        else:
            self._local.kill_workers()
        self._dispatch.close()
        self._closing.close()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(wait=kind is None)

    def _submit(self, call: Call) -> Future[Any]:
        if self._client.status != "running":
            raise AnimatError("the cluster's scheduler has ended; start it, then run this again to continue")
        self._futures.add(call.future)
        call.future.add_done_callback(self._futures.discard)
        self._dispatch.submit(call)
        return call.future

    def _usable(self, workers: dict[str, Any]) -> dict[str, Any]:
        """The workers with the same versions; a warning names each of the others, once, if there are any of these."""
        usable = {address: worker for address, worker in workers.items() if versions_tag() in worker["resources"]}
        refused = workers.keys() - usable.keys()
        for address in refused - self._refused if usable else ():
            print(f"warning: {_why_refused(address, workers[address])}", file=sys.stderr)
            self._refused.add(address)
        return usable


def _why_refused(address: str, worker: dict[str, Any]) -> str:
    tags = [name for name in worker["resources"] if name.startswith(VERSIONS_PREFIX)]
    got = _format_tag(tags[0]) if tags else "one that was started without --preload " + work.__module__
    return f"worker {address}: expected {_format_tag(versions_tag())}, got {got}; it gets no work"


def _expect_listener(address: str) -> None:
    """Wait for a listener, as Dask's own wait cannot be interrupted; raises OSError or ValueError if there is none."""
    kind, has_kind, place = address.rpartition("://")
    host, _, port = place.rpartition(":")
    if has_kind and kind != "tcp":
        return
    until_s = time.monotonic() + _CONNECT_S
    for attempt in itertools.count():
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_ATTEMPT_S).close()
            return
        except OSError:
            if time.monotonic() > until_s:
                raise
        if attempt == 0:
            print(f"cluster: waiting up to {_CONNECT_S} s for the scheduler at {address}", file=sys.stderr)
        time.sleep(0.2)


def _address(where: str | os.PathLike[str]) -> str:
    path = Path(where)
    if path.is_file():
        try:
            return str(json.loads(path.read_text())["address"])
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise InvalidFile(f"cluster: {path}: expected a scheduler's file, got one without an address") from error
    if ":" not in str(where):
        raise InvalidArgument(
            f"cluster: expected a scheduler's address, such as tcp://host:8786, or its file, got {str(where)!r}, "
            "which is not a file"
        )
    kind, _, place = str(where).rpartition("://")
    if kind.lower() in ("", "tcp", "tls") and not place.rpartition(":")[2].isdecimal():
        raise InvalidArgument(f"cluster: expected an address that ends in a port, such as tcp://host:8786, got {where}")
    return str(where)


def _format_tag(tag: str) -> str:
    return tag.replace("/", ", ").replace(":", " ")


@contextmanager
def local_cluster(workers: int, file: Path, *, threads: int = 1) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler and workers until the block ends; a worker that dies is replaced.

    The scheduler writes its address to the file, which may not exist yet, and is removed at the end; its folder is
    created if it is missing. Yields the processes of the scheduler and of the workers' nanny.
    """
    expect_distributed()
    if file.exists():
        got = "a folder" if file.is_dir() else "one; another cluster may be running: stop it, or remove the file"
        raise InvalidFile(f"{file}: expected no file, got {got}")
    with as_invalid_file(file, "cannot be written"):
        file.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        stack.callback(file.unlink, missing_ok=True)
        scheduler = _start("scheduler", file, "--host", "127.0.0.1", "--port", "0")
        stack.callback(_stop, scheduler)
        while not file.exists():
            if scheduler.poll() is not None:
                raise AnimatError(f"{file}: the scheduler ended before it wrote its address there; see its output")
            time.sleep(0.1)
        counts = ("--nworkers", str(workers), "--nthreads", str(threads))
        nanny = _start("worker", file, *counts, "--preload", work.__module__)
        stack.callback(_stop, nanny)
        yield [scheduler, nanny]


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        # A worker whose scheduler died while it started would wait for it for ever.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _start(part: str, file: Path, *options: str) -> subprocess.Popen[bytes]:
    module = f"distributed.cli.dask_{part}"
    # The path as for pinned processes: robots may be defined next to a script.
    own = {"DASK_LOGGING__DISTRIBUTED": "critical", "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        [sys.executable, "-c", _RUN_MODULE, module, "--no-dashboard", "--scheduler-file", file, *options],
        env={**os.environ, **own},
        # Ctrl-C reaches only this process, which then ends the others.
        process_group=0,
    )
