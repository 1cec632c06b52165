"""Running a study: does the missing jobs, in parallel, until its folder is complete."""

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
from animat.studies.folder import MANIFEST, claim_folder, describe_study, hash_files, source_files
from animat.studies.places import RECEIPTS, REPORT
from animat.studies.plan import plan_study
from animat.studies.specification import RobotSpec, Study
from animat.studies.toml import study_to_toml

SPECIFICATION = "study.toml"
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
        study: the specification.
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
    manifest = describe_study(study, hash_files(source_files(study, base), base), gpu)
    specification = _ABOUT_FILES * (study.culture.kind == "files") + study_to_toml(study)
    with claim_folder(folder, "study", manifest, MANIFEST, {SPECIFICATION: specification}):
        jobs = plan_study(study, base)
        how = {"workers": workers, "executor": executor, "has_gpu": gpu is not None}
        took_s = run_jobs(jobs, folder, manifest["fingerprint"], progress, **how)
    return StudyRun(folder, folder / REPORT, len(jobs), took_s)


def run_jobs(
    jobs: Sequence[Job], folder: Path, fingerprint: str, progress: Progress | None, **how: Any
) -> dict[str, float]:
    """Run the jobs of a folder that are not done, with options of `Jobs.run`; returns the CPU seconds of each."""
    left = Jobs(jobs, folder, folder / RECEIPTS, fingerprint)
    took_s: dict[str, float] = {}
    if left.waiting:
        if not os.access(folder, os.W_OK):
            raise InvalidFile(
                f"{folder}: {len(left.waiting)} of {len(jobs)} jobs are left, but it cannot be written to"
            )
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
