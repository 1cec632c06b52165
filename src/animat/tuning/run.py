"""Running a tuning: batches of trials, reported to the search in order, and a final training of the best."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path

from animat.errors import InvalidFile, UnusableData
from animat.execution.jobs import Job, Jobs, expect_workers
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import UNFINISHED
from animat.folders import with_fingerprint
from animat.process import own_cores
from animat.progress import Part, Progress, Silent
from animat.studies.folder import OWN_FOLDERS, RECEIPTS, claim_folder, describe_study, hash_sources
from animat.studies.recording import JOB, MakeRecordings
from animat.studies.run import ITERATIONS_PER_S, check_custom
from animat.studies.task import derived_seed
from animat.training.group import split_groups
from animat.training.specification import CHUNKS
from animat.tuning.results import Final, TuningResult, write_results
from animat.tuning.search import Search, Trial, expect_optuna, read_journal, write_journal
from animat.tuning.specification import Tuning, choices_of, first_settings, with_settings
from animat.tuning.tasks import FitVariant, TrainTrials, group_by_shape, returns_file, timeline_file

MANIFEST = "tune.json"
FINALS = "finals"
_COMPILING_S = 10
"""About how long the program of a job takes to compile, for the time left."""


def tune(
    tuning: Tuning,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Search for settings, or continue a search, in a folder.

    If killed at any moment and called again, it continues; the journal and the results are the same, byte for byte,
    with any number of workers. For this, trials are proposed `together` at a time, and reported in order.

    Arguments and errors as in `run_study`; also UnusableData without a finite return, AnimatError without Optuna.
    """
    expect_optuna()
    expect_workers(workers, executor)
    folder, base, progress = Path(folder).absolute(), Path(base).absolute(), progress or Silent()
    study = tuning.study
    # Checked before the folder is created.
    check_custom(study.robots, choices_of("mapping", tuning.space, study))
    described = describe_study(study, hash_sources(study, base))
    versions = {**described["versions"], "optuna": importlib.metadata.version("optuna")}
    manifest = with_fingerprint({**tuning.to_dict(), "sources": described["sources"], "versions": versions})
    # Our own processes are reused from one part of the work to the next.
    context: AbstractContextManager[Executor] = (
        PinnedProcesses(own_cores(workers)) if executor is None else nullcontext(executor)
    )
    with claim_folder(folder, "tuning", manifest, MANIFEST, {}, (*OWN_FOLDERS, FINALS)), context as chosen:
        run = _Run(tuning, folder, manifest["fingerprint"], chosen, progress)
        run.fit(base)
        trials = run.search()
        finals = run.finals(trials)
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        return write_results(folder, tuning, trials, finals)


class _Run:
    """A running tuning: its jobs, part by part, on one executor."""

    def __init__(self, tuning: Tuning, folder: Path, fingerprint: str, executor: Executor, progress: Progress) -> None:
        self._tuning, self._folder, self._fingerprint, self._executor = tuning, folder, fingerprint, executor
        tune = tuning.tune
        self._first = min(len(first_settings(tuning.study, tuning.space)), tune.trials)
        self._progress, self._done_s = progress, 0.0
        batches = (min(tune.together, tune.trials - first) for first in range(0, tune.trials, tune.together))
        finals, groups = tune.finalists + self._first, len(split_groups(tuning.study.policies))
        self._total_s = 20 + sum(map(self._batch_s, batches))
        self._total_s += self._cost_s(tuning.study.policies * finals, CHUNKS) + _COMPILING_S * finals * groups

    def fit(self, base: Path) -> None:
        """Make the recordings, and simulators of every kind in the search."""
        study, space = self._tuning.study, self._tuning.space
        if not study.needs_neurons:
            return
        names = ("simulator", "conditions", "readouts")
        choices = [choices_of(name, space, study) for name in names]
        variants = [with_settings(study, dict(zip(names, chosen, strict=True))) for chosen in product(*choices)]
        fits = [Job(f"fit/{timeline_file(each).stem}", FitVariant(each), (JOB,), 3) for each in variants]
        self._run_jobs([Job(JOB, MakeRecordings(study, base), (), 5), *fits], RECEIPTS, 20, "recordings and simulators")

    def search(self) -> list[Trial]:
        """Run all trials, reusing those in the journal."""
        tune, search, known = self._tuning.tune, Search(self._tuning), read_journal(self._folder)
        results: list[Trial] = []
        for first in range(0, tune.trials, tune.together):
            proposed = search.ask(min(tune.together, tune.trials - first))
            batch = known[first : first + len(proposed)]
            place = f"{UNFINISHED}/from-{first}"
            if len(batch) < len(proposed):
                new = [Trial(number, settings, "complete", (), ()) for number, settings in enumerate(proposed, first)]
                batch = self._run_batch(new, place)
                write_journal(self._folder, results + batch)
            elif [result.settings for result in batch] != proposed:
                raise InvalidFile(
                    f"{self._folder}: expected the journal of this tuning, got one with other settings in trials "
                    f"{first} to {first + len(proposed) - 1}; remove it to run its trials again"
                )
            else:
                self._done_s += self._batch_s(len(proposed))
            results += batch
            # What its trials learned is not needed any more.
            shutil.rmtree(self._folder / place, ignore_errors=True)
            search.report(batch)
        return results

    def _run_batch(self, trials: Sequence[Trial], place: str) -> list[Trial]:
        """Successive halving: all trials up to the first rung, the best of them up to the next, and so on."""
        tune, study = self._tuning.tune, self._tuning.study
        seeds = derived_seed("tuning", tune.seed, "training"), derived_seed("tuning", tune.seed, "episodes")
        members, rungs = tuple(range(tune.policies)), tune.chunks
        results = {trial.trial: trial for trial in trials}
        for rung, (first, last) in enumerate(zip([0, *rungs], rungs, strict=False)):
            racing = [trial for trial in results.values() if trial.state == "complete"]
            tasks = {}
            for group in group_by_shape(racing, tune.policies):
                name = f"rung-{rung + 1}/trials-{','.join(str(trial.trial) for trial in group)}"
                tasks[name] = TrainTrials(study, group, members, seeds, tune.episodes, (first, last), place)
            note = f"trials {trials[0].trial} to {trials[-1].trial} of {tune.trials}, rung {rung + 1} of {len(rungs)}"
            self._train(tasks, f"{place}/jobs", note)
            for trial in racing:
                returns = json.loads(returns_file(self._folder / place, trial, last, 0).read_text())
                if returns is None:
                    results[trial.trial] = replace(trial, state="diverged")
                else:
                    chunks, every = (*trial.chunks, last), (*trial.returns, tuple(returns))
                    results[trial.trial] = replace(trial, chunks=chunks, returns=every)
            if last < CHUNKS:
                complete = [result for result in results.values() if result.state == "complete"]
                complete.sort(key=lambda result: (-sum(result.returns[-1]), result.trial))
                for result in complete[-(-len(trials) // tune.keep ** (rung + 1)) :]:
                    # The settings from before the search are always trained to the end, for comparison.
                    if result.trial >= self._first:
                        results[result.trial] = replace(result, state="stopped")
        return list(results.values())

    def finals(self, results: Sequence[Trial]) -> list[Final]:
        """Retrain the first settings and the best of the others with the study's policies, in fresh episodes."""
        tune, study = self._tuning.tune, self._tuning.study
        complete = [result for result in results if result.state == "complete"]
        if not complete:
            raise UnusableData(
                f"{self._folder}: expected a trial with finite returns, got none in {len(results)}: search smaller "
                "learning rates and reward scales"
            )
        ranked = sorted(complete, key=lambda result: (-result.means[-1], result.trial))
        others = [result for result in ranked if result.trial >= self._first][: tune.finalists]
        finalists = [*results[: self._first], *others]
        seeds = derived_seed("tuning", tune.seed, "final training"), derived_seed("tuning", tune.seed, "final episodes")
        split = split_groups(study.policies)
        tasks = {}
        for trial, members in product(finalists, split):
            task = TrainTrials(study, (trial,), members, seeds, study.episodes, (0, CHUNKS), FINALS)
            tasks[f"final/trial-{trial.trial}/p{members[0]}"] = task
        self._train(tasks, RECEIPTS, "retraining the first and the best settings")
        finals = []
        for trial in finalists:
            files = (returns_file(self._folder / FINALS, trial, CHUNKS, members[0]) for members in split)
            groups = [json.loads(file.read_text()) for file in files]
            returns = None if None in groups else tuple(number for group in groups for number in group)
            finals.append(Final(trial.trial, trial.settings, returns))
        if all(final.returns is None for final in finals):
            raise UnusableData(f"{self._folder}: expected finite returns of the best trials, got none")
        return finals

    def _train(self, tasks: Mapping[str, TrainTrials], receipts: str, note: str) -> None:
        jobs = []
        for name, task in tasks.items():
            first, last = task.chunks
            cost_s = _COMPILING_S + self._cost_s(len(task.trials) * len(task.members), last - first)
            jobs.append(Job(name, task, (), cost_s, task.reads))
        self._run_jobs(jobs, receipts, sum(job.cost_s for job in jobs), note)

    def _run_jobs(self, jobs: list[Job], receipts: str, cost_s: float, note: str) -> None:
        left = Jobs(jobs, self._folder, self._folder / receipts, self._fingerprint)
        if left.waiting:
            part = Part(self._progress, self._done_s, cost_s, max(self._total_s, self._done_s + cost_s), note)
            left.run(workers=None, executor=self._executor, progress=part)
        self._done_s += cost_s

    def _batch_s(self, trials: int) -> float:
        """About how long a batch takes on one core, most of whose trials are stopped early."""
        tune = self._tuning.tune
        return 0.4 * self._cost_s(tune.policies * trials, CHUNKS) + _COMPILING_S * len(tune.chunks)

    def _cost_s(self, policies: int, chunks: int) -> float:
        return policies * self._tuning.study.robots[0].trained_for * chunks / CHUNKS / ITERATIONS_PER_S
