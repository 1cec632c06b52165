"""The jobs of a study and their dependencies."""

from __future__ import annotations

from pathlib import Path

from animat.execution.jobs import Job
from animat.studies.folder import MANIFEST
from animat.studies.specification import Arm, Study

ITERATIONS_PER_S = 110_000
"""Training speed on one core, all policies of a group together; used only to order jobs and estimate the time left."""


def plan_study(study: Study, base: Path) -> list[Job]:
    """All jobs of a study, whose files are relative to `base`."""
    # Tasks import JAX, which the command line should not load.
    from animat.studies.evaluating import Control, Evaluate
    from animat.studies.optima import FindOptima, kinds_of
    from animat.studies.pictures import CulturePictures, RobotPictures
    from animat.studies.publishing import Publish
    from animat.studies.recording import JOB, Record
    from animat.studies.simulating import Fit
    from animat.studies.tabulating import Tabulate
    from animat.studies.training import TrainGroup
    from animat.training.group import split_groups

    jobs: list[Job] = []
    neurons: tuple[str, ...] = ()
    if study.needs_neurons:
        sessions = study.culture.sessions
        jobs += [
            Job(JOB, Record(study, base), (), 2 + (2.5 if study.culture.kind == "virtual" else 0.3) * sessions),
            Job("fit", Fit(study), (JOB,), 3),
            Job("pictures/culture", CulturePictures(study), (JOB, "fit"), 15),
        ]
        neurons = ("fit",)
    results: list[str] = []
    for spec in study.robots:
        of_robot: list[Job] = []
        groups: dict[Arm, list[str]] = {arm: [] for arm in study.arms}
        for arm, names in groups.items():
            needs = neurons if arm.through_neurons else ()
            for members in split_groups(study.policies):
                names.append(f"train/{spec.name}/{arm.slug}/p{members[0]}")
                trained_s = spec.trained_for * len(members) / ITERATIONS_PER_S if arm.trained else 0.0
                of_robot.append(Job(names[-1], TrainGroup(study, spec, arm, members), needs, 4 + trained_s))
            # The minute is the last recording's, even without neurons.
            task = Evaluate(study, spec, arm)
            of_robot.append(Job(f"evaluate/{spec.name}/{arm.slug}", task, (*names, *neurons), 4))
        for kind in kinds_of(study):
            # The most plainly trained arm of a kind represents it.
            arms = study.arms_of(kind)
            plain = max(arms, key=lambda arm: (arm.trained, arm.delivery == "chosen", arm.shadowing is True))
            name = f"controls/{spec.name}/{kind.thresholds}"
            of_robot.append(Job(name, Control(study, spec, plain), (*groups[plain], *neurons), 15))
        resolution = spec.optimum_resolution or study.optimum_resolution
        cost_s = 40 * resolution ** len(spec.robot().observation_spec) + 10
        of_robot.append(Job(f"optimum/{spec.name}", FindOptima(study, spec), neurons, cost_s))
        if neurons:
            of_robot.append(Job(f"optimum/{spec.name}/over-time", FindOptima(study, spec, over_time=True), neurons, 12))
        needs = (*(job.name for job in of_robot), *neurons, "tables")
        jobs += [*of_robot, Job(f"pictures/{spec.name}", RobotPictures(study, spec), needs, 15)]
        results += [job.name for job in of_robot]
    jobs.append(Job("tables", Tabulate(study), (*results, *neurons), 2))
    pictures = [job.name for job in jobs if job.name.startswith("pictures/")]
    jobs.append(Job("report", Publish(study), (*pictures, "tables"), 1, (MANIFEST,)))
    return jobs
