"""A process that does what it is told, on one core or, called `gpu`, on the GPU: of `PinnedProcesses`.

`python -m animat.execution.worker CPU`, or `python -m animat.execution.worker gpu`.

Calls come pickled on standard input, from the process that started it; what they return or raise goes out so too.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from typing import BinaryIO


def main() -> int:
    """Answer calls until standard input ends."""
    answers = pin_worker(None if sys.argv[1] == "gpu" else int(sys.argv[1]))

    from animat.compilation import keep_compilations

    keep_compilations()
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


def pin_worker(core: int | None) -> BinaryIO:
    """Make this process a worker: on one core without a GPU, or on the GPU; gone when the one that started it is.

    To be called before JAX or BLAS are loaded.

    Returns:
        Where answers go: what libraries and robots print goes to standard error from now on.
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
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return answers


def end_with_parent() -> None:
    """However the process that started this one ends, the kernel then kills this one."""
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
