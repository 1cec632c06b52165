"""A process that trains one group of policies on one core: `python -m animat.training.worker CPU`, started by `train`.

The job comes pickled on standard input, from the process that started it; progress goes out as JSON lines.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO, TextIO


def main() -> int:
    """Read a job, train it, write its policies; report each chunk as a line."""
    told = settle_on(int(sys.argv[1]))

    from animat.compilation import keep_compilations
    from animat.errors import AnimatError, out_of_memory
    from animat.robots.registry import register_robot
    from animat.training.group import Group, train_group

    keep_compilations()
    group: Group
    folder: Path
    checkpoint: Path
    checkpoint_s: float

    def report(done: int, mean_return: float) -> None:
        print(json.dumps({"done": done, "mean_return": mean_return}), file=told, flush=True)

    try:
        group, folder, checkpoint, checkpoint_s = pickle.load(sys.stdin.buffer)
        register_robot(type(group.training.robot))
        policies = train_group(group, checkpoint, report, checkpoint_s=checkpoint_s)
        for member, policy in zip(group.members, policies, strict=True):
            policy.save(folder / f"p{member}.safetensors")
        checkpoint.unlink(missing_ok=True)
    except Exception as error:
        memory = out_of_memory(error)
        if memory is None and not isinstance(error, AnimatError):
            raise
        sizes = "environments, replay, batch, hidden"
        words = f"{memory}: it grows with the algorithm's {sizes}, got {group.training.algorithm}" if memory else error
        print(json.dumps({"error": str(words)}), file=told, flush=True)
        return 1
    return 0


def start_worker(module: str, core: int, stdin: IO[bytes] | int) -> subprocess.Popen[bytes]:
    """Start a worker, `python -m MODULE CORE`, which imports from where this process does.

    It is in a process group of its own: Ctrl-C reaches this process alone, which then ends the worker without a word.
    """
    return subprocess.Popen(
        [sys.executable, "-m", module, str(core)],
        stdin=stdin,
        stdout=subprocess.PIPE,
        bufsize=0,
        process_group=0,
        # A script's own folder, or the working one: robots may lie there.
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if isinstance(p, str))},
    )


def settle_on(core: int) -> TextIO:
    """Make this process a worker: on one core, without an accelerator, and gone when the one that started it is.

    To be called before JAX or BLAS are loaded.

    Returns:
        Where to tell the one that started it: what libraries and robots print goes to standard error from now on.
    """
    # They size their threads by the cores they may use, and one pinned core beats two shared ones.
    os.sched_setaffinity(0, {core})
    # Networks of 64 units keep a core busy and no GPU, and workers, one a core, would all take the same one.
    os.environ["JAX_PLATFORMS"] = "cpu"
    # However the parent ends, the kernel then kills this process.
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    told = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return told


if __name__ == "__main__":
    sys.exit(main())
