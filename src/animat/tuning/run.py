"""Running a tuning: generation after generation of trials, each told in order, and the best of them trained anew."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from animat.differences import with_fingerprint
from animat.errors import InvalidFile, UnusableData
from animat.execution.jobs import Job, Jobs, expect_workers
from animat.execution.pinned import PinnedProcesses, own_cores
from animat.execution.task import UNFINISHED
from animat.progress import Part, Progress, Silent
from animat.studies.folder import claim_folder, describe_study, hash_files, source_files
from animat.studies.places import OWN_FOLDERS, RECEIPTS
from animat.studies.plan import ITERATIONS_PER_S
from animat.studies.recording import JOB, Record
from animat.studies.run import check_custom
from animat.studies.task import draw_seed
from animat.training.group import split_groups
from animat.training.specification import CHUNKS
from animat.tuning.journal import Told, read_journal, write_journal
from animat.tuning.results import Final, Tuned, write_results
from animat.tuning.search import Search, expect_optuna, importance_of
from animat.tuning.space import first_settings, own_settings, with_settings
from animat.tuning.specification import Tuning
from animat.tuning.tasks import Fit, TrainTrials, Trial, returns_file, same_shapes, timeline_file

MANIFEST = "tune.json"
FINALS = "finals"


def describe_tuning(tuning: Tuning, sources: dict[str, str]) -> dict[str, Any]:
    """What decides how a tuning comes out, as of a study (`describe_study`), with a fingerprint over all of it."""
    versions = {**describe_study(tuning.study, sources)["versions"], "optuna": importlib.metadata.version("optuna")}
    return with_fingerprint({**tuning.to_dict(), "sources": sources, "versions": versions})


def tune(
    tuning: Tuning,
    folder: str | os.PathLike[str],
    *,
    base: str | os.PathLike[str] = ".",
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Search for settings into a folder, or go on with a search.

    Killed at any moment and called again, it goes on; the journal and the results end the same, byte for byte, with any
    number of workers. For that, trials are decided `together` at a time, and told in the order of their numbers.

    Args:
        tuning: the specification.
        folder: where everything goes; made if it is missing.
        base, workers, executor, progress: as of `animat.studies.run.run_study`.

    Raises:
        Mismatch: if the folder is another tuning's, its recordings have changed, or another run is at work in it.
        InvalidFile: if a file cannot be read or written.
        InvalidArgument: for fewer workers than one, or any beside an executor.
        UnusableData: if no trial learned anything finite.
        AnimatError: if Optuna is not installed, or a task failed; its message names it.
    """
    expect_optuna()
    expect_workers(workers, executor)
    folder, base, progress = Path(folder).absolute(), Path(base).absolute(), progress or Silent()
    study = tuning.study
    # Looked at before there is a folder.
    check_custom(study.robots, [study.arms[0].mapping, *_choices(tuning.space.get("mapping"))])
    manifest = describe_tuning(tuning, hash_files(source_files(study, base), base))
    # Processes of ours stay from one part of the work to the next.
    running_on: AbstractContextManager[Executor] = (
        PinnedProcesses(own_cores(workers)) if executor is None else nullcontext(executor)
    )
    with claim_folder(folder, "tuning", manifest, MANIFEST, {}, (*OWN_FOLDERS, FINALS)), running_on as at:
        run = _Run(tuning, folder, manifest["fingerprint"], at, progress)
        run.fit(base)
        told = run.search()
        finals = run.finals(told)
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
        return write_results(folder, tuning, told, finals, importance_of(tuning.space, told))


class _Run:
    """A tuning while it runs: its jobs, part after part, on one executor."""

    def __init__(self, tuning: Tuning, folder: Path, fingerprint: str, at: Executor, progress: Progress) -> None:
        self._tuning, self._folder, self._fingerprint, self._at = tuning, folder, fingerprint, at
        tune = tuning.tune
        self._first = min(len(first_settings(tuning.study, tuning.space)), tune.trials)
        self._progress, self._done_s = progress, 0.0
        self._total_s = 20 + self._cost_s(tune.policies * tune.trials, CHUNKS) * 0.4
        self._total_s += self._cost_s(tuning.study.policies * (tune.finalists + self._first), CHUNKS)

    def fit(self, base: Path) -> None:
        """Have the recordings, and simulators of every kind that is searched."""
        study, space = self._tuning.study, self._tuning.space
        if not study.needs_neurons:
            return
        own = own_settings(study)
        variants = [
            with_settings(study, {"simulator": kind, "conditions": conditions, "readouts": readouts})
            for kind in {own["simulator"]: None, **dict.fromkeys(_choices(space.get("simulator")))}
            for conditions in {own["conditions"]: None, **dict.fromkeys(_choices(space.get("conditions")))}
            for readouts in {own["readouts"]: None, **dict.fromkeys(_choices(space.get("readouts")))}
        ]
        fits = [Job(f"fit/{timeline_file(each).stem}", Fit(each), (JOB,), 3) for each in variants]
        self._do([Job(JOB, Record(study, base), (), 5), *fits], RECEIPTS, 20, "recordings and simulators")

    def search(self) -> list[Told]:
        """All trials, from the journal as far as it goes."""
        tune, search, known = self._tuning.tune, Search(self._tuning), read_journal(self._folder)
        told: list[Told] = []
        for first in range(0, tune.trials, tune.together):
            asked = search.ask(min(tune.together, tune.trials - first))
            generation = [Trial(first + i, settings) for i, settings in enumerate(asked)]
            found = known[first : first + len(asked)]
            place = f"{UNFINISHED}/from-{first}"
            if len(found) < len(asked):
                found = self._generation(generation, place)
                told += found
                write_journal(self._folder, told)
            elif [each.settings for each in found] != asked:
                raise InvalidFile(
                    f"{self._folder}: expected the journal of this tuning, got one with other settings in trials "
                    f"{first} to {first + len(asked) - 1}; remove it, and its trials are made again"
                )
            else:
                told += found
                self._done_s += 0.4 * self._cost_s(tune.policies * len(asked), CHUNKS)
            # What its trials had learned is of no more use.
            shutil.rmtree(self._folder / place, ignore_errors=True)
            search.tell(found)
        return told

    def _generation(self, trials: Sequence[Trial], place: str) -> list[Told]:
        """Successive halving: all trials up to the first rung, the best of them up to the next, and so on."""
        tune = self._tuning.tune
        seeds = draw_seed("tuning", tune.seed, "training"), draw_seed("tuning", tune.seed, "episodes")
        members, rungs = tuple(range(tune.policies)), tune.chunks
        chunks: dict[int, list[int]] = {trial.number: [] for trial in trials}
        returns: dict[int, list[tuple[float, ...]]] = {trial.number: [] for trial in trials}
        diverged, racing = set(), list(trials)
        for rung, (first, last) in enumerate(zip([0, *rungs], rungs, strict=False)):
            jobs = [
                self._job(
                    f"rung-{rung + 1}/trials-{','.join(str(trial.number) for trial in group)}",
                    TrainTrials(
                        self._tuning.study, group, members, seeds, tune.episodes, (first, last), place, last < CHUNKS
                    ),
                )
                for group in same_shapes(racing, tune.policies)
            ]
            names = (
                f"trials {trials[0].number} to {trials[-1].number} of {tune.trials}, rung {rung + 1} of {len(rungs)}"
            )
            self._do(jobs, f"{place}/jobs", sum(job.cost_s for job in jobs), names)
            for trial in racing:
                got = json.loads(returns_file(self._folder / place, trial, last, 0).read_text())
                if got is None:
                    diverged.add(trial.number)
                else:
                    chunks[trial.number].append(last)
                    returns[trial.number].append(tuple(got))
            racing = [trial for trial in racing if trial.number not in diverged]
            if last < CHUNKS:
                ranked = sorted(racing, key=lambda trial: (-sum(returns[trial.number][-1]), trial.number))
                goes_on = {trial.number for trial in ranked[: -(-len(trials) // tune.keep ** (rung + 1))]}
                # The settings that were there before the search go the whole way, to compare with.
                racing = [trial for trial in racing if trial.number in goes_on or trial.number < self._first]
        complete = {trial.number for trial in racing}
        return [
            Told(
                trial.number,
                trial.settings,
                "diverged" if trial.number in diverged else "complete" if trial.number in complete else "stopped",
                tuple(chunks[trial.number]),
                tuple(returns[trial.number]),
            )
            for trial in trials
        ]

    def finals(self, told: Sequence[Told]) -> list[Final]:
        """The first settings and the best of the others, trained anew with the study's policies, in fresh episodes."""
        tune, study = self._tuning.tune, self._tuning.study
        complete = [each for each in told if each.state == "complete"]
        if not complete:
            raise UnusableData(
                f"{self._folder}: expected a trial of finite returns, got none of {len(told)}: search among smaller "
                "learning rates and reward scales"
            )
        ranked = sorted(complete, key=lambda each: (-each.means[-1], each.trial))
        others = [each for each in ranked if each.trial >= self._first][: tune.finalists]
        finalists = [Trial(each.trial, each.settings) for each in (*told[: self._first], *others)]
        seeds = draw_seed("tuning", tune.seed, "final training"), draw_seed("tuning", tune.seed, "final episodes")
        jobs = [
            self._job(
                f"final/trial-{trial.number}/p{members[0]}",
                TrainTrials(study, (trial,), members, seeds, study.episodes, (0, CHUNKS), FINALS, False),
            )
            for trial in finalists
            for members in split_groups(study.policies)
        ]
        self._do(jobs, RECEIPTS, sum(job.cost_s for job in jobs), "the best and the first settings, anew")
        finals = []
        for trial in finalists:
            returns: list[float] | None = []
            for members in split_groups(study.policies):
                got = json.loads(returns_file(self._folder / FINALS, trial, CHUNKS, members[0]).read_text())
                returns = None if got is None or returns is None else returns + got
            finals.append(Final(trial.number, trial.settings, None if returns is None else tuple(returns)))
        if all(each.returns is None for each in finals):
            raise UnusableData(f"{self._folder}: expected finite returns of the best trials, got none")
        return finals

    def _job(self, name: str, task: TrainTrials) -> Job:
        first, last = task.chunks
        return Job(name, task, (), self._cost_s(len(task.trials) * len(task.members), last - first), task.reads)

    def _do(self, jobs: list[Job], receipts: str, cost_s: float, words: str) -> None:
        left = Jobs(jobs, self._folder, self._folder / receipts, self._fingerprint)
        if left.waiting:
            part = Part(self._progress, self._done_s, cost_s, max(self._total_s, self._done_s + cost_s), words)
            left.run(workers=None, executor=self._at, progress=part)
        self._done_s += cost_s

    def _cost_s(self, policies: int, chunks: int) -> float:
        return policies * self._tuning.study.robots[0].trained_for * chunks / CHUNKS / ITERATIONS_PER_S


def _choices(among: Any) -> tuple[Any, ...]:
    return among if isinstance(among, tuple) else ()
