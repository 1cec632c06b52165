"""Training as jobs: each a group of one condition's policies on one robot, with its checkpoint in the folder."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import final

from animat.mapping import mapping_named
from animat.neurons.timeline import SimulatorTimeline
from animat.studies.draws import draw_seed
from animat.studies.jobs import Report, Task
from animat.studies.places import TIMELINE, UNFINISHED, policies_folder
from animat.studies.simulating import load_timeline
from animat.studies.specification import Body, Study, StudyCondition
from animat.training.group import Group, train_group, untrained_policies
from animat.training.settings import SAC
from animat.training.specification import CHUNKS, Training
from animat.training.trainer import MANIFEST, describe, provenance_of
from animat.writing import written_whole


@final
@dataclass(frozen=True)
class TrainGroup(Task):
    """Train some policies of a condition on a robot, going on from where a killed run stopped."""

    grows_with = ("algorithm",)

    body: Body
    condition: StudyCondition
    members: tuple[int, ...]

    def run(self, study: Study, folder: Path, report: Report) -> list[Path]:
        timeline = timeline_for(self.condition, folder)
        training = training_of(study, self.body, self.condition)
        manifest = describe(training, timeline)
        out = policies_folder(folder, self.body, self.condition)
        group = Group(training, self.members, timeline, manifest["fingerprint"], provenance_of(manifest))
        checkpoint = folder / UNFINISHED / self.body.name / self.condition.slug / f"p{self.members[0]}.npz"

        def told(done: int, mean_return: float) -> None:
            report(done / CHUNKS, "" if math.isnan(mean_return) else f"return {mean_return:.1f}")

        policies = train_group(group, checkpoint, told) if self.condition.trained else untrained_policies(group)
        files = [out / f"p{member}.safetensors" for member in self.members]
        for file, policy in zip(files, policies, strict=True):
            policy.save(file)
        with written_whole(out / MANIFEST) as beside:
            beside.write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")
        checkpoint.unlink(missing_ok=True)
        return [*files, out / MANIFEST]


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
