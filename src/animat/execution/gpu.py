"""The GPU of this machine: all policies of many trainings at once, in a process of its own, beside those on cores."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from animat import devices
from animat.errors import first_line
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Done, Task, carry_out_alone

_CONDITIONS = 5
"""Any number: in one folder it is the same for all that have neurons."""


def find_gpu() -> str | None:
    """The kind of GPU that policies are trained on; None: on cores, which is told where JAX has a plugin for GPUs."""
    if not devices.GPU_IS_ALLOWED:
        return None
    try:
        with PinnedProcesses([None]) as apart:
            found = apart.submit(devices.gpu_here).result()
    except Exception as error:
        print(f"gpu: none can be used ({first_line(error)}); policies are trained on cores", file=sys.stderr)
        return None
    if found is None:
        print("gpu: JAX finds none; policies are trained on cores", file=sys.stderr)
    return found


def programs_among(tasks: Sequence[Task]) -> list[list[int]]:
    """Tasks that one program does, by their numbers: of each program; those that are in none stay on cores.

    A program trains all policies of the same environment, settings and length; with lessons or a cost of pulses, of
    the same training.
    Bodies that are stepped outside JAX stay on cores.
    """
    from animat.execution.trains import Trains
    from animat.robots.host import HostRobot

    programs: list[tuple[Any, list[int]]] = []
    for number, task in enumerate(tasks):
        training = task.training if isinstance(task, Trains) else None
        if training is None or isinstance(training.robot, HostRobot):
            continue
        of_its_own = training if training.is_varied or training.pulse_cost else None
        program = (training.environment(_CONDITIONS), training.algorithm, training.rounds, of_its_own)
        same = next((numbers for other, numbers in programs if other == program), None)
        if same is None:
            programs.append((program, same := []))
        same.append(number)
    return [numbers for _, numbers in programs]


class WithGpu:
    """The cores of this machine, and a process with its GPU, to which goes what trains policies."""

    def __init__(self, cores: Executor, process: Executor) -> None:
        self._cores, self._process = cores, process

    def hand_in(self, tasks: Sequence[Task], folder: Path, notices: Sequence[Path]) -> list[Future[Done]]:
        """Have tasks carried out (`animat.execution.task.carry_out_alone`), of which those at once that can be."""
        from animat.execution.trains import Trains, train_at_once

        futures: dict[int, Future[Done]] = {}
        for numbers in programs_among(tasks):
            told = [notices[number] for number in numbers]
            at_once = [task for number in numbers if isinstance(task := tasks[number], Trains)]
            done = self._process.submit(train_at_once, at_once, folder, told)
            futures |= dict(zip(numbers, _each_of(done, len(numbers)), strict=True))
        for number in range(len(tasks)):
            if number not in futures:
                futures[number] = self._cores.submit(carry_out_alone, tasks[number], folder, notices[number])
        return [futures[number] for number in range(len(tasks))]


def _each_of(together: Future[list[Done]], n: int) -> list[Future[Done]]:
    """A future for each of what comes together."""
    futures: list[Future[Done]] = [Future() for _ in range(n)]

    def settle(_: object) -> None:
        error = None if together.cancelled() else together.exception()
        for i, future in enumerate(futures):
            if together.cancelled():
                future.cancel()
                future.set_running_or_notify_cancel()
            elif error is not None:
                future.set_exception(error)
            else:
                future.set_result(together.result()[i])

    together.add_done_callback(settle)
    return futures
