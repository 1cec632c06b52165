"""The tasks of a tuning: fitting simulators of one kind, and training trials side by side up to a rung."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from animat.compilation import jit_side_by_side
from animat.environment import Environment
from animat.evaluation.rollouts import Networks, roll_out
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline, load_timeline, save_timeline
from animat.progress import Progress
from animat.studies.recording import fit_study_timeline, read_series
from animat.studies.specification import Study
from animat.studies.task import StudyTask
from animat.studies.training import training_of
from animat.training.group import CHECKPOINT_S, Group, SideBySide
from animat.training.sac import Learner, begin, train_chunk
from animat.training.settings import SAC
from animat.training.specification import CHUNKS, Training
from animat.tuning.search import Trial
from animat.tuning.specification import NUMBERS, with_settings
from animat.writing import write_whole

Numbers = dict[str, Array]


def timeline_file(study: Study) -> Path:
    """The file of the simulators with a study's kind, conditions and readouts, in a tuning's folder."""
    simulators = study.simulators
    details = simulators.conditions + ("" if simulators.readouts == "all" else f" {simulators.readouts}")
    digest = hashlib.sha256(details.encode()).hexdigest()[:8]
    return Path("simulators") / f"{simulators.kind}{details and '-' + digest}.safetensors"


class FitVariant(StudyTask):
    """Fit a simulator of the study's kind to the responses of each recording."""

    sizes = ("culture.sessions", "culture.trials", "simulators.bins")

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        timeline = fit_study_timeline(self.study, read_series(self.study, folder))
        return [save_timeline(timeline, folder / timeline_file(self.study))]


@lru_cache(maxsize=8)
def programs(environment: Environment[Any], algorithm: SAC) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`begin` and `train_chunk` for several policies, each with its own values of `NUMBERS` as the first argument.

    The programs of ordinary training (`animat.training.group.programs`) have these settings compiled in.
    """

    def beginning(numbers: Numbers, key: Array) -> Learner:
        learner = begin(environment, algorithm, key)
        return learner._replace(trained=learner.trained._replace(log_alpha=jnp.log(numbers["initial_alpha"])))

    def chunk(numbers: Numbers, learner: Learner, simulator: NeuronSimulator | None, first: Array, last: Array) -> Any:
        # Bypasses the record's checks, which would fail for traced numbers.
        settings = object.__new__(SAC)
        vars(settings).update({**vars(algorithm), **numbers})
        return train_chunk(environment, settings, learner, simulator, first, last)

    return jit_side_by_side(beginning), jit_side_by_side(chunk, (0, 0, None, None, None), donate_argnums=1)


class TrialsSideBySide(SideBySide):
    """The policies of several trials during training, one group per trial; their settings differ only in `NUMBERS`.

    The numbers of each trial's policies, `members`, decide their random numbers: all trials use the same ones.
    """

    def __init__(
        self, training: Training, timeline: SimulatorTimeline | None, algorithms: Sequence[SAC], members: Sequence[int]
    ) -> None:
        # The default numbers stand in, so that trials with other numbers reuse the compiled program.
        defaults = {name: getattr(SAC(), name) for name in NUMBERS}
        training = replace(training, algorithm=replace(algorithms[0], **defaults))
        numbers = {
            name: jnp.repeat(jnp.array([getattr(settings, name) for settings in algorithms], jnp.float32), len(members))
            for name in NUMBERS
        }
        compiled = programs(training.environment_on(timeline), training.algorithm)
        groups = [Group(training, tuple(members), timeline, "", {})] * len(algorithms)
        # Nobody reads their curves, and a diverging trial must not stop the others.
        super().__init__(*groups, own_programs=[partial(program, numbers) for program in compiled], is_diagnosed=False)

    def networks(self, trial: int, *, greedy: bool) -> Networks | None:
        """The deployable policies of a trial; None if their parameters are not finite."""
        network = jax.tree.map(lambda leaf: self.split(np.asarray(leaf))[trial], self._learners.deployed)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(network)):
            return None
        scales = jnp.tile(jnp.asarray(self._environment.scales, jnp.float32), (len(network[0].weight), 1))
        return Networks(network, scales, greedy)


@dataclass(frozen=True)
class TrainTrials(StudyTask):
    """Train trials of equal shape side by side, from one rung to the next, and evaluate them.

    Each is trained on simulators of its own kind, and evaluated on those of the study's kind, as otherwise the kind
    that is easiest to control would win. All trials use the same random numbers.

    Attributes:
        seeds: of training and, for the group of the first policies, of the episodes.
        chunks: the chunks of training, from the first up to but excluding the last.
        place: folder of the returns and, up to the end of training, of the learners, relative to the tuning's.
    """

    sizes = ("algorithm",)

    trials: tuple[Trial, ...]
    members: tuple[int, ...]
    seeds: tuple[int, int]
    episodes: int
    chunks: tuple[int, int]
    place: str

    @property
    def reads(self) -> tuple[str, ...]:
        """Places of the files that it reads, which other jobs wrote."""
        study, first = with_settings(self.study, self.trials[0].settings), self.chunks[0]
        places = [_learner_file(Path(self.place), trial, first, self.members[0]) for trial in self.trials if first]
        if study.arms[0].through_neurons:
            places += {timeline_file(each) for each in (study, _judging_study(self.study, study))}
        return tuple(place.as_posix() for place in places)

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        # In 32 bits, even where the user's own code computes in 64, as in other trainings.
        with jax.enable_x64(False):
            return self._train(folder, progress)

    def _train(self, folder: Path, progress: Progress) -> list[Path]:
        place, (first, last) = folder / self.place, self.chunks
        studies = [with_settings(self.study, trial.settings) for trial in self.trials]
        algorithms = [SAC(**study.algorithm) for study in studies]  # type: ignore[arg-type]
        training = training_of(studies[0], self.study.robots[0], studies[0].arms[0])
        training = replace(training, seed=self.seeds[0], policies=len(self.members))
        timeline = _timeline(folder, studies[0])
        judging = _timeline(folder, _judging_study(self.study, studies[0]))
        together = TrialsSideBySide(training, timeline, algorithms, self.members)

        numbers = ",".join(str(trial.trial) for trial in self.trials)
        checkpoint = place / f"t{numbers}-p{self.members[0]}-to-{last}-of-{CHUNKS}.npz"
        learners = [_learner_file(place, trial, first, self.members[0]) for trial in self.trials if first]
        files = [checkpoint] if checkpoint.exists() else learners
        done = together.resume(*files) if files else 0
        written = time.monotonic()
        for index in range(done, last):
            together.train(index, _simulator_at(timeline, training.minute(index)))
            progress.update(index + 1 - first, last - first + 1)
            if index + 1 < last and time.monotonic() - written > CHECKPOINT_S:
                together.save_checkpoint(checkpoint)
                written = time.monotonic()

        environment = training.environment_on(timeline)
        simulator = _simulator_at(judging, training.minute(CHUNKS - 1))
        # A different seed for each group: else the first policies of two groups would have the same episodes.
        seed = self.seeds[1] + self.members[0]
        files = []
        for i, trial in enumerate(self.trials):
            networks = together.networks(i, greedy=self.study.actions == "most probable")
            returns: list[float] | None = None
            if networks is not None:
                ran = roll_out(environment, simulator, networks, episodes=self.episodes, seed=seed)
                means = ran.returns.mean(axis=1)
                returns = means.tolist() if np.isfinite(means).all() else None
            file = returns_file(place, trial, last, self.members[0])
            files.append(write_whole(file, json.dumps(returns) + "\n"))
            if last < CHUNKS:
                files.append(_learner_file(place, trial, last, self.members[0]))
                together.save_checkpoint(files[-1], i)
        checkpoint.unlink(missing_ok=True)
        return files


def returns_file(place: Path, trial: Trial, chunks: int, member: int) -> Path:
    """The JSON file with the mean return of each of a trial's policies after so many chunks; null if not finite."""
    return _learner_file(place, trial, chunks, member).with_suffix(".json")


def _learner_file(place: Path, trial: Trial, chunks: int, member: int) -> Path:
    return place / f"t{trial.trial}-p{member}-{chunks}.npz"


def _judging_study(own: Study, trial: Study) -> Study:
    """The study that judges a trial: with simulators of the study's own kind, for the trial's conditions."""
    return replace(trial, simulators=replace(trial.simulators, kind=own.simulators.kind))


def _timeline(folder: Path, study: Study) -> SimulatorTimeline | None:
    if not study.arms[0].through_neurons:
        return None
    return load_timeline(folder / timeline_file(study)).with_percentiles(study.arms[0].percentiles)


def _simulator_at(timeline: SimulatorTimeline | None, minute: float) -> Any:
    """The simulator in use `minute` minutes after the first recording; None without neurons."""
    return None if timeline is None else timeline.at(float(timeline.start_min[0]) + minute)


def group_by_shape(trials: Sequence[Trial], policies: int) -> list[tuple[Trial, ...]]:
    """Groups of trials that one compiled program can train: they differ only in `NUMBERS`, five policies at most.

    It depends only on the trials, as it can change the last bits. Two or more make at least two groups, for two cores.
    """
    by_shape: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        shape = tuple((name, value) for name, value in trial.settings.items() if name not in NUMBERS)
        by_shape.setdefault(shape, []).append(trial)
    most = max(1, 5 // policies)
    groups = []
    for same in by_shape.values():
        n = max(-(-len(same) // most), min(2, len(same)) if len(by_shape) == 1 else 1)
        groups += [tuple(same[i] for i in part) for part in np.array_split(np.arange(len(same)), n)]
    return groups
