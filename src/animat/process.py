"""A process that executes pickled calls from its standard input: on one core, on the GPU, or as plain Python."""

from __future__ import annotations

import ctypes
import os
import pickle
import select
import signal
import subprocess
import sys
from collections import Counter
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

_LARGEST_MIB = 800
"""A process on a core that has grown larger is spent: it keeps compiled programs and tables of past work."""


class Process:
    """A process that executes calls, with the same import path as this one.

    It is pinned to the core `where`; with `gpu` not pinned, and may use the GPU; with `plain` neither, and silent.
    """

    def __init__(self, where: int | Literal["gpu", "plain"]) -> None:
        self._is_on_core, is_plain = isinstance(where, int), where == "plain"
        # A plain process imports installed packages, whatever is in the working folder. Several threads would only use
        # up memory, which is limited.
        options = ["-P", "-W", "ignore"] if is_plain else []
        threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS") if is_plain else ()
        # These include the script's folder or the working folder, where robots may be.
        paths = os.pathsep.join(path for path in sys.path if path and isinstance(path, str))
        self._popen = subprocess.Popen(
            [sys.executable, *options, "-m", "animat.process", str(where)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if is_plain else None,
            # In its own group: Ctrl-C reaches only this process, which then ends the other silently.
            process_group=0,
            env=os.environ | dict.fromkeys(threads, "1") | {"PYTHONPATH": paths},
        )
        self.kill = self._popen.kill

    def answer(self, call: bytes, within_s: float | None = None) -> Any:
        """Execute a call, a pickled (function, arguments, named arguments): returns its result, or raises its error.

        Raises:
            BrokenExecutor: if the process ends during the call.
            TimeoutError: if the answer does not come in time; the process is then killed.
        """
        assert self._popen.stdin is not None and self._popen.stdout is not None
        try:
            pickle.dump(call, self._popen.stdin)
            self._popen.stdin.flush()
            if within_s is not None and not select.select([self._popen.stdout], [], [], within_s)[0]:
                raise TimeoutError(f"no answer within {within_s:g} s")
            answer = pickle.load(self._popen.stdout)
        except BaseException as error:
            self.kill()  # It may still be running, but its answer would no longer be read.
            status = self._popen.wait()
            if isinstance(error, BrokenPipeError | EOFError | pickle.UnpicklingError):
                raise BrokenExecutor(f"its process ended with status {status}") from error
            raise
        value, raised = pickle.loads(answer)
        if raised is not None:
            raise raised
        return value

    @property
    def is_spent(self) -> bool:
        """Whether it has ended or, on a core, has grown too large."""
        if self._popen.poll() is not None:
            return True
        if not self._is_on_core:
            return False
        try:
            resident_pages = int(Path(f"/proc/{self._popen.pid}/statm").read_text().split()[1])
        except FileNotFoundError:  # not on Linux
            return False
        return resident_pages * os.sysconf("SC_PAGE_SIZE") / 2**20 > _LARGEST_MIB

    def end(self) -> None:
        """Kill it and release its resources."""
        self.kill()
        # This closes both pipes, one of which may be broken.
        with suppress(BrokenPipeError), self._popen:
            pass


def main(where: str) -> int:
    """Answer calls until standard input ends."""
    if where != "plain":
        pin_worker(None if where == "gpu" else int(where))

        from animat.compilation import keep_compilations

        keep_compilations()
    # From now on, what libraries and robots print goes to standard error.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            work: bytes = pickle.load(sys.stdin.buffer)
        except EOFError:
            return 0
        pickle.dump(answer(work), answers)
        answers.flush()


def answer(work: bytes) -> bytes:
    """Execute a pickled call; returns, pickled, its result and None, or None and its error."""
    try:
        function, args, kwargs = pickle.loads(work)
        return pickle.dumps((function(*args, **kwargs), None))
    except Exception as error:
        try:
            return pickle.dumps((None, error))
        except Exception:
            return pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}")))


def pin_worker(core: int | None) -> None:
    """Make this process a worker on one core, or on the GPU (None); before JAX or BLAS is loaded."""
    if core is None:
        os.environ.pop("JAX_PLATFORMS", None)
        # Leave memory to other processes, and compute products of 32-bit numbers in 32 bits.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    else:
        # Pinned first: libraries start a thread per usable core, and one pinned core is faster than two shared ones.
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {core})
        # Without the GPU: all workers would share it, and a few networks of 64 units do not fill it.
        os.environ["JAX_PLATFORMS"] = "cpu"
    end_with_parent()


def own_cores(most: int | None = None) -> list[int]:
    """The cores that this process may use, rising; at most `most` of them, with the fewest processes of other runs."""
    cores = sorted(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))
    if most is None or most >= len(cores):
        return cores
    pinned = _pinned_processes()
    return sorted(sorted(cores, key=lambda core: pinned[core])[:most])


def _pinned_processes() -> Counter[int]:
    """How many processes of this module are pinned to each core, whoever started them."""
    pinned = Counter[int]()
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        # The process may have ended meanwhile, or be another user's.
        with suppress(OSError):
            words = file.read_bytes().split(b"\0")
            if b"animat.process" in words[:-2] and words[-2].isdigit():
                pinned[int(words[-2])] += 1
    return pinned


def end_with_parent() -> None:
    """Let the kernel kill this process when the thread, and so the process, that started it ends.

    Only Linux can. Elsewhere a worker ends with the work that it has, as its standard input is then closed.
    """
    PR_SET_PDEATHSIG = 1
    with suppress(AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
