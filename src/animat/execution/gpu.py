"""The GPU of this machine: one process trains all policies of many trainings at once, alongside work on cores."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from animat import devices
from animat.errors import first_line
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Task, TaskResult, carry_out_alone

_CONDITIONS = 5
"""An arbitrary number: it is the same for all trainings with neurons in a folder."""


def find_gpu() -> str | None:
    """The kind of GPU for training; None: train on cores, with a message if JAX has a plugin for GPUs."""
    if not devices.GPU_IS_ALLOWED:
        return None
    try:
        with PinnedProcesses([None]) as process:
            kind = process.submit(devices.gpu_here).result()
    except Exception as error:
        print(f"gpu: none can be used ({first_line(error)}); policies are trained on cores", file=sys.stderr)
        return None
    if kind is None:
        print("gpu: JAX finds none; policies are trained on cores", file=sys.stderr)
    return kind


def group_by_program(tasks: Sequence[Task]) -> list[list[int]]:
    """The indices of the tasks that one program can train together; other tasks stay on cores.

    Their policies have the same environment, settings and length. Those of a training with lessons or a cost of pulses
    are trained apart from others, and bodies that are stepped outside JAX stay on cores.
    """
    from animat.execution.training_task import TrainingTask
    from animat.robots.host import HostRobot

    programs: list[tuple[Any, list[int]]] = []
    for number, task in enumerate(tasks):
        training = task.training if isinstance(task, TrainingTask) else None
        if training is None or isinstance(training.robot, HostRobot):
            continue
        only_this = training if training.is_varied or training.pulse_cost else None
        program = (training.environment(_CONDITIONS), training.algorithm, training.rounds, only_this)
        same = next((numbers for other, numbers in programs if other == program), None)
        if same is None:
            programs.append((program, same := []))
        same.append(number)
    return [numbers for _, numbers in programs]


def submit_with_gpu(
    cores: Executor, gpu: Executor, tasks: Sequence[Task], folder: Path, notices: Sequence[Path]
) -> list[Future[TaskResult]]:
    """Submit tasks (`carry_out_alone`) to cores; those of one program run at once in the process with the GPU."""
    from animat.execution.training_task import TrainingTask, train_together

    futures: dict[int, Future[TaskResult]] = {}
    for numbers in group_by_program(tasks):
        at_once = [task for number in numbers if isinstance(task := tasks[number], TrainingTask)]
        together = gpu.submit(train_together, at_once, folder, [notices[number] for number in numbers])
        futures |= dict(zip(numbers, _split(together, len(numbers)), strict=True))
    return [
        futures.get(number) or cores.submit(carry_out_alone, task, folder, notices[number])
        for number, task in enumerate(tasks)
    ]


def _split(together: Future[list[TaskResult]], n: int) -> list[Future[TaskResult]]:
    """A future for each of the results that arrive together."""
    futures: list[Future[TaskResult]] = [Future() for _ in range(n)]

    def settle(_: object) -> None:
        for i, future in enumerate(futures):
            if together.cancelled():
                future.cancel()
                future.set_running_or_notify_cancel()
            elif (error := together.exception()) is not None:
                future.set_exception(error)
            else:
                future.set_result(together.result()[i])

    together.add_done_callback(settle)
    return futures
