"""A process that trains one group of policies on one core: `python -m animat.training.worker CPU`, started by `train`.

The job comes pickled on standard input, from the process that started it; progress goes out as JSON lines.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import signal
import sys
from pathlib import Path


def main() -> int:
    """Read a job, train it, write its policies; report each chunk as a line."""
    settle_on(int(sys.argv[1]))

    from animat.compilation import keep_compilations
    from animat.errors import AnimatError, out_of_memory
    from animat.training.group import Group, train_group

    keep_compilations()
    group: Group
    folder: Path
    checkpoint: Path
    checkpoint_s: float
    group, folder, checkpoint, checkpoint_s = pickle.load(sys.stdin.buffer)

    def report(done: int, mean_return: float) -> None:
        print(json.dumps({"done": done, "mean_return": mean_return}), flush=True)

    try:
        policies = train_group(group, checkpoint, report, checkpoint_s=checkpoint_s)
        for member, policy in zip(group.members, policies, strict=True):
            policy.save(folder / f"p{member}.safetensors")
        checkpoint.unlink(missing_ok=True)
    except Exception as error:
        memory = out_of_memory(error)
        if memory is None and not isinstance(error, AnimatError):
            raise
        sizes = "environments, replay, batch, hidden"
        told = f"{memory}: it grows with the algorithm's {sizes}, got {group.training.algorithm}" if memory else error
        print(json.dumps({"error": str(told)}), flush=True)
        return 1
    return 0


def settle_on(core: int) -> None:
    """Make this process a worker: on one core, without an accelerator, and gone when the one that started it is.

    To be called before JAX or BLAS are loaded.
    """
    # They size their threads by the cores they may use, and one pinned core beats two shared ones.
    os.sched_setaffinity(0, {core})
    # Networks of 64 units keep a core busy and no GPU, and workers, one a core, would all take the same one.
    os.environ["JAX_PLATFORMS"] = "cpu"
    # However the parent ends, the kernel then kills this process.
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
