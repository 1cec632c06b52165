"""Policies that are trained side by side in one program: chunk after chunk, with a checkpoint to go on from."""

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

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment
from animat.errors import InvalidFile, UnusableData
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.responses.readouts import ALL
from animat.robots.host import HostRobot
from animat.training.course import Course
from animat.training.diagnosis import Diagnosis, diagnosing
from animat.training.host import programs_on_host
from animat.training.networks import Network
from animat.training.policy import CURVE, Policy
from animat.training.sac import begin, train_chunk
from animat.training.settings import SAC
from animat.training.specification import CHUNKS, Training
from animat.wrappers import EpisodeLimit
from animat.writing import atomic_write

BEST = "best"
"""The folder in a training's folder with what each policy was at its best assessment."""
CHECKPOINT_S = 2.0
"""Seconds of training that a kill may cost; a checkpoint of five policies is 30 MB and takes about 50 ms."""


Rows = TypeVar("Rows", list[Policy], np.ndarray)
AddPart: TypeAlias = Callable[[Float64[np.ndarray, "policies columns"]], None]
"""What is given a part of the learning curves, a row a policy; columns as `CURVE`."""


@dataclass(frozen=True, eq=False)
class Group:
    """Some of a training's policies, and what they are trained on.

    Attributes:
        training: what is trained.
        members: which of its policies, by number.
        timeline: the culture's simulators; None without neurons.
        fingerprint: of training and timeline together; a checkpoint of another one is refused.
        provenance: goes into the policies.
    """

    training: Training
    members: tuple[int, ...]
    timeline: SimulatorTimeline | None
    fingerprint: str
    provenance: dict[str, Any]


def train_group(
    group: Group,
    checkpoint: Path | None,
    progress: Progress,
    *,
    checkpoint_s: float = CHECKPOINT_S,
    add_part: AddPart | None = None,
) -> list[Policy]:
    """Train a group of policies, going on from its checkpoint where there is one.

    The result is the same, bit for bit, however often the training was stopped and started again.

    Args:
        group: the policies to train.
        checkpoint: file to write now and then, complete or absent; the caller removes it when it is done with. None:
            none is written.
        progress: told after each chunk how many are done, and the mean return of the episodes that ended in it.
        checkpoint_s: seconds between checkpoints; they change how much is done again, never the result.
        add_part: given each part of the learning curves, a row a policy, those from the checkpoint first.

    Raises:
        InvalidFile: if the checkpoint cannot be read or written, or is of another training.
    """
    return train_groups([group], checkpoint, progress, checkpoint_s=checkpoint_s, add_parts=[add_part])[0]


def train_groups(
    groups: Sequence[Group],
    checkpoint: Path | None,
    progress: Progress,
    *,
    checkpoint_s: float = CHECKPOINT_S,
    add_parts: Sequence[AddPart | None],
    keeps_end: bool = False,
) -> list[list[Policy]]:
    """Train several groups of policies at once, as `train_group` does one; returns the policies of each.

    How many are trained at once changes the last bits.

    Args:
        groups: that can be trained at once (`animat.execution.gpu.programs_among`).
        checkpoint, progress: as of `train_group`.
        checkpoint_s: as there.
        add_parts: of each group, as there, or None.
        keeps_end: whether a checkpoint is written at the end, too: from it the same policies come at once.
    """
    together = SideBySide(*groups)
    done = together.resume(checkpoint) if checkpoint is not None and checkpoint.exists() else 0
    at = [_simulators_of(group) for group in groups]

    def tell(part: Float64[np.ndarray, "policies columns"]) -> None:
        for rows, add_part in zip(together.split(part), add_parts, strict=True):
            if add_part is not None:
                add_part(rows)

    for part in together.curve:
        tell(part)
    written = time.monotonic()
    for index in range(done, CHUNKS):
        mean_return = together.train(index, *(simulator_at(index) for simulator_at in at))
        tell(together.curve[-1])
        is_due = time.monotonic() - written > checkpoint_s or (keeps_end and index + 1 == CHUNKS)
        if checkpoint is not None and is_due:
            together.keep(checkpoint)
            written = time.monotonic()
        returned = "" if math.isnan(mean_return) else f"return {mean_return:.1f}"
        progress.update(index + 1, CHUNKS, ", ".join(filter(None, (returned, together.note()))))
    return together.split(together.policies())


def _simulators_of(group: Group) -> Callable[[int], NeuronSimulator | None]:
    """The simulator that a group is trained on in each chunk; where episodes draw theirs, all of them."""
    training, timeline = group.training, group.timeline
    if timeline is None:
        return lambda _: None
    if training.percentiles == "first":
        timeline = timeline.with_first_percentiles()
    if training.shadowing == "drawn":
        return lambda _: timeline.simulators
    return lambda index: timeline.at(float(timeline.start_min[0]) + training.minute(index))


def untrained_policies(group: Group) -> list[Policy]:
    """A group's policies as they are before their first iteration: what training is compared with."""
    return SideBySide(group).policies()


def save_policies(group: Group, policies: Sequence[Policy], folder: Path) -> list[Path]:
    """Write a group's policies by their numbers in the training, and the best of each beside; returns the files."""
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
    """`begin` and `train_chunk` for several policies side by side, to be compiled when they are first called.

    The same for the same arguments: a process that trains one group after another traces them once.

    Args:
        environment: what they act in.
        algorithm: settings of all.
        own_simulators: whether each policy has its own simulator, rather than one for all.
    """
    limited = EpisodeLimit(environment)
    beginning = jax.vmap(partial(begin, limited, algorithm))
    chunk = jax.vmap(partial(train_chunk, limited, algorithm), in_axes=(0, 0 if own_simulators else None, None, None))
    return (
        jax.jit(beginning, compiler_options=COMPILER_OPTIONS),
        jax.jit(chunk, donate_argnums=0, compiler_options=COMPILER_OPTIONS),
    )


class SideBySide:
    """The policies of a group while they are trained: chunk after chunk, each with the simulator it is handed.

    Args:
        group: the policies; of its timeline only what all simulators of it share is used.
        others: trained with them by the same program, the same number of rounds. Where any is of another training,
            none has lessons or is stepped outside JAX.
        own_programs: `begin` and `train_chunk` for all of them, in place of `programs`.
        is_followed: whether they are diagnosed after each chunk, and expected to be finite numbers. Without, the
            learning curves have NaN in place of the diagnosis.
    """

    def __init__(
        self,
        group: Group,
        *others: Group,
        own_programs: Sequence[Callable[..., Any]] = (),
        is_followed: bool = True,
    ) -> None:
        training = group.training
        self._groups = groups = (group, *others)
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
            beginning, self._chunk = programs_on_host(self._environment, training.algorithm)
        else:
            beginning, self._chunk = programs(self._environment, training.algorithm, self._own_simulators)
        keys = [jax.random.fold_in(jax.random.key(each.training.seed), member) for each, member in self._places]
        self._diagnose = diagnosing(self._environment, training.algorithm) if is_followed else None
        self._learners = beginning(jnp.stack(keys))
        self.curve: list[Float64[np.ndarray, "policies columns"]] = []
        """The learning curves so far: of each part, a row a policy."""

    def split(self, rows: Rows) -> list[Rows]:
        """What there is of each policy, cut into that of each group."""
        ends = np.cumsum([len(group.members) for group in self._groups])
        return [rows[end - len(group.members) : end] for group, end in zip(self._groups, ends, strict=True)]

    def train(self, index: int, *simulators: NeuronSimulator | None) -> float:
        """Train one chunk; returns the mean return of the episodes that ended in it, NaN for none.

        Chunks are numbered on from 0; one may go beyond those of the training.

        Args:
            index: of the chunk.
            simulators: of each group; None without neurons.

        Raises:
            UnusableData: if what was learned is no longer a finite number, where it is followed.
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
            # Before a checkpoint is written, from which no training would recover.
            self._expect_finite(within=iterations[0])
            available = jnp.int32(min(last * algorithm.environments, algorithm.replay))
            diagnosis = self._diagnose(self._learners, available)
        with np.errstate(invalid="ignore"):
            self.curve.append(np.stack([iterations, episodes, returns / episodes, *diagnosis], axis=1))
        if self._course is not None:
            self._course.assess(index, self._learners.deployed, simulator)
        return float(returns.sum() / episodes.sum()) if episodes.sum() else float("nan")

    def _expect_finite(self, within: int) -> None:
        robot, deployed = self._groups[0].training.robot, jax.tree.leaves(self._learners.deployed)
        if not all(np.isfinite(leaf).all() for leaf in deployed):
            raise UnusableData(
                f"{robot.name}: expected finite rewards and observations, got NaN or infinite ones "
                f"within {within:,} iterations"
            )

    def note(self) -> str:
        """What there is to tell beside returns: how far the policies are in their lessons."""
        return "" if self._course is None else self._course.note()

    def policies(self) -> list[Policy]:
        """What they are now, each with its best where they are assessed."""
        return [self._policy(i) for i in range(len(self._places))]

    def _policy(self, i: int) -> Policy:
        done = len(self.curve)
        curve = np.stack(self.curve)[:, i] if done else np.zeros((0, len(CURVE)))
        now = self._as_policy(i, self._learners.deployed, curve)
        if self._course is None or not done or not self._groups[0].training.episodes_assessed:
            return now
        standing = self._course.standing
        assessments, until = standing.table[:done, i].copy(), int(standing.best_at[i]) + 1
        kept = replace(self._as_policy(i, standing.best, curve[:until]), assessments=assessments[:until])
        return replace(now, assessments=assessments, best=kept)

    def _as_policy(self, i: int, networks: Network, curve: np.ndarray) -> Policy:
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

    def keep(self, checkpoint: Path, group: int | None = None) -> None:
        """Write a checkpoint, of all policies or of those of one group, by its place."""
        learners = self._learners._replace(key=jax.random.key_data(self._learners.key))
        leaves = jax.tree.leaves((learners, self._standing))
        members = np.array([member for _, member in self._places])
        ours = slice(None) if group is None else self.split(np.arange(len(members)))[group]
        arrays: dict[str, Any] = {f"leaf{i}": np.asarray(leaf)[ours] for i, leaf in enumerate(leaves)}
        arrays |= {"fingerprint": np.array(self.fingerprint), "done": np.array(len(self.curve))}
        with atomic_write(checkpoint) as beside, beside.open("wb") as file:
            # Whose curves they are is for the live page alone.
            np.savez(file, curve=np.stack(self.curve)[:, ours], members=members[ours], **arrays)

    def resume(self, *checkpoints: Path) -> int:
        """Go on from a checkpoint, or from one of each group, of as many policies; returns how many chunks are done."""
        like: Any = self._learners._replace(key=jax.random.key_data(self._learners.key)), self._standing
        if checkpoints[1:]:
            n = len(self._places) // len(checkpoints)
            like = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[:n], like))
        (done, (learners, standing), curve), *others = (
            _read_checkpoint(each, self.fingerprint, like) for each in checkpoints
        )
        if others:
            learners = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), learners, *(each[1][0] for each in others))
            curve = np.concatenate([curve, *(each[2] for each in others)], axis=1)
        self._learners = learners._replace(key=jax.random.wrap_key_data(learners.key))
        if self._course is not None:
            self._course.standing = standing
        self.curve = list(curve[:done])
        return done

    @property
    def fingerprint(self) -> str:
        """Of all that decides how the policies come out."""
        return "+".join(dict.fromkeys(group.fingerprint for group in self._groups))

    @property
    def _standing(self) -> Any:
        return () if self._course is None else self._course.standing


def _read_checkpoint(path: Path, fingerprint: str, like: Any) -> tuple[int, Any, np.ndarray]:
    """Of a checkpoint: how many chunks are done, learners with how far they stand, as in `like`, and the curve."""
    leaves, structure = jax.tree.flatten(like)
    n_standing, policies = len(jax.tree.leaves(like[1])), leaves[0].shape[0]
    try:
        # Opened here, as numpy leaves a file open that it cannot read.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            # Before anything is read of it: an archive of some kilobytes can unpack to any size.
            unpacked = sum(member.file_size for member in file.zip.infolist())
            most = 2 * sum(leaf.size * leaf.dtype.itemsize for leaf in leaves) + 2**22
            if unpacked > most:
                raise InvalidFile(
                    f"{path}: expected a checkpoint of at most {most:,} bytes, got {unpacked:,}; remove it"
                )
            if str(file["fingerprint"]) != fingerprint:
                raise InvalidFile(f"{path}: expected a checkpoint of this training, got one of another; remove it")
            kept = [file[f"leaf{i}"] for i in range(sum(name.startswith("leaf") for name in file.files))]
            done, curve = int(file["done"]), file["curve"]
            forms = [[(a.shape, a.dtype) for a in arrays] for arrays in (kept, leaves)]
            if forms[0] != forms[1] or not 0 < done <= CHUNKS or curve.shape != (done, policies, len(CURVE)):
                raise InvalidFile(
                    f"{path}: expected a checkpoint as this animat writes it, of {policies} policies together, "
                    f"got another's; to begin these anew: rm '{path}'"
                )
            # What is not on its way to JAX stays numpy's, of 64 bits.
            n = len(leaves) - n_standing
            read = [jnp.asarray(array) for array in kept[:n]] + kept[n:]
    except InvalidFile:
        raise
    except Exception as error:  # numpy, zipfile and zlib have a dozen kinds of errors for a damaged archive
        raise InvalidFile(
            f"{path}: expected a checkpoint, got a file that cannot be read ({error}); remove it"
        ) from error
    return done, jax.tree.unflatten(structure, read), curve


def split_groups(policies: int, *, fewest: int = 1) -> list[tuple[int, ...]]:
    """Cut the numbers of the policies into groups as even as possible, none larger than five.

    It depends on nothing else, not on the machine: how many are trained side by side could change the last bits.

    Args:
        policies: how many there are.
        fewest: groups at least, where there are as many policies: two keep two cores busy.
    """
    n_groups = max(-(-policies // 5), min(fewest, policies))
    return [tuple(part.tolist()) for part in np.array_split(np.arange(policies), n_groups)]
