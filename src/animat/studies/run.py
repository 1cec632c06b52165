"""Running a study: its jobs and their dependencies, and doing the missing ones until its folder is complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from animat.arguments import checked_arguments
from animat.coding.checking import check_mapping
from animat.coding.mapping import mapping_named
from animat.errors import InvalidFile
from animat.execution.gpu import find_gpu
from animat.execution.jobs import Job, Jobs, expect_workers
from animat.execution.task import UNFINISHED
from animat.progress import Progress, Silent
from animat.robots.checking import check_robot
from animat.studies.folder import MANIFEST, RECEIPTS, REPORT, SPECIFICATION, claim_folder, describe_study, hash_sources
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.toml import study_to_toml

ITERATIONS_PER_S = 110_000
"""Training speed on one core, all policies of a group together; used only to order jobs and estimate the time left."""
_S_PER_MIN = 0.75
"""How long a minute of a virtual culture takes to compute."""
_ABOUT_FILES = "# files: relative to the original specification. To run it from here: files = ['recordings']\n"


@dataclass(frozen=True)
class StudyRun:
    """A study's folder and report, its number of jobs, and the CPU seconds of those that this run did, by name."""

    folder: Path
    report: Path
    jobs: int
    done_now: dict[str, float]


@checked_arguments
def run_study(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> StudyRun:
    """Run a study in a folder, or resume it there.

    If it was killed at any moment, it resumes after the finished jobs and, within a training, from the last checkpoint.
    The folder ends as if undisturbed, with any number of workers: with the same files, bit for bit, except that NWB
    files of the same recordings have their own identifiers and dates.

    Args:
        folder: for all files; created if it is missing.
        base: folder to which the specification's file names are relative.
        workers: number of processes, each on its own core; None: one per core. Not with an executor.
        executor: runs the jobs and must have access to the folder; it stays open. None: processes on this machine.
        progress: updated with the share of the work that is done, and the running jobs.

    Raises:
        Mismatch: if the folder belongs to another study, its recordings have changed, or another run is using it.
        InvalidFile: if a file cannot be read or written.
        InvalidArgument: for fewer than one worker, workers together with an executor, or a custom robot or mapping that
            violates the contract.
        AnimatError: if a job failed; its message names the job.
    """
    expect_workers(workers, executor)
    folder, base = Path(folder).absolute(), Path(base).absolute()
    gpu = find_gpu() if executor is None else None
    check_custom(study.robots, [arm.mapping for arm in study.arms])
    manifest = describe_study(study, hash_sources(study, base), gpu)
    specification = _ABOUT_FILES * (study.culture.kind == "files") + study_to_toml(study)
    with claim_folder(folder, "study", manifest, MANIFEST, {SPECIFICATION: specification}):
        jobs = plan_study(study, base)
        how = {"workers": workers, "executor": executor, "has_gpu": gpu is not None}
        took_s = run_jobs(jobs, folder, manifest["fingerprint"], progress, **how)
    return StudyRun(folder, folder / REPORT, len(jobs), took_s)


def plan_study(study: Study, base: Path) -> list[Job]:
    """All jobs of a study, whose files are relative to `base`."""
    # Tasks import JAX, which the command line should not load.
    from animat.studies.pictures import CulturePictures, RobotPictures
    from animat.studies.publishing import Publish
    from animat.studies.recording import JOB, FitSimulators, MakeRecordings
    from animat.studies.tabulating import Tabulate

    jobs: list[Job] = []
    neurons: tuple[str, ...] = ()
    if study.needs_neurons:
        culture = study.culture
        # The time between recordings is computed too.
        recorded_s = culture.sessions * (_S_PER_MIN * culture.interval_min if culture.kind == "virtual" else 0.3)
        jobs += [
            Job(JOB, MakeRecordings(study, base), (), 2 + recorded_s),
            Job("fit", FitSimulators(study), (JOB,), 3),
            Job("pictures/culture", CulturePictures(study), (JOB, "fit"), 15),
        ]
        neurons = ("fit",)
    results: list[str] = []
    for spec in study.robots:
        of_robot = _jobs_of(study, spec, neurons)
        needs = (*(job.name for job in of_robot), *neurons, "tables")
        jobs += [*of_robot, Job(f"pictures/{spec.name}", RobotPictures(study, spec), needs, 15)]
        results += [job.name for job in of_robot]
    jobs.append(Job("tables", Tabulate(study), (*results, *neurons), 2))
    pictures = [job.name for job in jobs if job.name.startswith("pictures/")]
    jobs.append(Job("report", Publish(study), (*pictures, "tables"), 1, (MANIFEST,)))
    return jobs


def _jobs_of(study: Study, spec: RobotSpec, neurons: tuple[str, ...]) -> list[Job]:
    """The jobs whose results are tabulated for a robot: training, evaluation, controls and optimal returns."""
    from animat.studies.evaluating import EvaluateArm, RunControls
    from animat.studies.optima import FindOptima, kinds_of
    from animat.studies.training import TrainArm
    from animat.training.group import split_groups

    jobs: list[Job] = []
    groups: dict[Arm, list[str]] = {arm: [] for arm in study.arms}
    for arm, names in groups.items():
        needs = neurons if arm.through_neurons else ()
        for members in split_groups(study.policies):
            names.append(f"train/{spec.name}/{arm.slug}/p{members[0]}")
            trained_s = spec.trained_for * len(members) / ITERATIONS_PER_S if arm.trained else 0.0
            jobs.append(Job(names[-1], TrainArm(study, spec, arm, members), needs, 4 + trained_s))
        # The minute is the last recording's, even without neurons.
        task = EvaluateArm(study, spec, arm)
        jobs.append(Job(f"evaluate/{spec.name}/{arm.slug}", task, (*names, *neurons), 4))
    for kind in kinds_of(study):
        # The most plainly trained arm of a kind represents it.
        arms = study.arms_of(kind)
        plain = max(arms, key=lambda arm: (arm.trained, arm.delivery == "chosen", arm.shadowing is True))
        name = f"controls/{spec.name}/{kind.thresholds}"
        jobs.append(Job(name, RunControls(study, spec, plain), (*groups[plain], *neurons), 15))
    resolution = spec.optimum_resolution or study.optimum_resolution
    cost_s = 40 * resolution ** len(spec.robot().observation_spec) + 10
    jobs.append(Job(f"optimum/{spec.name}", FindOptima(study, spec), neurons, cost_s))
    if neurons:
        jobs.append(Job(f"optimum/{spec.name}/over-time", FindOptima(study, spec, over_time=True), neurons, 12))
    return jobs


def run_jobs(
    jobs: Sequence[Job], folder: Path, fingerprint: str, progress: Progress | None, **how: Any
) -> dict[str, float]:
    """Run the jobs of a folder that are not done, with options of `Jobs.run`; returns the CPU seconds of each."""
    left = Jobs(jobs, folder, folder / RECEIPTS, fingerprint)
    took_s: dict[str, float] = {}
    if n := len(left.waiting):
        if not os.access(folder, os.W_OK):
            raise InvalidFile(f"{folder}: {n} of {len(jobs)} jobs are left, but it cannot be written to")
        took_s = left.run(progress=progress or Silent(), **how)
    shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return took_s


def check_custom(robots: Iterable[RobotSpec], mappings: Iterable[str]) -> None:
    """Raise InvalidArgument for custom robots and mappings that violate the contract."""
    for spec in robots:
        if ":" in spec.kind:
            check_robot(spec.robot())
    for mapping in mappings:
        if ":" in mapping:
            check_mapping(mapping_named(mapping))
