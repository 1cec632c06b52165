"""Policies that are trained side by side in one program, chunk by chunk, with checkpoints to resume from."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from animat.compilation import jit_side_by_side
from animat.environment import Environment, Neurons
from animat.errors import InvalidFile, UnusableData
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.responses.readouts import ALL
from animat.robots.host import HostRobot
from animat.training.course import Course
from animat.training.host import OnHost
from animat.training.networks import Network
from animat.training.policy import CURVE, Policy
from animat.training.sac import Diagnosis, begin, diagnosis_program, train_chunk
from animat.training.settings import SAC
from animat.training.specification import CHUNKS, Training
from animat.writing import atomic_write

BEST = "best"
"""The subfolder of a training's folder with each policy at its best assessment."""
CHECKPOINT_S = 2.0
"""Seconds of training that a kill may cost; a checkpoint of five policies is 30 MB and takes about 50 ms."""

Rows = TypeVar("Rows", list[Policy], np.ndarray)
Chunk: TypeAlias = Float64[np.ndarray, "policies columns"]
"""One chunk of the learning curves, one row per policy; columns as `CURVE`."""
AddChunk: TypeAlias = Callable[[Chunk], None]


@dataclass(frozen=True, eq=False)
class Group:
    """Some of a training's policies, by their numbers, and the simulators they are trained on."""

    training: Training
    members: tuple[int, ...]
    timeline: SimulatorTimeline | None
    fingerprint: str
    provenance: dict[str, Any]


def train_groups(
    groups: Sequence[Group],
    checkpoint: Path | None,
    progress: Progress,
    *,
    checkpoint_s: float = CHECKPOINT_S,
    add_chunks: Sequence[AddChunk | None],
    keeps_last: bool = False,
) -> list[list[Policy]]:
    """Train groups of policies at once, resuming from their checkpoint if there is one; returns the policies of each.

    However often it was stopped, the result is the same to the bit; how many are trained at once changes the last bits.

    Args:
        groups: that one program can train (`animat.execution.gpu.group_by_program`).
        checkpoint: file written atomically from time to time; the caller removes it when it is no longer needed.
        progress: updated after each chunk with the number done and the mean return of the episodes that ended in it.
        checkpoint_s: seconds between checkpoints; they change how much is repeated, never the result.
        add_chunks: of each group, called with each chunk of its learning curves, those from the checkpoint first.
        keeps_last: whether a checkpoint is also written at the end, from which the same policies can be restored.

    Raises:
        InvalidFile: if the checkpoint cannot be read or written, or is of another training.
    """
    # In 32 bits, even where the user's own code computes in 64: learners and checkpoints have one precision.
    with jax.enable_x64(False):
        together = SideBySide(*groups)
    done = together.resume(checkpoint) if checkpoint is not None and checkpoint.exists() else 0
    simulators = [_simulators_of(group) for group in groups]

    def pass_on(chunk: Chunk) -> None:
        for rows, add_chunk in zip(together.split(chunk), add_chunks, strict=True):
            if add_chunk is not None:
                add_chunk(rows)

    for chunk in together.curve:
        pass_on(chunk)
    written = time.monotonic()
    for index in range(done, CHUNKS):
        with jax.enable_x64(False):
            mean_return = together.train(index, *(simulator_at(index) for simulator_at in simulators))
        pass_on(together.curve[-1])
        is_due = time.monotonic() - written > checkpoint_s or (keeps_last and index + 1 == CHUNKS)
        if checkpoint is not None and is_due:
            together.save_checkpoint(checkpoint)
            written = time.monotonic()
        note = "" if math.isnan(mean_return) else f"return {mean_return:.1f}"
        progress.update(index + 1, CHUNKS, ", ".join(filter(None, (note, together.note()))))
    return together.split(together.policies())


def _simulators_of(group: Group) -> Callable[[int], Neurons]:
    """The simulator of a group in each chunk, by its number; all simulators where each episode draws one."""
    training = group.training
    if group.timeline is None:
        return lambda _: None
    timeline = group.timeline.with_percentiles(training.percentiles)
    if training.shadowing == "drawn":
        return lambda _: timeline.simulators
    return lambda index: timeline.at(float(timeline.start_min[0]) + training.minute(index))


def save_policies(group: Group, policies: Sequence[Policy], folder: Path) -> list[Path]:
    """Write a group's policies by their numbers in the training, with the best of each; returns the files."""
    files = [folder / f"p{member}.safetensors" for member in group.members]
    best = []
    for file, policy in zip(files, policies, strict=True):
        if policy.best is not None:
            best.append(folder / BEST / file.name)
            policy.best.save(best[-1])
        policy.save(file)
    return [*best, *files]


@lru_cache(maxsize=8)
def programs(
    environment: Environment[Any], algorithm: SAC, own_simulators: bool = False
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin` and `train_chunk` for several policies, traced once per process; each may have its own simulator."""
    in_axes = (0, 0 if own_simulators else None, None, None)
    return (
        jit_side_by_side(partial(begin, environment, algorithm)),
        jit_side_by_side(partial(train_chunk, environment, algorithm), in_axes, donate_argnums=0),
    )


class SideBySide:
    """The policies of groups of one program during training, chunk by chunk, with the simulators passed in.

    Groups of several trainings have no lessons and no host robots; of their timelines, only what all share is used.

    Args:
        own_programs: `begin` and `train_chunk` for all of them, instead of `programs`.
        is_diagnosed: whether they are diagnosed after each chunk, and must be finite; if not, curves have NaN there.
    """

    def __init__(
        self, *groups: Group, own_programs: Sequence[Callable[..., Any]] = (), is_diagnosed: bool = True
    ) -> None:
        group, training = groups[0], groups[0].training
        self._groups = groups
        self._places = [(each, member) for each in groups for member in each.members]
        self._own_simulators = len({each.fingerprint for each in groups}) > 1
        self._environment = training.environment_on(group.timeline)
        self._course = None
        if own_programs:
            beginning, self._chunk = own_programs
        elif training.is_varied:
            self._course = Course(training, self._environment, group.timeline, len(self._places))
            beginning, self._chunk = self._course.begin, self._course.train
        elif isinstance(training.robot, HostRobot):
            on_host = OnHost(self._environment, training.algorithm)
            beginning, self._chunk = on_host.begin, on_host.train
        else:
            beginning, self._chunk = programs(self._environment, training.algorithm, self._own_simulators)
        keys = [jax.random.fold_in(jax.random.key(each.training.seed), member) for each, member in self._places]
        self._diagnose = diagnosis_program(self._environment, training.algorithm) if is_diagnosed else None
        self._learners = beginning(jnp.stack(keys))
        self.curve: list[Chunk] = []
        """The learning curves so far."""

    def split(self, rows: Rows) -> list[Rows]:
        """Split rows of all policies into those of each group."""
        ends = np.cumsum([len(group.members) for group in self._groups])
        return [rows[end - len(group.members) : end] for group, end in zip(self._groups, ends, strict=True)]

    def train(self, index: int, *simulators: Neurons) -> float:
        """Train one chunk with the simulator of each group; `index` counts from 0, also beyond those of the training.

        Returns the mean return of the episodes that ended in it, NaN if none ended. Raises UnusableData if policies
        that are diagnosed are no longer finite.
        """
        training, simulator = self._groups[0].training, simulators[0]
        algorithm = training.algorithm
        if self._own_simulators:
            of_each = np.repeat(np.arange(len(self._groups)), [len(group.members) for group in self._groups])
            simulator = jax.tree.map(lambda *leaves: jnp.stack(leaves)[of_each], *simulators)
        first, last = training.chunk(index)
        self._learners, finished = self._chunk(self._learners, simulator, jnp.int32(first), jnp.int32(last))
        episodes, returns = np.asarray(finished.episodes, float), np.asarray(finished.returns, float)
        iterations = np.full(len(episodes), last * algorithm.environments)
        diagnosis: Sequence[Any] = [np.full(len(episodes), np.nan)] * len(Diagnosis._fields)
        if self._diagnose is not None:
            # Before a checkpoint is written, which training could never recover from.
            if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(self._learners.deployed)):
                got = f"NaN or infinite ones within {iterations[0]:,} iterations"
                raise UnusableData(f"{training.robot.name}: expected finite rewards and observations, got {got}")
            available = jnp.int32(min(last * algorithm.environments, algorithm.replay))
            diagnosis = self._diagnose(self._learners, available)
        with np.errstate(invalid="ignore"):
            self.curve.append(np.stack([iterations, episodes, returns / episodes, *diagnosis], axis=1))
        if self._course is not None:
            self._course.assess(index, self._learners.deployed, simulator)
        return float(returns.sum() / episodes.sum()) if episodes.sum() else float("nan")

    def note(self) -> str:
        """The policies' lessons, for the progress line; empty without lessons."""
        return "" if self._course is None else self._course.note()

    def policies(self) -> list[Policy]:
        """The current policies, each with its best version if they are assessed."""
        curves = np.array(self.curve).reshape(-1, len(self._places), len(CURVE))
        policies = [self._policy(i, self._learners.deployed, curves[:, i]) for i in range(len(self._places))]
        if self._course is None or not self.curve or not self._groups[0].training.episodes_assessed:
            return policies
        state = self._course.state
        for i, policy in enumerate(policies):
            assessments, until = state.table[: len(self.curve), i], int(state.best_at[i]) + 1
            best = replace(self._policy(i, state.best, curves[:until, i]), assessments=assessments[:until])
            policies[i] = replace(policy, assessments=assessments, best=best)
        return policies

    def _policy(self, i: int, networks: Network, curve: np.ndarray) -> Policy:
        group, _ = self._places[i]
        training, timeline = group.training, group.timeline
        return Policy(
            weights=tuple(np.array(layer.weight[i]) for layer in networks),
            biases=tuple(np.array(layer.bias[i])[0] for layer in networks),
            scales=self._environment.scales,
            robot=training.robot,
            mapping=training.mapping,
            conditions=timeline.conditions if timeline and training.mapping is not None else (),
            commands=training.commands,
            window_ms=timeline.window_ms if timeline else None,
            presentation=timeline.presentation if timeline else None,
            readouts=timeline.readouts if timeline else ALL,
            neural_observation=training.neural_observation,
            pulse_cost=training.pulse_cost,
            provenance=group.provenance,
            learning_curve=curve,
        )

    def save_checkpoint(self, checkpoint: Path, group: int | None = None) -> None:
        """Write a checkpoint of all policies, or of those of the group with this index."""
        learners = self._learners._replace(key=jax.random.key_data(self._learners.key))
        leaves = jax.tree.leaves((learners, self._course_state))
        members = np.array([member for _, member in self._places])
        rows = slice(None) if group is None else self.split(np.arange(len(members)))[group]
        arrays: dict[str, Any] = {f"leaf{i}": np.asarray(leaf)[rows] for i, leaf in enumerate(leaves)}
        arrays |= {"fingerprint": np.array(self.fingerprint), "done": np.array(len(self.curve))}
        with atomic_write(checkpoint) as unfinished, unfinished.open("wb") as file:
            # The members are for the live page alone.
            np.savez(file, curve=np.stack(self.curve)[:, rows], members=members[rows], **arrays)

    def resume(self, *checkpoints: Path) -> int:
        """Resume from a checkpoint, or from one per group, all of equal size; returns the number of chunks done."""
        like: Any = self._learners._replace(key=jax.random.key_data(self._learners.key)), self._course_state
        if checkpoints[1:]:
            n = len(self._places) // len(checkpoints)
            like = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[:n], like))
        read = [_read_checkpoint(path, self.fingerprint, like) for path in checkpoints]
        (done, (learners, course_state), curve), *others = read
        if others:
            learners = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), learners, *(each[1][0] for each in others))
            curve = np.concatenate([curve, *(each[2] for each in others)], axis=1)
        self._learners = learners._replace(key=jax.random.wrap_key_data(learners.key))
        if self._course is not None:
            self._course.state = course_state
        self.curve = list(curve)
        return done

    @property
    def fingerprint(self) -> str:
        """The fingerprint of everything that determines the policies."""
        return "+".join(dict.fromkeys(group.fingerprint for group in self._groups))

    @property
    def _course_state(self) -> Any:
        return () if self._course is None else self._course.state


def _read_checkpoint(path: Path, fingerprint: str, like: Any) -> tuple[int, Any, np.ndarray]:
    """The number of chunks done, the learners with their course's state (structured as `like`), and the curves."""
    leaves, structure = jax.tree.flatten(like)
    n_state, policies = len(jax.tree.leaves(like[1])), leaves[0].shape[0]
    try:
        # Opened here, as numpy does not close a file that it cannot read.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            # Checked before anything is read: an archive of some kilobytes can unpack to any size.
            size = sum(member.file_size for member in file.zip.infolist())
            most = 2 * sum(leaf.size * leaf.dtype.itemsize for leaf in leaves) + 2**22
            if size > most:
                raise InvalidFile(f"{path}: expected a checkpoint of at most {most:,} bytes, got {size:,}; remove it")
            if str(file["fingerprint"]) != fingerprint:
                raise InvalidFile(f"{path}: expected a checkpoint of this training, got another training's; remove it")
            arrays = [file[f"leaf{i}"] for i in range(sum(name.startswith("leaf") for name in file.files))]
            done, curve = int(file["done"]), file["curve"]
            is_alike = [(a.shape, a.dtype) for a in arrays] == [(leaf.shape, leaf.dtype) for leaf in leaves]
            if not is_alike or not 0 < done <= CHUNKS or curve.shape != (done, policies, len(CURVE)):
                raise InvalidFile(
                    f"{path}: expected a checkpoint as this version of animat writes it, of {policies} policies "
                    f"together, got a different one; to start these again: rm '{path}'"
                )
            # Only the learners go to JAX; the course's state stays in numpy, with 64 bits.
            n = len(leaves) - n_state
            values = [jnp.asarray(array) for array in arrays[:n]] + arrays[n:]
    except InvalidFile:
        raise
    except Exception as error:  # numpy, zipfile and zlib raise a dozen kinds of errors for a damaged archive
        raise InvalidFile(f"{path}: expected a checkpoint, got one that cannot be read ({error}); remove it") from error
    return done, jax.tree.unflatten(structure, values), curve


def split_groups(policies: int, *, fewest: int = 1) -> list[tuple[int, ...]]:
    """Divide the numbers of the policies into at least `fewest` groups, as even as possible, none larger than five.

    The division does not depend on the machine: how many are trained side by side could change the last bits.
    """
    n_groups = max(-(-policies // 5), min(fewest, policies))
    return [tuple(part.tolist()) for part in np.array_split(np.arange(policies), n_groups)]
