"""Training jobs, each for a group of one arm's policies on one robot, with its checkpoint in the folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from animat.coding.mapping import mapping_named
from animat.devices import gpu_here
from animat.execution.task import UNFINISHED
from animat.execution.training_task import TrainingTask, TrainingWork, train_alone
from animat.neurons.timeline import SimulatorTimeline, load_timeline
from animat.progress import Progress
from animat.studies.folder import TIMELINE, policies_folder
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.task import StudyTask, study_seed
from animat.training.folder import describe_training, provenance_of
from animat.training.group import Group, SideBySide
from animat.training.settings import SAC
from animat.training.specification import Training


@dataclass(frozen=True)
class TrainArm(StudyTask, TrainingTask):
    """Train some policies of an arm on a robot, resuming where a killed run stopped."""

    sizes = ("algorithm",)

    spec: RobotSpec
    arm: Arm
    members: tuple[int, ...]

    @property
    def training(self) -> Training | None:
        return training_of(self.study, self.spec, self.arm) if self.arm.trained else None

    def prepare(self, folder: Path) -> TrainingWork:
        timeline = load_timeline(folder / TIMELINE) if self.arm.through_neurons else None
        training = training_of(self.study, self.spec, self.arm)
        checkpoint = folder / UNFINISHED / self.spec.name / self.arm.slug / f"p{self.members[0]}.npz"
        return work_on(training, self.members, timeline, policies_folder(folder, self.spec, self.arm), checkpoint)

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        work = self.prepare(folder)
        return train_alone(work, progress) if self.arm.trained else work.save(SideBySide(work.group).policies())


def work_on(
    training: Training, members: tuple[int, ...], timeline: SimulatorTimeline | None, place: Path, checkpoint: Path
) -> TrainingWork:
    """The work of training some policies, with a description for the policies' folder."""
    manifest = describe_training(training, timeline, device=gpu_here())
    group = Group(training, members, timeline, manifest["fingerprint"], provenance_of(manifest))
    return TrainingWork(group, place, checkpoint, description=manifest)


def training_of(study: Study, spec: RobotSpec, arm: Arm) -> Training:
    """The training of an arm's policies on a robot."""
    through_neurons = arm.through_neurons
    return Training(
        robot=spec.robot(),
        mapping=mapping_named(arm.mapping) if through_neurons else None,
        policies=study.policies,
        iterations=spec.trained_for,
        seed=study_seed(study, "training", spec.name, arm.slug),
        shadowing=arm.shadowing if through_neurons else bool(arm.shadowing),
        duration_min=study.training_min,
        percentiles=arm.percentiles,
        delivery=arm.delivery,
        commands=None if through_neurons else spec.robot().baseline_commands,
        algorithm=SAC(**study.algorithm),  # type: ignore[arg-type]
        lessons=spec.lessons,
    )
