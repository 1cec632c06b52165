"""Training as jobs: each a group of one condition's policies on one robot, with its checkpoint in the folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from animat.coding.mapping import mapping_named
from animat.execution.task import UNFINISHED
from animat.execution.training import train_into
from animat.neurons.timeline import SimulatorTimeline
from animat.progress import Progress
from animat.studies.draws import draw_seed
from animat.studies.places import TIMELINE, policies_folder
from animat.studies.simulating import load_timeline
from animat.studies.specification import Body, Study, StudyCondition
from animat.studies.task import StudyTask
from animat.training.folder import describe, provenance_of, write_description
from animat.training.group import Group, save_policies, untrained_policies
from animat.training.settings import SAC
from animat.training.specification import Training


@final
@dataclass(frozen=True)
class TrainGroup(StudyTask):
    """Train some policies of a condition on a robot, going on from where a killed run stopped."""

    sizes = ("algorithm",)

    body: Body
    condition: StudyCondition
    members: tuple[int, ...]

    def make(self, folder: Path, progress: Progress) -> list[Path]:
        timeline = timeline_for(self.condition, folder)
        training = training_of(self.study, self.body, self.condition)
        manifest = describe(training, timeline)
        out = policies_folder(folder, self.body, self.condition)
        group = Group(training, self.members, timeline, manifest["fingerprint"], provenance_of(manifest))
        checkpoint = folder / UNFINISHED / self.body.name / self.condition.slug / f"p{self.members[0]}.npz"
        if self.condition.trained:
            files = train_into(out, group, checkpoint, progress)
        else:
            files = save_policies(group, untrained_policies(group), out)
        return [*files, write_description(out, manifest)]


def training_of(study: Study, body: Body, condition: StudyCondition) -> Training:
    """What a condition means for the trainer."""
    through_neurons = condition.through_neurons
    return Training(
        robot=body.robot(),
        mapping=mapping_named(condition.mapping) if through_neurons else None,
        policies=study.policies,
        iterations=body.trained_for,
        # Tests of ranks take the policies of two conditions for independent: none starts as another one does.
        seed=draw_seed("training", study.seed, body.name, condition.slug),
        shadowing=condition.shadowing,
        duration_min=study.training_min,
        percentiles=condition.percentiles,
        delivery=condition.delivery,
        commands=None if through_neurons else body.robot().baseline_commands,
        algorithm=SAC(**study.algorithm),  # type: ignore[arg-type]
    )


def timeline_for(condition: StudyCondition, folder: Path) -> SimulatorTimeline | None:
    """The study's simulators, for a condition that has neurons."""
    return load_timeline(folder / TIMELINE) if condition.through_neurons else None
