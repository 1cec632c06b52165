"""An executor of the workers of a Dask cluster (https://distributed.dask.org), each with a core of its own."""

from __future__ import annotations

import json
import logging
import os
import pickle
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from concurrent.futures import wait as wait_for
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, final

from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch, first_line
from animat.execution.apart import bring_back, carry_out_apart
from animat.execution.dask_worker import MADE_OF, made_of, work
from animat.execution.dispatch import LONGEST_S, Call, Dispatch
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Done, Task, carry_out_alone
from animat.extras import expect_extra

P = ParamSpec("P")
T = TypeVar("T")

_CONNECT_S = 60


def expect_distributed() -> Any:
    """Dask's package for clusters, which is imported nowhere else; raises AnimatError if it is not installed."""
    return expect_extra("distributed", package="Dask", extra="cluster", what="a cluster")


@final
class Cluster(Executor):
    """The workers of a Dask cluster that are made of the same versions as this process.

    Work that fails, or whose process or worker ends, is tried again, three times in all
    (`animat.execution.dispatch.Dispatch`).

    Args:
        where: the scheduler's address, or the file in which it wrote it (`dask scheduler --scheduler-file`).
        longest_s: of a batch of small calls; 0 for none.
        has_shared_folder: whether workers see the folder of a task at the same place; if not, what tasks read and leave
            goes through this process.

    Raises:
        AnimatError: if Dask is not installed, or no scheduler answers.
        InvalidArgument, InvalidFile: if `where` is neither.
        Mismatch: if no worker is made of the same versions.
    """

    def __init__(
        self, where: str | os.PathLike[str], *, longest_s: float = LONGEST_S, has_shared_folder: bool = True
    ) -> None:
        distributed = expect_distributed()
        # What is lost is told by what becomes of the work.
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        address = _address(where)
        try:
            _expect_listener(address)
            self._client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise AnimatError(
                f"cluster: {where}: no scheduler answers ({first_line(error)}); start it again"
            ) from error
        self._refused: set[str] = set()
        self._futures: set[Future[Any]] = set()
        self._has_shared_folder, self._here = has_shared_folder, PinnedProcesses(sorted(os.sched_getaffinity(0))[-1:])
        try:
            self._expect_workers(self._client.scheduler_info()["workers"])
        except BaseException:
            self._client.close()
            raise
        self._dispatch = Dispatch(self._client, self._ours, longest_s)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """As any executor's; what is called, and with what, is pickled at once. AnimatError if the scheduler ended."""
        pickled = pickle.dumps((fn, args, kwargs))
        return self._hand_in(Call(fn.__name__, lambda _: pickled))

    def submit_task(
        self, task: Task, folder: Path, notice: Path, *, name: str, cost_s: float, reads: Mapping[str, str]
    ) -> Future[Done]:
        """Have a task carried out (`carry_out_alone`).

        Args:
            task, folder, notice: as there.
            name, cost_s: as of a `Job`.
            reads: the digest of each file in the folder that it reads, by its place.

        Raises:
            AnimatError: if the scheduler has ended.
        """
        if self._has_shared_folder:
            pickled = pickle.dumps((carry_out_alone, (task, folder, notice), {}))
            return self._hand_in(Call(name, lambda _: pickled, cost_s))
        if task.reads_elsewhere:
            return self._here.submit(carry_out_alone, task, folder, notice)
        return self._hand_in(
            Call(
                name,
                lambda theirs: pickle.dumps((carry_out_apart, (task, dict(reads), theirs), {})),
                cost_s,
                reads={digest: folder / place for place, digest in reads.items()},
                finish=lambda came: bring_back(came, folder),
            )
        )

    def cores(self) -> int:
        """How many cores its workers have now; one if there is no worker yet."""
        return max(1, sum(map(int, self._client.nthreads().values())))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As any executor's; what still runs is ended, if it is not waited for."""
        if wait and not cancel_futures:
            wait_for(list(self._futures))
            self._here.shutdown()
        else:
            self._here.kill_workers()
        self._dispatch.close()
        self._client.close()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.shutdown(wait=kind is None)

    def _hand_in(self, call: Call) -> Future[Any]:
        if self._client.status != "running":
            raise AnimatError("the cluster's scheduler has ended; start it, and then this again to go on")
        self._futures.add(call.future)
        call.future.add_done_callback(self._futures.discard)
        self._dispatch.submit(call)
        return call.future

    def _expect_workers(self, workers: dict[str, Any]) -> None:
        ours = self._ours(workers)
        if workers and not ours:
            raise Mismatch(f"cluster: {_why_refused(next(iter(workers.items())))}, and there is no other")
        if not workers:
            print("cluster: waiting for workers", file=sys.stderr)

    def _ours(self, workers: dict[str, Any]) -> dict[str, Any]:
        """Those that are made of the same; of the others it is said in a line each that they get nothing to do."""
        ours = {address: worker for address, worker in workers.items() if made_of() in worker["resources"]}
        refused = workers.keys() - ours.keys()
        for address in refused - self._refused if ours else ():
            print(f"warning: {_why_refused((address, workers[address]))}", file=sys.stderr)
            self._refused.add(address)
        return ours


def _why_refused(worker: tuple[str, dict[str, Any]]) -> str:
    address, told = worker
    theirs = [name for name in told["resources"] if name.startswith(MADE_OF)]
    got = _in_words(theirs[0]) if theirs else "one that was started without --preload " + work.__module__
    return f"worker {address}: expected {_in_words(made_of())}, got {got}; it gets no work"


@contextmanager
def on_cluster(where: str | None, shared_folder: bool) -> Iterator[Cluster | None]:
    """A cluster for as long as the block takes; None without one, and InvalidArgument for no shared folder then."""
    if where is None:
        if not shared_folder:
            raise InvalidArgument("--no-shared-folder: expected only with --cluster, got no cluster")
        yield None
        return
    with Cluster(where, has_shared_folder=shared_folder) as cluster:
        yield cluster


def _expect_listener(address: str) -> None:
    """Wait until something listens there: Dask's own wait cannot be interrupted. OSError or ValueError if none does."""
    kind, has_kind, place = address.rpartition("://")
    host, _, port = place.rpartition(":")
    if has_kind and kind != "tcp":
        return
    until_s = time.monotonic() + _CONNECT_S
    while True:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()
            return
        except OSError:
            if time.monotonic() > until_s:
                raise
        time.sleep(0.2)


def _address(where: str | os.PathLike[str]) -> str:
    path = Path(where)
    if path.is_file():
        try:
            return str(json.loads(path.read_text())["address"])
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise InvalidFile(f"cluster: {path}: expected a scheduler's file, got one that holds no address") from error
    if ":" not in str(where):
        raise InvalidArgument(
            f"cluster: expected a scheduler's address, such as tcp://host:8786, or its file, got {str(where)!r}, "
            "which is no file"
        )
    return str(where)


def _in_words(made: str) -> str:
    return made.replace("/", ", ").replace(":", " ")
