"""Evaluation jobs: an arm's policies on one robot, and the controls that test what the culture contributes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from animat.environment import Environment
from animat.evaluation.controls import controls_of
from animat.evaluation.coupling import best_coupling
from animat.evaluation.rollouts import Actor, Episodes, Networks, Uniform, networks_of, roll_out
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline, load_timeline
from animat.progress import Progress
from animat.robots.host import HostRobot
from animat.studies.episodes import COUPLING, RANDOM, episode_rows, record_paths, write_episodes
from animat.studies.folder import TIMELINE, controls_file, episodes_file, policies_folder
from animat.studies.results import write_arrays
from animat.studies.specification import Arm, RobotSpec, Study, mapping_label
from animat.studies.task import StudyTask, study_seed
from animat.studies.training import training_of
from animat.training.policy import Policy


@dataclass(frozen=True)
class EvaluateArm(StudyTask):
    """Run an arm's policies at the minutes of its comparisons, at every recording, and once to record paths."""

    sizes = ("policies", "episodes", "episodes_over_time")

    spec: RobotSpec
    arm: Arm

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, timeline, first, last = as_recorded(self.study, folder)
        setting = setting_of(study, self.spec, self.arm, timeline)
        networks = _networks(study, folder, self.spec, self.arm)
        robot, slug = self.spec.name, self.arm.slug
        parts = []
        for at_min, episodes in study.minutes_of(self.arm, first, last).items():
            ran = setting.run(networks, at_min, episodes, study_seed(study, robot, slug, at_min))
            parts.append(episode_rows(ran, robot=robot, arm=self.arm.name, at_min=at_min))
        if self.arm.through_neurons and timeline is not None:
            for i, at_min in enumerate(timeline.start_min.tolist()):
                progress.update(i, len(timeline), "over time")
                seed = study_seed(study, robot, slug, at_min, "over time")
                ran = setting.run(networks, at_min, study.episodes_over_time, seed)
                parts.append(episode_rows(ran, robot=robot, arm=self.arm.name, at_min=at_min, over_time=True))
        seed = study_seed(study, robot, slug, last, "paths")
        paths = record_paths(setting.environment, setting.simulator(last), networks, seed)
        return [
            write_episodes(episodes_file(folder, self.spec, self.arm), parts),
            write_arrays(episodes_file(folder, self.spec, self.arm, "paths"), vars(paths)),
        ]


@dataclass(frozen=True)
class RunControls(StudyTask):
    """Run the controls of a mapping on a robot: that of the arm `plain`, whose policies are used if it `is_usual`.

    The best coupling is run at the last recording only, as its search takes as long as all other controls together.
    """

    sizes = ("policies", "episodes", "episodes_over_time")

    spec: RobotSpec
    plain: Arm

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        study, timeline, first, last = as_recorded(self.study, folder)
        arm, robot = replace(self.plain, delivery="chosen"), self.spec.name
        setting = setting_of(study, self.spec, arm, timeline)
        name = f"controls-{arm.thresholds}"
        through = mapping_label(*arm.kind)
        networks = _networks(study, folder, self.spec, self.plain) if is_usual(self.plain) else None
        parts = []
        minutes = study.optimum_minutes(first, last) if arm.through_neurons else [last]
        for i, at_min in enumerate(minutes):
            progress.update(i, len(minutes), f"at {at_min:g} min")
            simulator = setting.simulator(at_min)
            for each in controls_of(setting.environment, simulator, setting.action_labels, networks):
                seed = study_seed(study, robot, name, at_min, each.name)
                ran = each.run(setting.environment, simulator, episodes=study.episodes, seed=seed)
                parts.append(episode_rows(ran, robot=robot, arm=through, at_min=at_min, agent=each.name))
        if timeline is not None and arm.through_neurons:
            if networks is not None and not isinstance(setting.environment.robot, HostRobot):
                progress.update(len(minutes), len(minutes) + 1, "best coupling")
                seeds = [study_seed(study, robot, name, last, COUPLING, part) for part in ("search", "episodes")]
                coupling = best_coupling(setting.environment, setting.simulator(last), seed=seeds[0])
                ran = setting.run(coupling, last, study.episodes, seeds[1])
                parts.append(episode_rows(ran, robot=robot, arm=through, at_min=last, agent=COUPLING))
            for at_min in timeline.start_min.tolist():
                seed = study_seed(study, robot, name, at_min, "over time")
                ran = setting.run(Uniform(), at_min, study.episodes, seed)
                parts.append(episode_rows(ran, robot=robot, arm=through, at_min=at_min, agent=RANDOM, over_time=True))
        return [write_episodes(controls_file(folder, self.spec, arm), parts)]


class Setting(NamedTuple):
    """What policies run in: an environment, the simulators of every minute (None without neurons), action labels."""

    environment: Environment[Any]
    timeline: SimulatorTimeline | None
    action_labels: tuple[str, ...]

    def simulator(self, at_min: float) -> NeuronSimulator | None:
        return None if self.timeline is None else self.timeline.at(at_min)

    def run(self, actor: Actor, at_min: float, episodes: int, seed: int) -> Episodes:
        return roll_out(self.environment, self.simulator(at_min), actor, episodes=episodes, seed=seed)


def setting_of(study: Study, spec: RobotSpec, arm: Arm, timeline: SimulatorTimeline | None) -> Setting:
    """The setting in which an arm's policies are evaluated."""
    # Lessons are for training alone.
    training = training_of(study, replace(spec, lessons=()), arm)
    if not arm.through_neurons or timeline is None:
        labels = tuple(f"{command:+g}" for command in training.commands or ())
        return Setting(training.environment(0), None, labels)
    labels = tuple(each.label for each in timeline.conditions)
    return Setting(training.environment(len(labels)), timeline.with_percentiles(arm.percentiles), labels)


def as_recorded(study: Study, folder: Path) -> tuple[Study, SimulatorTimeline | None, float, float]:
    """The study with comparisons at the minutes of its recordings, their simulators, and their first and last minute.

    Without neurons there are no simulators, and both minutes are 0.
    """
    if not study.needs_neurons:
        return study.at_recordings([]), None, 0.0, 0.0
    timeline = load_timeline(folder / TIMELINE)
    start_min = timeline.start_min.tolist()
    return study.at_recordings(start_min), timeline, start_min[0], start_min[-1]


def is_usual(arm: Arm) -> bool:
    """Whether an arm's policies are trained, have neurons, and receive the stimulus that they choose."""
    return arm.trained and arm.delivery == "chosen" and arm.through_neurons


def policies_of(study: Study, folder: Path, spec: RobotSpec, arm: Arm) -> list[Policy]:
    return [Policy.load(policies_folder(folder, spec, arm) / f"p{i}.safetensors") for i in range(study.policies)]


def _networks(study: Study, folder: Path, spec: RobotSpec, arm: Arm) -> Networks:
    return networks_of(policies_of(study, folder, spec, arm), greedy=study.actions == "most probable")
