"""Running a study: the jobs that are not done yet, as many at once as there is room, until its folder is complete."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from animat.errors import AnimatError, InvalidArgument, InvalidFile
from animat.progress import Progress, Silent
from animat.robots.checking import check_robot
from animat.studies.executor import Event, Executor, Processes
from animat.studies.folder import describe_study, held, source_files, sums_of
from animat.studies.jobs import Job, Receipt, in_order, receipt_of
from animat.studies.places import REPORT, UNFINISHED
from animat.studies.plan import plan_study
from animat.studies.specification import Study


@dataclass(frozen=True)
class Ran:
    """What a run of a study did.

    Attributes:
        folder: the study's.
        report: its page.
        jobs: how many there are.
        done_now: those that this run did, with the processor seconds that each took; none if the folder was finished.
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
) -> Ran:
    """Run a study into a folder, or go on with one.

    Killed at any moment and called again, it goes on from the jobs that are done and, within a training, from its last
    checkpoint; the folder ends as the same files, bit for bit, as if undisturbed, with any number of workers.

    Args:
        study: the specification.
        folder: where everything goes; made if it is missing.
        base: what the specification's names of files are relative to.
        workers: processes, each on a core of its own; None: one a core. Not with an executor.
        executor: where jobs are run, closed at the end; None: processes on this machine.
        progress: told how far it is, and what runs.

    Raises:
        Mismatch: if the folder is another study's, its recordings have changed, or another run is at work in it.
        InvalidFile: if a file cannot be read or written.
        InvalidArgument: for fewer workers than one, or any beside an executor, or a robot of one's own that does not
            keep to the contract.
        AnimatError: if a job failed; its message names the job.
    """
    if workers is not None and workers < 1:
        raise InvalidArgument(f"workers: expected at least 1, got {workers}")
    if workers is not None and executor is not None:
        raise InvalidArgument(f"workers: expected none beside an executor, which has its own, got {workers}")
    folder, base = Path(folder).absolute(), Path(base).absolute()
    manifest = describe_study(study, sums_of(source_files(study, base), base))
    with held(folder, study, manifest):
        jobs = in_order(plan_study(study, base))
        receipts = _kept(jobs, folder, manifest["fingerprint"])
        run = _Run(study, folder, manifest["fingerprint"], jobs, receipts, progress or Silent())
        if len(receipts) < len(jobs):
            if not os.access(folder, os.W_OK):
                raise InvalidFile(
                    f"{folder}: {len(jobs) - len(receipts)} of {len(jobs)} jobs are left, but it cannot be written to"
                )
            for body in study.robots:
                if ":" in body.kind:
                    check_robot(body.robot())
            at = executor or Processes(workers)
            try:
                run.finish(at)
            finally:
                at.close()
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return Ran(folder, folder / REPORT, len(jobs), run.took_s)


def _kept(jobs: list[Job], folder: Path, study: str) -> dict[str, Receipt]:
    """Receipts of the jobs that are done, on inputs as they are now, and whose files are whole."""
    receipts: dict[str, Receipt] = {}
    for job in jobs:
        if all(need in receipts for need in job.needs):
            receipt = _kept_receipt(job, folder, study, receipts)
            if receipt is not None:
                receipts[job.name] = receipt
    return receipts


def _kept_receipt(job: Job, folder: Path, study: str, receipts: dict[str, Receipt]) -> Receipt | None:
    """The receipt of a job whose needs are done, if it is good for what they left."""
    receipt = Receipt.load(folder, job.name)
    if receipt is None or receipt.study != study or receipt.inputs != _inputs(job, receipts):
        return None
    return receipt if receipt.is_kept(folder) else None


def _inputs(job: Job, receipts: dict[str, Receipt]) -> dict[str, str]:
    return {need: receipts[need].digest for need in job.needs}


class _Run:
    """The state of a run: what is done, what runs, what waits."""

    def __init__(
        self, study: Study, folder: Path, fingerprint: str, jobs: list[Job], receipts: dict[str, Receipt], to: Progress
    ) -> None:
        self._study, self._folder, self._fingerprint = study, folder, fingerprint
        self._jobs = {job.name: job for job in jobs}
        self._waiting = [job for job in jobs if job.name not in receipts]
        self._receipts = receipts
        self._running: dict[str, tuple[float, str]] = {}
        self._progress = to
        self._total_s = sum(job.cost_s for job in self._waiting)
        self._done_s = 0.0
        self.took_s: dict[str, float] = {}

    def finish(self, executor: Executor) -> None:
        """Run everything that waits."""
        while self._waiting or self._running:
            for job in [job for job in self._waiting if all(need in self._receipts for need in job.needs)]:
                # What it needs may have been made again, with the same bytes as before.
                kept = _kept_receipt(job, self._folder, self._fingerprint, self._receipts)
                if kept is not None:
                    self._waiting.remove(job)
                    self._receipts[job.name] = kept
                    self._done_s += job.cost_s
                elif executor.free:
                    self._waiting.remove(job)
                    self._running[job.name] = (0.0, "")
                    executor.start(job, self._study, self._folder)
            self._tell()
            for event in executor.wait() if self._running else ():
                self._take(event)
        self._tell()

    def _take(self, event: Event) -> None:
        job = self._jobs[event.job]
        if event.kind == "failed":
            raise AnimatError(f"{job.name}: {event.words}")
        if event.kind == "progress":
            self._running[job.name] = (event.share, event.words)
            return
        receipt = receipt_of(
            job, self._fingerprint, self._folder, [Path(file) for file in event.files], _inputs(job, self._receipts)
        )
        receipt.save(self._folder)
        self._receipts[job.name] = receipt
        del self._running[job.name]
        self.took_s[job.name] = event.cpu_s
        self._done_s += job.cost_s

    def _tell(self) -> None:
        parts = [f"{name} {100 * share:.0f} % {words}".strip() for name, (share, words) in self._running.items()]
        done_s = self._done_s + sum(self._jobs[name].cost_s * share for name, (share, _) in self._running.items())
        note = f"{len(self._receipts)} of {len(self._jobs)} jobs; {'; '.join(parts)}" if parts else ""
        self._progress.update(done_s, self._total_s, note)
