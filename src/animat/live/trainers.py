"""The processes that train while the culture is recorded, and their exchange with the one that records."""

from __future__ import annotations

import pickle
import shutil
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from statistics import fmean
from typing import Any, final

import jax

from animat.errors import AnimatError
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Task, TaskResult, carry_out, report, reported
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.timeline import SimulatorTimeline
from animat.process import own_cores
from animat.progress import Progress
from animat.training.group import Group, SideBySide, save_policies
from animat.writing import write_whole

KEEP_S = 10.0
"""Seconds after which the unfinished policies are saved, at the end of a chunk."""
_PATIENCE_S = 120.0


class Exchange:
    """A folder of one run, in which one process publishes simulators and others read them; files appear complete."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def publish(self, number: int, start_min: float, simulator: NeuronSimulator) -> None:
        """Publish a simulator, with its arrays on the host; the one with the largest number is the newest."""
        write_whole(self.folder / f"{number:06}.simulator", pickle.dumps((number, start_min, simulator)))

    def newest(self, known: int) -> tuple[int, float, NeuronSimulator] | None:
        """Number, minute and simulator of the newest, if its number is larger than `known`."""
        newest = max((int(file.stem) for file in self.folder.glob("[0-9]*.simulator")), default=known)
        if newest <= known:
            return None
        read: tuple[int, float, NeuronSimulator] = pickle.loads((self.folder / f"{newest:06}.simulator").read_bytes())
        return read

    def report_file(self, group: Group) -> Path:
        """The file of the last report on a group's training (`animat.execution.task.report`)."""
        return self.folder / f"p{group.members[0]}.json"

    def finish(self) -> None:
        """Request the end of training at the next chunk."""
        (self.folder / "finish").touch()

    @property
    def is_finished(self) -> bool:
        return (self.folder / "finish").exists()


@final
@dataclass(frozen=True, eq=False)
class TrainAlongside(Task):
    """Train a group of policies, each chunk on the newest simulator of the exchange, which also says when to end."""

    group: Group
    exchange: Exchange
    keep_s: float

    @property
    def grows_with(self) -> dict[str, object]:
        return {"algorithm": self.group.training.algorithm}

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        training, reports = self.group.training, self.exchange.report_file(self.group)
        training.register()
        swaps: list[dict[str, Any]] = []
        # The policies' provenance lists their swaps, which are added below.
        group = replace(self.group, provenance={**self.group.provenance, "swaps": swaps})
        together = SideBySide(group)
        simulator, index, saved_s = None, 0, time.monotonic()
        state: dict[str, Any] = {"using": -1, "iterations": 0, "mean_return": float("nan"), "swaps": []}
        while not (self.exchange.is_finished and index):
            if (newer := self.exchange.newest(state["using"])) is not None:
                state["using"], start_min, simulator = newer
                swaps.append({"chunk": index, "iterations": state["iterations"], "recorded_at_min": start_min})
                state["swaps"].append({"swap": state["using"], **swaps[-1]})
                report(reports, state)
            if simulator is None:
                raise AnimatError("live: expected a simulator in the exchange before training began, got none")
            state["mean_return"] = together.train(index, simulator)
            if time.monotonic() - saved_s > self.keep_s:
                save_policies(group, together.policies(), folder)
                saved_s = time.monotonic()
            index += 1
            state["iterations"] = training.chunk(index)[0] * training.algorithm.environments
            report(reports, state)
        return save_policies(group, together.policies(), folder)


class Trainers:
    """One process per group of policies, which are saved in a folder; leaving the context always ends the processes."""

    def __init__(self, groups: Sequence[Group], exchange: Path, folder: Path) -> None:
        self._groups, self._exchange, self._folder = groups, Exchange(exchange), folder
        self._futures: dict[Future[TaskResult], Group] = {}
        self._reports: dict[Group, dict[str, Any]] = {}
        self._published = 0

    def __enter__(self) -> Trainers:
        self.publish(0, self._groups[0].timeline)
        # The last cores first, to leave the first to the process that records; groups share cores if there are too few.
        cores = own_cores()[::-1]
        self._executor = PinnedProcesses([cores[i % len(cores)] for i in range(len(self._groups))])
        for group in self._groups:
            task = TrainAlongside(group, self._exchange, KEEP_S)
            notice = self._exchange.folder / f"progress-p{group.members[0]}.json"
            self._futures[self._executor.submit(carry_out, task, self._folder, notice)] = group
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.kill_workers()
        shutil.rmtree(self._exchange.folder, ignore_errors=True)

    def publish(self, number: int, timeline: SimulatorTimeline | None) -> None:
        """Let all groups train on the newest simulator of a timeline, which has this number."""
        assert timeline is not None
        self._published, start_min = number, float(timeline.start_min[-1])
        self._exchange.publish(number, start_min, jax.device_get(timeline.at(start_min)))

    @property
    def iterations(self) -> int:
        return int(min(report["iterations"] for report in self._reports.values()))

    @property
    def mean_return(self) -> float:
        """Mean return of the episodes that ended in the last chunks, averaged over groups; NaN if there were none."""
        returns = [report["mean_return"] for report in self._reports.values() if not isnan(report["mean_return"])]
        return fmean(returns) if returns else float("nan")

    @property
    def use_the_newest(self) -> bool:
        """Whether every group trains on the simulator that was published last."""
        reports = self._reports.values()
        return len(reports) == len(self._groups) and all(report["using"] >= self._published for report in reports)

    def swaps(self, wait_s: float) -> list[dict[str, Any]]:
        """Wait, and return the swaps made meanwhile; raises AnimatError if a training failed."""
        for future in wait(self._futures, wait_s, FIRST_COMPLETED).done:
            try:
                future.result()
            except BrokenExecutor as error:
                names = " and ".join(f"p{member}" for member in self._futures[future].members)
                raise AnimatError(f"training {names}: {error} meanwhile; the recordings are kept") from error
        swaps: list[dict[str, Any]] = []
        for group in self._groups:
            if (latest := reported(self._exchange.report_file(group))) is not None:
                known = len(self._reports[group]["swaps"]) if group in self._reports else 0
                swaps += [{"members": list(group.members), **swap} for swap in latest["swaps"][known:]]
                self._reports[group] = latest
        return swaps

    def finish(self) -> list[dict[str, Any]]:
        """Request the end of training, wait until all policies are saved, and return the last swaps."""
        self._exchange.finish()
        if wait(self._futures, _PATIENCE_S).not_done:
            raise AnimatError(f"training: expected it to end within {_PATIENCE_S:g} s, but it continues")
        return self.swaps(0.0)
