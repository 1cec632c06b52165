"""Jobs: named tasks with dependencies; jobs that are not done yet are run in parallel."""

from __future__ import annotations

import errno
import json
import math
import signal
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path

from animat.errors import AnimatError, InvalidArgument, counted, expect_at_least, first_line, out_of_memory
from animat.execution.cluster import Cluster
from animat.execution.gpu import submit_with_gpu
from animat.execution.pinned import PinnedProcesses
from animat.execution.receipts import Receipt, digest_of, receipt_path
from animat.execution.task import NOTICES, PLANNED, UNFINISHED, Task, TaskResult, carry_out_alone, memory_of, reported
from animat.process import own_cores
from animat.progress import Progress
from animat.writing import write_whole

_LOOK_EVERY_S = 0.2


@dataclass(frozen=True)
class Job:
    """A task with a name, dependencies and a cost.

    Attributes:
        needs: names of the jobs whose files it reads.
        cost_s: approximate seconds on one core, for the order of jobs and the remaining time.
        reads: places in the folder of other files that it reads, which no job writes.
    """

    name: str
    task: Task
    needs: tuple[str, ...] = ()
    cost_s: float = 1.0
    reads: tuple[str, ...] = ()


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """Jobs ordered so that each comes after those it needs, beginning with the longest chain of dependants."""
    by_name = {job.name: job for job in jobs}
    chain_s = dict.fromkeys(by_name, 0.0)
    for name in reversed([*TopologicalSorter({job.name: job.needs for job in jobs}).static_order()]):
        for need in by_name[name].needs:
            chain_s[need] = max(chain_s[need], by_name[name].cost_s + chain_s[name])
    # A job is always more urgent than its dependants, as it takes some time itself.
    return sorted(jobs, key=lambda job: -(job.cost_s + chain_s[job.name]))


def expect_workers(workers: int | None, executor: Executor | None) -> None:
    """Refuse fewer than one worker, and any number together with an executor (InvalidArgument)."""
    expect_at_least("workers", workers, 1)
    if workers is not None and executor is not None:
        raise InvalidArgument(f"workers: expected None with an executor, which has its own, got {workers}")


class Jobs:
    """The jobs of a folder: finds which are done, by their receipts with this fingerprint, and runs the others."""

    def __init__(self, jobs: Sequence[Job], folder: Path, receipts: Path, fingerprint: str) -> None:
        self._folder, self._receipts, self._fingerprint = folder, receipts, fingerprint
        self._done: dict[str, Receipt] = {}
        self._jobs = {job.name: job for job in jobs}
        self.waiting = [job for job in in_order(jobs) if not self._is_done(job)]
        """The jobs that are not done, the most urgent first."""

    def run(
        self, *, workers: int | None, executor: Executor | None, progress: Progress, has_gpu: bool = False
    ) -> dict[str, float]:
        """Run the jobs that are not done, and return the CPU seconds of each.

        The first failure ends the run, but on a cluster the other jobs finish first. The AnimatError names the job, or
        all that failed. `workers` and `executor` are as in `animat.execution.training.train`; with `has_gpu` tasks that
        train policies run on this machine's GPU.
        """
        costs_s = {name: job.cost_s for name, job in self._jobs.items()}
        write_whole(self._folder / UNFINISHED / PLANNED, json.dumps(costs_s, indent=1) + "\n")
        notices = self._folder / UNFINISHED / NOTICES
        notices.mkdir(parents=True, exist_ok=True)
        # Left by a run that was killed; the locks stay, as they may still be held.
        for stale in notices.glob("*.json"):
            stale.unlink(missing_ok=True)
        running: dict[Future[TaskResult], Job] = {}
        failed: list[AnimatError] = []
        cpu_s: dict[str, float] = {}
        reported_s = -math.inf

        def keep(future: Future[TaskResult]) -> None:
            job, result = running[future], future.result()
            self._done[job.name] = Receipt(job.name, self._fingerprint, self._inputs(job), result.files)
            self._done[job.name].save(self._receipts)
            cpu_s[job.name] = result.cpu_s

        with _executors_for(executor, workers, running, keep, has_gpu) as (cores, gpu):
            # Jobs that need a failed one never become ready.
            while running or any(self._has_needs(job) for job in self.waiting):
                ready = [job for job in self.waiting if self._has_needs(job)]
                self.waiting = [job for job in self.waiting if not self._has_needs(job)]
                # A job may be done after all if what it needs was made again with the same bytes.
                left = [job for job in ready if not self._is_done(job)]
                running |= zip(self._submit(left, cores, gpu, notices), left, strict=True)
                if time.monotonic() - reported_s > _LOOK_EVERY_S:
                    reported_s = time.monotonic()
                    self._report(progress, running.values(), len(failed), notices)
                # Successful ones first, so that their receipts are kept whatever the others raise.
                ended = wait(running, _LOOK_EVERY_S, FIRST_COMPLETED).done
                for future in sorted(ended, key=lambda each: each.cancelled() or each.exception() is not None):
                    try:
                        _expect_success(future, running[future])
                    except AnimatError as error:
                        if not isinstance(executor, Cluster) or future.cancelled():
                            raise
                        failed.append(error)
                    else:
                        keep(future)
                    del running[future]
        self._report(progress, (), len(failed), notices)
        if failed:
            # Sorted, so that the message does not depend on the order in which they ended.
            failed.sort(key=str)
            blocked = f"; not run, as they need failed jobs: {len(self.waiting)}" if self.waiting else ""
            failed[0].args = ("; ".join(map(str, failed)) + blocked,)
            raise failed[0]
        return cpu_s

    def _report(self, progress: Progress, running: Collection[Job], n_failed: int, notices: Path) -> None:
        """Report how much of the cost is done, with what running jobs have noted."""
        total_s = sum(job.cost_s for job in self._jobs.values())
        left_s, parts = sum(job.cost_s for job in self.waiting), list[str]()
        for job in running:
            share, text = reported(receipt_path(notices, job.name)) or (0.0, None)
            left_s += job.cost_s * (1.0 - share)
            if text is not None:
                parts.append(f"{job.name} {100 * share:.0f} % {text}".strip())
        n_jobs = len(self._done) + len(running) + len(self.waiting) + n_failed
        if n_failed:
            parts.append(f"{n_failed} failed")
        note = "; ".join((f"{len(self._done)} of {counted(n_jobs, 'job')}", *parts))
        progress.update(total_s - left_s, total_s, note if running or n_failed else "")

    def _submit(
        self, jobs: Sequence[Job], cores: Executor, gpu: Executor | None, notices: Path
    ) -> list[Future[TaskResult]]:
        paths = [receipt_path(notices, job.name) for job in jobs]
        if gpu is not None:
            return submit_with_gpu(cores, gpu, [job.task for job in jobs], self._folder, paths)
        if isinstance(cores, Cluster):
            return [
                cores.submit_task(
                    job.task, self._folder, path, name=job.name, cost_s=job.cost_s, reads=self._files_read(job)
                )
                for job, path in zip(jobs, paths, strict=True)
            ]
        tasks = zip(jobs, paths, strict=True)
        return [cores.submit(carry_out_alone, job.task, self._folder, path) for job, path in tasks]

    def _files_read(self, job: Job) -> dict[str, str]:
        """The digests of the files that a job may read, by their places: those of all jobs before it."""
        reads = {place: digest_of(self._folder / place) for place in job.reads}
        before, seen = list(job.needs), set[str]()
        while before:
            if (name := before.pop()) not in seen:
                seen.add(name)
                reads |= self._done[name].outputs
                before += self._jobs[name].needs
        return reads

    def _is_done(self, job: Job) -> bool:
        """Whether a job has a receipt that matches its current inputs and files."""
        receipt = Receipt.load(self._receipts, job.name) if self._has_needs(job) else None
        is_ours = receipt is not None and (receipt.study, receipt.inputs) == (self._fingerprint, self._inputs(job))
        if receipt is None or not is_ours or receipt.changed(self._folder):
            return False
        self._done[job.name] = receipt
        return True

    def _has_needs(self, job: Job) -> bool:
        return all(need in self._done for need in job.needs)

    def _inputs(self, job: Job) -> dict[str, str]:
        return {need: self._done[need].digest for need in job.needs}


@contextmanager
def _executors_for(
    executor: Executor | None,
    workers: int | None,
    running: dict[Future[TaskResult], Job],
    keep: Callable[[Future[TaskResult]], None],
    has_gpu: bool,
) -> Iterator[tuple[Executor, Executor | None]]:
    """The given executor, or our own processes, with one for the GPU; if the block fails, nothing keeps running.

    Ctrl-C ends running tasks in processes of ours. Any other executor finishes them first, and they are kept.
    """
    if executor is None:
        with PinnedProcesses(own_cores(workers)) as cores, PinnedProcesses([None]) as gpu:
            yield cores, gpu if has_gpu else None
        return
    try:
        yield executor, None
    except BaseException as error:
        if isinstance(executor, PinnedProcesses) and isinstance(error, KeyboardInterrupt):
            executor.kill_workers()
        # The folder must not be released while a task still writes to it.
        for future in wait([future for future in running if not future.cancel()]).done:
            if future.exception() is None:
                with suppress(AnimatError):
                    keep(future)
        raise


def _expect_success(future: Future[TaskResult], job: Job) -> None:
    """Raise an AnimatError that names the job if it failed."""
    try:
        future.result()
    except AnimatError as error:
        error.args = (f"{job.name}: {error}",)
        raise
    except CancelledError as error:
        ended = "its executor, or the cluster's scheduler, has ended; start it, then run this again to continue"
        raise AnimatError(f"{job.name}: {ended}") from error
    except BrokenExecutor as error:
        # A process ended, or a machine was lost. SIGTERM comes from a person or a program; the kernel uses SIGKILL when
        # memory runs out.
        message = " ".join(str(error).split()) or type(error).__name__
        why = f"is there enough memory? {memory_of(job.task)}"
        if message.endswith(f"status {-signal.SIGTERM}"):
            why = "another program ended it"
        if message.endswith("status 0"):
            why = "code in it ended the process, such as that of a robot of your own"
        raise AnimatError(f"{job.name}: {message} ({why}); run again to continue") from error
    except Exception as error:
        # Raised by the executor, as when it cannot send the task.
        number, why = getattr(error, "errno", None), ""
        if number == errno.EMFILE:
            why = " (fewer --workers need fewer, and `ulimit -n` raises the limit)"
        if number == errno.ENOMEM or out_of_memory(error) is not None or type(error).__name__ == "KilledWorker":
            why = f" (is there enough memory? {memory_of(job.task)})"
        raise AnimatError(f"{job.name}: {first_line(error)}{why}; run again to continue") from error
