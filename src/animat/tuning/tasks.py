"""The tasks of a tuning: fitting a simulator of a kind, and training trials side by side up to a rung."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from animat.errors import UnusableData
from animat.evaluation.rollouts import roll_out
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.studies.simulating import fit_simulators, load_timeline, one_condition, read_series, save_timeline
from animat.studies.specification import Study
from animat.studies.task import StudyTask
from animat.studies.training import training_of
from animat.training.group import CHECKPOINT_S
from animat.training.settings import SAC
from animat.training.specification import CHUNKS
from animat.tuning.side_by_side import Trials
from animat.tuning.space import NUMBERS, Settings, with_settings
from animat.writing import write_whole


def timeline_file(study: Study) -> Path:
    """Where the simulators of a study's kind, conditions and readouts lie, in a tuning's folder."""
    simulators = study.simulators
    other = simulators.conditions + ("" if simulators.readouts == "all" else f" {simulators.readouts}")
    digest = hashlib.sha256(other.encode()).hexdigest()[:8]
    return Path("simulators") / f"{simulators.kind}{other and '-' + digest}.safetensors"


@final
@dataclass(frozen=True)
class Fit(StudyTask):
    """Fit a simulator of the study's kind to the responses of each recording."""

    sizes = ("culture.sessions", "culture.trials", "simulators.bins")

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        timeline = fit_simulators(self.study, read_series(self.study, folder))
        if len(timeline.conditions) < 2:
            raise UnusableData(one_condition(timeline))
        save_timeline(timeline, folder / timeline_file(self.study))
        return [folder / timeline_file(self.study)]


@dataclass(frozen=True)
class Trial:
    """Settings that are tried, with a number that counts from 0."""

    number: int
    settings: Settings


@final
@dataclass(frozen=True)
class TrainTrials(StudyTask):
    """Train trials that share their shapes side by side, from one rung to the next, and see what they get.

    Each is trained on simulators of its own kind and run in episodes on those of the study's, as the best is to do well
    there: a kind that is easy to act on would win otherwise. All have the same random numbers.

    Attributes:
        trials: which.
        members: numbers of their policies.
        seeds: of training, and of the episodes.
        episodes: of each policy.
        chunks: of the training, from the first up to, not including, the last.
        place: folder of what is learned and of the returns, as seen from the tuning's.
        goes_on: whether what is learned is kept for the next rung.
    """

    sizes = ("algorithm",)

    trials: tuple[Trial, ...]
    members: tuple[int, ...]
    seeds: tuple[int, int]
    episodes: int
    chunks: tuple[int, int]
    place: str
    goes_on: bool

    @property
    def reads(self) -> tuple[str, ...]:
        """Places of the files that it reads, which other jobs left."""
        study, first = with_settings(self.study, self.trials[0].settings), self.chunks[0]
        places = [kept_file(Path(self.place), trial, first, self.members[0]) for trial in self.trials] if first else []
        if study.arms[0].through_neurons:
            places += {timeline_file(each) for each in (study, replace(study, simulators=_judge(self.study, study)))}
        return tuple(place.as_posix() for place in places)

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        place, (first, last) = folder / self.place, self.chunks
        studies = [with_settings(self.study, trial.settings) for trial in self.trials]
        algorithms = [SAC(**study.algorithm) for study in studies]  # type: ignore[arg-type]
        training = training_of(studies[0], self.study.robots[0], studies[0].arms[0])
        training = replace(training, seed=self.seeds[0], policies=len(self.members))
        taught = _timeline(folder, studies[0])
        judged = _timeline(folder, replace(studies[0], simulators=_judge(self.study, studies[0])))
        together = Trials(training, taught, algorithms, self.members)

        checkpoint = place / f"{self._name}.npz"
        kept = [kept_file(place, trial, first, self.members[0]) for trial in self.trials if first]
        left = [checkpoint] if checkpoint.exists() else kept
        done = together.resume(*left) if left else 0
        written = time.monotonic()
        for index in range(done, last):
            together.train(index, _at(taught, training.minute(index)))
            progress.update(index + 1 - first, last - first + 1)
            if index + 1 < last and time.monotonic() - written > CHECKPOINT_S:
                together.keep(checkpoint)
                written = time.monotonic()

        environment = training.environment_on(taught)
        files = []
        for i, trial in enumerate(self.trials):
            networks = together.networks(i, greedy=self.study.actions == "most probable")
            returns: list[float] | None = None
            if networks is not None:
                simulator = _at(judged, training.minute(CHUNKS - 1))
                n = len(self.members)
                ran = roll_out(environment, simulator, networks, n, episodes=self.episodes, seed=self.seeds[1])
                returns = ran.returns.mean(axis=1).tolist()
                if not np.isfinite(returns).all():
                    returns = None
            file = returns_file(place, trial, last, self.members[0])
            files.append(write_whole(file, json.dumps(returns) + "\n"))
            if self.goes_on:
                files.append(kept_file(place, trial, last, self.members[0]))
                together.keep(files[-1], i)
        checkpoint.unlink(missing_ok=True)
        return files

    @property
    def _name(self) -> str:
        numbers = ",".join(str(trial.number) for trial in self.trials)
        return f"t{numbers}-p{self.members[0]}-to-{self.chunks[1]}-of-{CHUNKS}"


def returns_file(place: Path, trial: Trial, chunks: int, member: int) -> Path:
    """The mean return of each of a trial's policies after so many chunks, JSON; null where learning went wrong."""
    return place / f"t{trial.number}-p{member}-{chunks}.json"


def kept_file(place: Path, trial: Trial, chunks: int, member: int) -> Path:
    """What a trial's policies had learned after so many chunks."""
    return place / f"t{trial.number}-p{member}-{chunks}.npz"


def _judge(own: Study, trial: Study) -> Any:
    """Simulators of the study's own kind, with the trial's conditions."""
    return replace(trial.simulators, kind=own.simulators.kind)


def _timeline(folder: Path, study: Study) -> SimulatorTimeline | None:
    if not study.arms[0].through_neurons:
        return None
    timeline = load_timeline(folder / timeline_file(study))
    return timeline.with_first_percentiles() if study.arms[0].percentiles == "first" else timeline


def _at(timeline: SimulatorTimeline | None, minute: float) -> Any:
    """The simulator in use a time after the first recording; None without neurons."""
    return None if timeline is None else timeline.at(float(timeline.start_min[0]) + minute)


def same_shapes(trials: Sequence[Trial], policies: int) -> list[tuple[Trial, ...]]:
    """Groups of trials that one compiled program can train: they differ in numbers only, five policies at most.

    Which are trained side by side depends on the trials alone, not on the machine: it could change the last bits. Two
    groups at least, where there are two trials: they keep two cores busy.
    """
    alike: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        shape = tuple((name, value) for name, value in trial.settings.items() if name not in NUMBERS)
        alike.setdefault(shape, []).append(trial)
    most = max(1, 5 // policies)
    groups = []
    for each in alike.values():
        n = max(-(-len(each) // most), min(2, len(each)) if len(alike) == 1 else 1)
        groups += [tuple(each[i] for i in part) for part in np.array_split(np.arange(len(each)), n)]
    return groups
