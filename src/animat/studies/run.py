"""Running a study: the jobs that are not done yet, as many at once as there is room, until its folder is complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from animat.coding.checking import check_mapping
from animat.coding.mapping import mapping_named
from animat.errors import InvalidFile
from animat.execution.gpu import find_gpu
from animat.execution.jobs import Jobs, expect_workers
from animat.execution.task import UNFINISHED
from animat.progress import Progress, Silent
from animat.robots.checking import check_robot
from animat.studies.folder import MANIFEST, describe_study, specification_files, claim_folder, source_files, hash_files
from animat.studies.places import RECEIPTS, REPORT
from animat.studies.plan import plan_study
from animat.studies.specification import RobotSpec, Study


@dataclass(frozen=True)
class StudyRun:
    """What a run of a study did: where, of how many jobs.

    Attributes:
        done_now: jobs that this run did, with the processor seconds that each took; none if the folder was finished.
    """

    folder: Path
    report: Path
    jobs: int
    done_now: dict[str, float]


def run_study(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> StudyRun:
    """Run a study into a folder, or go on with one.

    Killed at any moment and called again, it goes on from the jobs that are done and, within a training, from its last
    checkpoint; the folder ends as if undisturbed, with any number of workers: the same files, bit for bit,
    and the same recordings, in files to which NWB gives identifiers and dates of their own.

    Args:
        study: the specification.
        folder: where everything goes; made if it is missing.
        base: what the specification's names of files are relative to.
        workers: processes, each on a core of its own; None: one a core. Not with an executor.
        executor: where jobs are run, in view of the folder; it stays open. None: processes on this machine.
        progress: told how far it is, and what runs.

    Raises:
        Mismatch: if the folder is another study's, its recordings have changed, or another run is at work in it.
        InvalidFile: if a file cannot be read or written.
        InvalidArgument: for fewer workers than one, or any beside an executor, or a robot of one's own that does not
            keep to the contract.
        AnimatError: if a job failed; its message names the job.
    """
    expect_workers(workers, executor)
    folder, base = Path(folder).absolute(), Path(base).absolute()
    gpu = find_gpu() if executor is None else None
    check_custom(study.robots, [arm.mapping for arm in study.arms])
    manifest = describe_study(study, hash_files(source_files(study, base), base), gpu)
    with claim_folder(folder, "study", manifest, MANIFEST, specification_files(study)):
        jobs = plan_study(study, base)
        left = Jobs(jobs, folder, folder / RECEIPTS, manifest["fingerprint"])
        took_s: dict[str, float] = {}
        if left.waiting:
            if not os.access(folder, os.W_OK):
                raise InvalidFile(
                    f"{folder}: {len(left.waiting)} of {len(jobs)} jobs are left, but it cannot be written to"
                )
            took_s = left.run(
                workers=workers, executor=executor, progress=progress or Silent(), has_gpu=gpu is not None
            )
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return StudyRun(folder, folder / REPORT, len(jobs), took_s)


def check_custom(robots: Iterable[RobotSpec], mappings: Iterable[str]) -> None:
    """Refuse robots and mappings of one's own that do not keep to the contract (InvalidArgument)."""
    for spec in robots:
        if ":" in spec.kind:
            check_robot(spec.robot())
    for mapping in mappings:
        if ":" in mapping:
            check_mapping(mapping_named(mapping))
