"""Training of several policies: groups of them as tasks, into a folder in which training can be resumed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import final

from animat.arguments import checked_arguments
from animat.coding.decoder import expect_readout_per_command
from animat.devices import gpu_here
from animat.errors import InvalidArgument, UnusableData
from animat.execution.curves import CurveFile, Curves, TrainingCallback
from animat.execution.gpu import find_gpu
from animat.execution.jobs import Job, Jobs, expect_workers
from animat.execution.task import UNFINISHED
from animat.execution.training_task import TrainingTask, TrainingWork
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Part, Progress, in_phase
from animat.robots.host import HostRobot
from animat.training.course import rows_of
from animat.training.folder import (
    MANIFEST,
    check_claim,
    describe_training,
    expect_trainable,
    finish,
    groups_of,
    write_description,
)
from animat.training.group import BEST, CHECKPOINT_S, Group, train_groups
from animat.training.policy import Policy
from animat.training.specification import CHUNKS, Training
from animat.writing import exclusive_lock


@checked_arguments
def train(
    training: Training,
    timeline: SimulatorTimeline | None,
    folder: str | os.PathLike[str] | None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    sources: Sequence[str] = (),
    random_return: float | None = None,
    callbacks: Sequence[TrainingCallback] = (),
) -> dict[str, Policy]:
    """Train policies into a folder: `p0.safetensors`, ..., and `training.json`, which describes them.

    If stopped at any moment, even by SIGKILL, and called again, it resumes from the last checkpoint and ends in the
    same bits as if it had not been stopped, with any number of workers. For a finished folder it reads the policies.
    On a GPU it trains all policies at once (`animat.execution.gpu`). If killed there while it writes the finished ones,
    it trains the others together again, and their last bits differ.

    Args:
        timeline: the culture's simulators; None for a training without neurons.
        folder: folder for the policies, created if missing. None: train in this process and write nothing; if stopped,
            training starts again. This also allows robots and mappings that are not registered.
        workers: processes, each pinned to its own core; None: one per core. Not with an executor.
        executor: for the groups of policies; it must see the folder, and stays open. None: processes on this machine.
        progress: updated as iterations are done, with the policies' returns so far.
        checkpoint_s: seconds between checkpoints, which a kill may cost; never changes the result.
        sources, random_return: names of the recordings and mean return of random actions, for manifest and live page.
        callbacks: called with every row of the learning curves as it is produced; they change no bit.

    Returns:
        The policies by name, `p0` first. Assessed policies carry their best version, which the folder has in `best/`,
        with all assessments in `assessments.csv`.

    Raises:
        InvalidArgument: for a training that is impossible with these simulators, workers or executor.
        Mismatch: if the folder holds another training or other work, or another run is active in it.
        InvalidFile: if a file cannot be read or written.
        UnusableData: if what was learned is no longer finite; none of it is left in the folder.
        AnimatError: if a training process ends unexpectedly.
    """
    if (timeline is None) != (training.mapping is None):
        raise InvalidArgument(
            "timeline: expected the culture's simulators with a mapping, and None without, got "
            f"{'none' if timeline is None else 'some'} with mapping {training.mapping and training.mapping.name}"
        )
    expect_workers(workers, executor)
    expect_trainable(training, is_saved=folder is not None)
    if timeline is not None:
        expect_readout_per_command(training.robot.name, training.robot.n_commands, len(timeline.readouts))
    training = training.with_duration_of(timeline)
    rows_of(training, timeline)
    on_cores = folder is None or executor is not None or isinstance(training.robot, HostRobot)
    gpu = None if on_cores else find_gpu()
    device = gpu_here() if folder is None else gpu
    manifest = describe_training(training, timeline, sources, random_return, device=device)
    groups = groups_of(training, timeline, manifest, fewest=2)
    if folder is None:
        return _train_in_memory(groups, _phase_of(groups, progress), callbacks)
    folder = Path(folder).absolute()
    # Checked before the lock, so that another training's folder stays untouched.
    check_claim(folder, manifest)
    with exclusive_lock(folder):
        if not check_claim(folder, manifest):
            write_description(folder, manifest)
        missing = [group for group in groups if not _is_trained(group, folder)]
        curves = Curves(folder, groups, callbacks, _phase_of(missing, progress))
        if missing:
            tasks = {
                as_range(group.members): TrainGroup(group, checkpoint_s, writes_rows=bool(callbacks))
                for group in missing
            }
            left = [Job(name, task, cost_s=CHUNKS * len(task.group.members)) for name, task in tasks.items()]
            jobs = Jobs(left, folder, folder / UNFINISHED / "jobs", manifest["fingerprint"])
            try:
                jobs.run(workers=workers, executor=executor, progress=curves, has_gpu=gpu is not None)
            except UnusableData:
                # Numbers of the robot were not finite: after its correction, unfinished policies must start again.
                shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
                if not any(folder.glob("p*.safetensors")):
                    (folder / MANIFEST).unlink()
                raise
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        policies = finish(training, folder)
        curves.finish(policies)
    return policies


@final
@dataclass(frozen=True, eq=False)
class TrainGroup(TrainingTask):
    """Train a group of policies, resuming from its checkpoint; for callbacks it writes the rows to a file."""

    group: Group
    checkpoint_s: float
    writes_rows: bool = False

    @property
    def grows_with(self) -> dict[str, object]:
        return {"algorithm": self.group.training.algorithm}

    @property
    def training(self) -> Training:
        return self.group.training

    def prepare(self, folder: Path) -> TrainingWork:
        self.training.register()
        checkpoint = folder / UNFINISHED / f"from-p{self.group.members[0]}.npz"
        add_chunk = CurveFile(folder, self.group.members[0]).add if self.writes_rows else None
        return TrainingWork(self.group, folder, checkpoint, self.checkpoint_s, add_chunk)


def _phase_of(groups: Sequence[Group], progress: Progress | None) -> Progress:
    """The progress of training groups, which counts the iterations of all their policies."""
    iterations = sum(group.training.iterations * len(group.members) for group in groups)
    return in_phase(progress, "training", iterations, "iterations")


def as_range(members: Sequence[int]) -> str:
    """Consecutive policies as text, such as `p0 to p4`."""
    first, last = members[0], members[-1]
    return f"p{first}" if first == last else f"p{first} to p{last}"


def _is_trained(group: Group, folder: Path) -> bool:
    folders = [folder, folder / BEST] if group.training.episodes_assessed else [folder]
    files = [each / f"p{member}.safetensors" for each in folders for member in group.members]
    return all(file.exists() and Policy.load(file).provenance.get("fingerprint") == group.fingerprint for file in files)


def _train_in_memory(
    groups: Sequence[Group], progress: Progress, callbacks: Sequence[TrainingCallback]
) -> dict[str, Policy]:
    trained: dict[str, Policy] = {}
    curves = Curves(None, groups, callbacks, progress)
    for number, group in enumerate(groups):
        part = Part(progress, number * CHUNKS, CHUNKS, len(groups) * CHUNKS)
        add_chunk = partial(curves.add, group.members) if callbacks else None
        (policies,) = train_groups([group], None, part, add_chunks=[add_chunk])
        trained |= {f"p{member}": policy for member, policy in zip(group.members, policies, strict=True)}
    return trained
