"""A process that runs jobs on one core: `python -m animat.studies.worker CPU`, started by `Processes`.

Tasks come pickled on standard input, from the process that started it; progress goes out as JSON lines.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from animat.errors import AnimatError, out_of_memory
from animat.studies.jobs import Task
from animat.studies.specification import Study
from animat.training.worker import settle_on

_TELL_EVERY_S = 0.2

_LARGEST_MIB = 800
"""A worker that has grown beyond it makes way for a new one: compiled programs and tables of past jobs stay in it."""


def main() -> int:
    """Run tasks until standard input ends."""
    events = settle_on(int(sys.argv[1]))

    def tell(**event: Any) -> None:
        print(json.dumps(event), file=events, flush=True)

    from animat.compilation import keep_compilations

    keep_compilations()
    while True:
        try:
            job: tuple[Task, Study, Path] = pickle.load(sys.stdin.buffer)
        except EOFError:
            return 0
        task, study, folder = job
        last = 0.0

        def report(share: float, words: str) -> None:
            nonlocal last
            if time.monotonic() - last > _TELL_EVERY_S:
                last = time.monotonic()
                tell(kind="progress", share=share, words=words)

        began_s = time.process_time()
        try:
            for body in study.robots:
                body.robot()  # It registers one that is imported, for policies to be loaded.
            files = task.run(study, folder, report)
        except AnimatError as error:
            tell(kind="failed", words=str(error))
            continue
        except Exception as error:
            # Nobody foresaw it: where it came from is told too, in one line, and the next job finds a worker.
            memory = out_of_memory(error)
            tell(kind="failed", words=_unforeseen(error) if memory is None else f"{memory}: {task.needs(study)}")
            continue
        leaves = _resident_mib() > _LARGEST_MIB
        cpu_s = time.process_time() - began_s
        tell(kind="done", files=[str(file) for file in files], cpu_s=cpu_s, leaves=leaves)
        if leaves:
            return 0


def _unforeseen(error: Exception) -> str:
    lines = str(error).strip().splitlines() or ["no more is known"]
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {lines[0]} (in {place.name}, {Path(place.filename).name}, line {place.lineno})"


def _resident_mib() -> float:
    resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
    return resident_pages * os.sysconf("SC_PAGE_SIZE") / 2**20


if __name__ == "__main__":
    sys.exit(main())
