"""From a study to its jobs, and what each needs."""

from __future__ import annotations

from pathlib import Path

from animat.execution.jobs import Job
from animat.studies.specification import Body, Study, StudyCondition

ITERATIONS_PER_S = 110_000
"""Of training on one core, all policies of a group together; only the order of jobs and the time left rest on it."""


def plan_study(study: Study, base: Path) -> list[Job]:
    """All jobs of a study.

    Args:
        study: the specification.
        base: what the names of its files are relative to.
    """
    # Tasks bring JAX along; a finished folder is recognised without it only in part, but the command line stays light.
    from animat.studies.evaluating import Evaluate
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
    for body in study.robots:
        for condition in study.conditions:
            needs = neurons if condition.through_neurons else ()
            groups = []
            for members in split_groups(study.policies):
                groups.append(f"train/{body.name}/{condition.slug}/p{members[0]}")
                trained = body.trained_for * len(members) / ITERATIONS_PER_S if condition.trained else 0.0
                jobs.append(Job(groups[-1], TrainGroup(study, body, condition, members), needs, 4 + trained))
            # Its minute is the last recording's, also without neurons.
            needs = (*groups, *neurons)
            jobs.append(Job(f"evaluate/{body.name}/{condition.slug}", Evaluate(study, body, condition), needs, 4))
        jobs += _beside(study, body, neurons)
        results = [job.name for job in jobs if job.name.split("/")[1:2] == [body.name]]
        jobs.append(Job(f"pictures/{body.name}", RobotPictures(study, body), (*results, *neurons, "tables"), 15))
    everything = [job.name for job in jobs if job.name.split("/")[0] in ("evaluate", "controls", "optimum", "train")]
    jobs.append(Job("tables", Tabulate(study), (*everything, *neurons), 2))
    pictures = [job.name for job in jobs if job.name.startswith("pictures/")]
    jobs.append(Job("report", Publish(study), (*pictures, "tables"), 1))
    return jobs


def _beside(study: Study, body: Body, neurons: tuple[str, ...]) -> list[Job]:
    """Controls and optima on a robot."""
    from animat.studies.evaluating import Control
    from animat.studies.optima import FindOptima, kinds_of
    from animat.training.group import split_groups

    jobs = []
    for kind in kinds_of(study):
        plain = plain_condition(study, kind)
        groups = [f"train/{body.name}/{plain.slug}/p{members[0]}" for members in split_groups(study.policies)]
        name = f"controls/{body.name}/{kind.thresholds}"
        jobs.append(Job(name, Control(study, body, plain), (*groups, *neurons), 6))
    resolution = body.optimum_resolution or study.optimum_resolution
    cost_s = 40 * resolution ** len(body.robot().quantities) + 10
    jobs.append(Job(f"optimum/{body.name}", FindOptima(study, body), neurons, cost_s))
    if neurons:
        jobs.append(Job(f"optimum/{body.name}/over-time", FindOptima(study, body, over_time=True), neurons, 12))
    return jobs


def plain_condition(study: Study, kind: StudyCondition) -> StudyCondition:
    """Of the conditions with a mapping, the one trained most plainly: its policies stand for the mapping."""
    same = [c for c in study.conditions if (c.mapping, c.percentiles) == (kind.mapping, kind.percentiles)]
    return max(same, key=lambda c: (c.trained, c.delivery == "chosen", c.shadowing))
