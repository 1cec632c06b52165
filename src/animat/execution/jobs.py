"""Jobs: tasks by name, each with what must be done before it; those that are not done yet are run, all at once."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path

from animat.errors import AnimatError, InvalidArgument
from animat.execution.cluster import Cluster
from animat.execution.gpu import WithGpu
from animat.execution.pinned import PinnedProcesses, own_cores
from animat.execution.receipts import Receipt, digest_of, receipt_path
from animat.execution.task import PLANNED, UNFINISHED, Done, Task, carry_out_alone, memory_of, reported
from animat.progress import Progress
from animat.writing import write_whole

_LOOK_EVERY_S = 0.2


@dataclass(frozen=True)
class Job:
    """A task with a name, what must be done before it, and how long it takes.

    Attributes:
        name: such as `train/cartpole/1-threshold/p0`.
        task: what it does.
        needs: names of the jobs whose files it reads.
        cost_s: about how many seconds of one core it takes, for the order of jobs and the time left.
        reads: places in the folder of other files that it reads, which are no job's.
    """

    name: str
    task: Task
    needs: tuple[str, ...] = ()
    cost_s: float = 1.0
    reads: tuple[str, ...] = ()


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """Jobs so that each comes after what it needs; first the one that the longest chain of others waits for."""
    by_name = {job.name: job for job in jobs}
    waited_for_s = dict.fromkeys(by_name, 0.0)
    for name in reversed([*TopologicalSorter({job.name: job.needs for job in jobs}).static_order()]):
        for need in by_name[name].needs:
            waited_for_s[need] = max(waited_for_s[need], by_name[name].cost_s + waited_for_s[name])
    # A job is always more urgent than what waits for it, as it takes some time itself.
    return sorted(jobs, key=lambda job: -(job.cost_s + waited_for_s[job.name]))


def expect_workers(workers: int | None, executor: Executor | None) -> None:
    """Refuse fewer workers than one, and any beside an executor (InvalidArgument)."""
    if workers is not None and workers < 1:
        raise InvalidArgument(f"workers: expected at least 1, got {workers}")
    if workers is not None and executor is not None:
        raise InvalidArgument(f"workers: expected none beside an executor, which has its own, got {workers}")


class Jobs:
    """The jobs of a folder: which are done, by their receipts, and running the others.

    Args:
        jobs: all of them.
        folder: where their files are.
        receipts: the folder of their receipts.
        fingerprint: of the study or training; a receipt of another one counts for nothing.

    Raises:
        InvalidFile: if a receipt cannot be read.
    """

    def __init__(self, jobs: Sequence[Job], folder: Path, receipts: Path, fingerprint: str) -> None:
        self._folder, self._receipts, self._fingerprint = folder, receipts, fingerprint
        self._done: dict[str, Receipt] = {}
        self._jobs = {job.name: job for job in jobs}
        self.waiting = [job for job in in_order(jobs) if not self._is_done(job)]
        """Those that are not done, the most urgent first."""

    def run(
        self, *, workers: int | None, executor: Executor | None, progress: Progress, has_gpu: bool = False
    ) -> dict[str, float]:
        """Run the jobs that are not done; the first that fails ends all, but on a cluster the others go on first.

        Args:
            workers: processes, each on a core of its own; None: one a core. Not with an executor.
            executor: where tasks are run, in view of the folder; it stays open. None: processes on this machine.
            progress: told how far it is, and what runs.
            has_gpu: whether this machine has a GPU for what trains policies; if not, that is done on cores.

        Returns:
            The processor seconds of each job that was run.

        Raises:
            AnimatError: if a job failed; its message names the job, or all that failed.
        """
        costs_s = {name: job.cost_s for name, job in self._jobs.items()}
        write_whole(self._folder / UNFINISHED / PLANNED, json.dumps(costs_s, indent=1) + "\n")
        notices = self._folder / UNFINISHED / ".told"
        notices.mkdir(parents=True, exist_ok=True)
        # Of a run that was killed; its locks may still be held.
        for stale in notices.glob("*.json"):
            stale.unlink(missing_ok=True)
        total_s, ended_s = sum(job.cost_s for job in self.waiting), 0.0
        running: dict[Future[Done], Job] = {}
        failed: list[AnimatError] = []
        cpu_s: dict[str, float] = {}
        told_s = -math.inf

        def report() -> None:
            nonlocal told_s
            told_s = time.monotonic()
            done_s, parts = ended_s, []
            for job in running.values():
                share, words = reported(receipt_path(notices, job.name)) or (0.0, None)
                done_s += job.cost_s * share
                if words is not None:
                    parts.append(f"{job.name} {100 * share:.0f} % {words}".strip())
            n_jobs = len(self._done) + len(running) + len(self.waiting) + len(failed)
            if failed:
                parts.append(f"{len(failed)} failed")
            jobs = "1 job" if n_jobs == 1 else f"{n_jobs} jobs"
            note = f"{len(self._done)} of {jobs}; {'; '.join(parts)}" if parts else ""
            progress.update(done_s, total_s, note)

        with _running_on(executor, workers, running, has_gpu) as at:
            # Those that wait for one that failed wait in vain.
            while running or any(self._has_needs(job) for job in self.waiting):
                ready = [job for job in self.waiting if self._has_needs(job)]
                for job in ready:
                    self.waiting.remove(job)
                # What one needs may have been made again, with the same bytes as before.
                left = [job for job in ready if not self._is_done(job)]
                ended_s += sum(job.cost_s for job in ready) - sum(job.cost_s for job in left)
                running |= zip(self._submit(left, at, notices), left, strict=True)
                if time.monotonic() - told_s > _LOOK_EVERY_S:
                    report()
                # Those that succeeded first: their receipts are kept, whatever the others raise.
                ended = wait(running, _LOOK_EVERY_S, FIRST_COMPLETED).done
                for future in sorted(ended, key=lambda each: each.cancelled() or each.exception() is not None):
                    ended_s += running[future].cost_s
                    try:
                        done = _done(future, running[future])
                    except AnimatError as error:
                        if not isinstance(executor, Cluster) or future.cancelled():
                            raise
                        failed.append(error)
                        del running[future]
                        continue
                    job = running.pop(future)
                    receipt = Receipt(job.name, self._fingerprint, self._inputs(job), done.files)
                    receipt.save(self._receipts)
                    self._done[job.name] = receipt
                    cpu_s[job.name] = done.cpu_s
        report()
        if failed:
            # In whatever order they ended, the same message.
            failed.sort(key=str)
            in_vain = f"; waiting for what failed: {len(self.waiting)}" if self.waiting else ""
            failed[0].args = ("; ".join(map(str, failed)) + in_vain,)
            raise failed[0]
        return cpu_s

    def _submit(self, jobs: Sequence[Job], at: Executor | WithGpu, notices: Path) -> list[Future[Done]]:
        told = [receipt_path(notices, job.name) for job in jobs]
        if isinstance(at, WithGpu):
            return at.hand_in([job.task for job in jobs], self._folder, told)
        if isinstance(at, Cluster):
            return [
                at.submit_task(
                    job.task, self._folder, notice, name=job.name, cost_s=job.cost_s, reads=self._read_by(job)
                )
                for job, notice in zip(jobs, told, strict=True)
            ]
        return [
            at.submit(carry_out_alone, job.task, self._folder, notice) for job, notice in zip(jobs, told, strict=True)
        ]

    def _read_by(self, job: Job) -> dict[str, str]:
        """The digests of the files that a job reads, by their places: of all that comes before it."""
        reads = {place: digest_of(self._folder / place) for place in job.reads}
        before, seen = list(job.needs), set[str]()
        while before:
            if (name := before.pop()) not in seen:
                seen.add(name)
                reads |= self._done[name].outputs
                before += self._jobs[name].needs
        return reads

    def _is_done(self, job: Job) -> bool:
        """Whether a job has a receipt, on inputs as they are now, for files as they are now."""
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
def _running_on(
    executor: Executor | None, workers: int | None, running: dict[Future[Done], Job], has_gpu: bool
) -> Iterator[Executor | WithGpu]:
    """The executor that was lent, or processes of ours; if the block fails, nothing goes on after it."""
    if executor is None:
        with PinnedProcesses(own_cores(workers)) as ours, PinnedProcesses([None]) as beside:
            yield WithGpu(ours, beside) if has_gpu else ours
        return
    try:
        yield executor
    except BaseException:
        # The folder is let go of only when nobody writes to it any more.
        wait([future for future in running if not future.cancel()])
        raise


def _done(future: Future[Done], job: Job) -> Done:
    try:
        return future.result()
    except AnimatError as error:
        error.args = (f"{job.name}: {error}",)
        raise
    except CancelledError as error:
        raise AnimatError(f"{job.name}: its executor has ended; start that, and then this again to go on") from error
    except Exception as error:
        # The executor's: of a process that ended, or a machine that is lost.
        words = " ".join(str(error).split()) or type(error).__name__
        # That is what a person or a program asks for; a system that is out of memory does not ask.
        is_asked = words.endswith(f"status {-signal.SIGTERM}")
        why = "another program ended it" if is_asked else f"is there memory enough? {memory_of(job.task)}"
        raise AnimatError(f"{job.name}: {words} ({why}); start again to go on") from error
