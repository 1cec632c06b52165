"""A process that does what it is told: on one core, on the GPU, or a plain Python, as the one that reads HDF5.

It is `python -m animat.process CPU`, `gpu` in the place of the core, or `plain`. Calls come pickled on its standard
input, from the process that started it; what they return or raise goes out so too.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import select
import signal
import subprocess
import sys
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

_LARGEST_MIB = 800
"""A process on a core that has grown beyond it is spent: compiled programs and tables of past work stay in it."""


class Process:
    """A process for calls, which imports from where this one does.

    Args:
        where: a core that it is pinned to; `gpu`: pinned to no core, and it may use the GPU; `plain`: neither, and what
            it says on standard error goes nowhere.
    """

    def __init__(self, where: int | Literal["gpu", "plain"]) -> None:
        self._is_on_core, is_plain = isinstance(where, int), where == "plain"
        # A plain one finds what is installed, whatever lies in the working folder. Several threads would only take
        # memory, which is limited.
        options = ["-P", "-W", "ignore"] if is_plain else []
        threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS") if is_plain else ()
        # A script's own folder, or the working one: robots may lie there.
        paths = os.pathsep.join(path for path in sys.path if path and isinstance(path, str))
        self._popen = subprocess.Popen(
            [sys.executable, *options, "-m", "animat.process", str(where)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if is_plain else None,
            # In a group of its own: Ctrl-C reaches this process alone, which then ends the other without a word.
            process_group=0,
            env=os.environ | dict.fromkeys(threads, "1") | {"PYTHONPATH": paths},
        )
        self.kill = self._popen.kill

    def answer(self, call: bytes, within_s: float | None = None) -> Any:
        """What a call returns: a function, its arguments and its named ones, pickled.

        Raises:
            BrokenExecutor: if the process ends over it.
            TimeoutError: if the answer does not come in time; the process is then ended.
            Exception: what the call raised.
        """
        assert self._popen.stdin is not None and self._popen.stdout is not None
        try:
            pickle.dump(call, self._popen.stdin)
            self._popen.stdin.flush()
            if within_s is not None and not select.select([self._popen.stdout], [], [], within_s)[0]:
                raise TimeoutError(f"no answer within {within_s:g} s")
            answer = pickle.load(self._popen.stdout)
        except (BrokenPipeError, EOFError) as error:
            raise BrokenExecutor(f"its process ended with status {self._popen.wait()}") from error
        except BaseException as error:
            self.kill()  # It may well go on, with nobody to hear it.
            status = self._popen.wait()
            if isinstance(error, pickle.UnpicklingError):
                raise BrokenExecutor(f"its process ended with status {status}") from error
            raise
        value, raised = pickle.loads(answer)
        if raised is not None:
            raise raised
        return value

    @property
    def is_spent(self) -> bool:
        """Whether it has ended, or, on a core, grown large."""
        if self._popen.poll() is not None:
            return True
        if not self._is_on_core:
            return False
        resident_pages = int(Path(f"/proc/{self._popen.pid}/statm").read_text().split()[1])
        return resident_pages * os.sysconf("SC_PAGE_SIZE") / 2**20 > _LARGEST_MIB

    def end(self) -> None:
        """End it, and let go of it."""
        self.kill()
        # It closes both pipes, one of which may be broken.
        with suppress(BrokenPipeError), self._popen:
            pass


def main(where: str) -> int:
    """Answer calls until standard input ends."""
    if where != "plain":
        pin_worker(None if where == "gpu" else int(where))

        from animat.compilation import keep_compilations

        keep_compilations()
    # What libraries and robots print goes to standard error from now on.
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
    """Pickled: what a call returned, and no error; or nothing, and the error."""
    try:
        function, args, kwargs = pickle.loads(work)
        return pickle.dumps((function(*args, **kwargs), None))
    except Exception as error:
        try:
            return pickle.dumps((None, error))
        except Exception:
            return pickle.dumps((None, RuntimeError(f"{type(error).__name__}: {error}")))


def pin_worker(core: int | None) -> None:
    """Make this process a worker: on one core without a GPU, or on the GPU; gone when the one that started it is.

    To be called before JAX or BLAS are loaded.
    """
    if core is None:
        os.environ.pop("JAX_PLATFORMS", None)
        # Others may have some of its memory; and products of numbers of 32 bits are to be such.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")
    else:
        # They size their threads by the cores they may use, and one pinned core beats two shared ones.
        os.sched_setaffinity(0, {core})
        # A few networks of 64 units keep a core busy and no GPU; workers, one a core, would all take the same one.
        os.environ["JAX_PLATFORMS"] = "cpu"
    end_with_parent()


def end_with_parent() -> None:
    """When the thread that started this process ends, and so when its process does, the kernel kills this one."""
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
