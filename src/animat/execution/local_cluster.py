"""A Dask cluster on this machine, to try it out: a scheduler and workers as processes, over TCP on loopback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from animat.errors import AnimatError, InvalidFile, as_invalid_file
from animat.execution.cluster import expect_distributed
from animat.execution.dask_worker import work

_PATIENCE_S = 10.0
_RUN = """
import runpy, sys
from animat.process import end_with_parent
end_with_parent()
runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
"""
"""Runs a module that ends with this process; nothing runs between fork and exec, which is unsafe with JAX's threads."""


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
        # Workers whose scheduler died as they started wait for it forever.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _start(part: str, file: Path, *options: str) -> subprocess.Popen[bytes]:
    quiet = {"DASK_LOGGING__DISTRIBUTED": "critical"}
    module = f"distributed.cli.dask_{part}"
    return subprocess.Popen(
        [sys.executable, "-c", _RUN, module, "--no-dashboard", "--scheduler-file", file, *options],
        # As for pinned processes: robots may be defined next to a script.
        env={**os.environ, **quiet, "PYTHONPATH": os.pathsep.join(sys.path)},
        # Ctrl-C reaches only this process, which then ends the others.
        process_group=0,
    )
