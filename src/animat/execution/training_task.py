"""Tasks that train a group of policies: alone on a core, or together with others of the same program on a GPU."""

from __future__ import annotations

import abc
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from animat.execution.task import UNFINISHED, Task, TaskResult, carry_out_together
from animat.progress import Part, Progress
from animat.training.folder import write_description
from animat.training.group import CHECKPOINT_S, AddChunk, Group, programs, save_policies, train_groups
from animat.training.policy import Policy
from animat.training.specification import CHUNKS, Training

_SHARE = 0.9
"""Share of a GPU's memory for arrays; programs and copies in progress take the rest."""


@dataclass(frozen=True, eq=False)
class TrainingWork:
    """A group of policies to train into the folder `place`, with a checkpoint if it is trained alone.

    If there is a description, it is written next to the policies; `add_chunk` is that of `train_groups`.
    """

    group: Group
    place: Path
    checkpoint: Path
    checkpoint_s: float = CHECKPOINT_S
    add_chunk: AddChunk | None = None
    description: dict[str, Any] | None = None

    def save(self, policies: Sequence[Policy]) -> list[Path]:
        files = save_policies(self.group, policies, self.place)
        return files if self.description is None else [*files, write_description(self.place, self.description)]


class TrainingTask(Task):
    """A task that trains a group of policies."""

    @property
    @abc.abstractmethod
    def training(self) -> Training | None:
        """The training, as far as it is known before anything is read; None: policies are not trained."""

    @abc.abstractmethod
    def prepare(self, folder: Path) -> TrainingWork:
        """Read what it needs, and register robots and mappings; called in the process that trains."""

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        return train_alone(self.prepare(folder), progress)


def train_alone(work: TrainingWork, progress: Progress) -> list[Path]:
    """Train a group of policies, resuming from its checkpoint; returns the files written."""
    progress.update(0, CHUNKS, "compiling")
    files = _train([work], work.checkpoint, progress)[0]
    work.checkpoint.unlink(missing_ok=True)
    return files


def train_together(tasks: Sequence[TrainingTask], folder: Path, notices: Sequence[Path]) -> list[TaskResult]:
    """`carry_out_together` for tasks of one program: all of their policies at once, or as many as fit into memory.

    If it is killed before it returns and called again with the same tasks, it writes the same bits.
    """

    def run(progress: Progress) -> list[list[Path]]:
        progress.update(0, CHUNKS, "compiling")
        works = [task.prepare(folder) for task in tasks]
        parts = parts_that_fit([work.group for work in works])
        files, checkpoints = [], []
        for number, part in enumerate(parts):
            part_works = [works[i] for i in part]
            # The name identifies exactly these groups.
            names = "".join(f"{work.group.fingerprint}{work.group.members}" for work in part_works)
            checkpoints.append(folder / UNFINISHED / f"at-once-{hashlib.sha256(names.encode()).hexdigest()[:16]}.npz")
            part_progress = Part(progress, number * CHUNKS, CHUNKS, len(parts) * CHUNKS)
            files += _train(part_works, checkpoints[-1], part_progress, keeps_last=True)
        # Only now, so that finished parts are not trained again if a later one is killed.
        for checkpoint in checkpoints:
            checkpoint.unlink(missing_ok=True)
        return files

    return carry_out_together(tasks, folder, notices, run)


def _train(
    works: Sequence[TrainingWork], checkpoint: Path, progress: Progress, *, keeps_last: bool = False
) -> list[list[Path]]:
    policies = train_groups(
        [work.group for work in works],
        checkpoint,
        progress,
        # Writing a checkpoint takes time in proportion to the policies.
        checkpoint_s=works[0].checkpoint_s * len(works),
        add_chunks=[work.add_chunk for work in works],
        keeps_last=keeps_last,
    )
    return [work.save(trained) for work, trained in zip(works, policies, strict=True)]


def parts_that_fit(groups: Sequence[Group]) -> list[list[int]]:
    """Divide groups, by their indices, into even parts that fit into the device's memory, or are a single group."""
    available = _SHARE * device_memory_bytes()
    parts = 1 if math.isinf(available) else math.ceil(bytes_at_once(groups) / available)
    return [part.tolist() for part in np.array_split(np.arange(len(groups)), min(parts, len(groups)))]


def device_memory_bytes() -> float:
    """The memory that JAX may use on its device; infinite for a CPU, which does not report it."""
    stats = jax.devices()[0].memory_stats()
    return math.inf if stats is None else float(stats["bytes_limit"])


def bytes_at_once(groups: Sequence[Group]) -> int:
    """The memory of the program that trains these groups at once: policies, replays, simulators, temporaries."""
    training, timeline = groups[0].training, groups[0].timeline
    environment = training.environment_on(timeline)
    own_simulators = len({group.fingerprint for group in groups}) > 1
    compiled: tuple[Any, Any] = programs(environment, training.algorithm, own_simulators)
    beginning, chunk = compiled
    policies = sum(len(group.members) for group in groups)
    learners = jax.eval_shape(beginning, jax.eval_shape(lambda: jax.random.split(jax.random.key(0), policies)))
    simulator = None if timeline is None else timeline.at(float(timeline.start_min[0]))
    leading = (policies,) if own_simulators else ()
    simulators = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leading, *leaf.shape)), simulator)
    needed = chunk.lower(learners, simulators, jnp.int32(0), jnp.int32(1)).compile().memory_analysis()
    held = needed.argument_size_in_bytes + needed.output_size_in_bytes - needed.alias_size_in_bytes
    return int(held + needed.temp_size_in_bytes)
