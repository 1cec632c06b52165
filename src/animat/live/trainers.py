"""The processes that train while the culture is recorded, as seen from the one that records."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from animat.errors import AnimatError
from animat.execution.pinned import PinnedProcesses
from animat.execution.task import Task, TaskResult, carry_out, report, reported
from animat.neurons.simulator import NeuronSimulator
from animat.progress import Progress
from animat.training.group import Group, SideBySide, save_policies
from animat.writing import write_whole

_FINISH = "finish"
KEEP_S = 10.0
"""Seconds between times that the policies are written as they are: what a killed run costs of training."""


class Exchange:
    """A folder of one run alone, in which one process publishes simulators and others look; its files are whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def publish(self, number: int, start_min: float, simulator: NeuronSimulator) -> None:
        """Put up a simulator, its arrays on the host; the one with the largest number is in force."""
        write_whole(self.folder / f"{number:06}.simulator", pickle.dumps((number, start_min, simulator)))

    def newest(self, known: int) -> tuple[int, float, NeuronSimulator] | None:
        """Number, minute and simulator of the newest, if its number is larger than the one that is known."""
        newest = max((int(file.stem) for file in self.folder.glob("[0-9]*.simulator")), default=known)
        if newest <= known:
            return None
        read: tuple[int, float, NeuronSimulator] = pickle.loads((self.folder / f"{newest:06}.simulator").read_bytes())
        return read

    def report(self, first: int, words: dict[str, Any]) -> None:
        """Say how the group whose first policy is this one does, as plain data."""
        report(self.folder / f"p{first}.json", words)

    def reported(self, first: int) -> dict[str, Any] | None:
        """What a group said last; None if it has not begun."""
        words: dict[str, Any] | None = reported(self.folder / f"p{first}.json")
        return words

    def finish(self) -> None:
        """Say that training is to end at the next chunk."""
        (self.folder / _FINISH).touch()

    @property
    def is_finished(self) -> bool:
        """Whether training is to end."""
        return (self.folder / _FINISH).exists()


@final
@dataclass(frozen=True, eq=False)
class TrainAlongside(Task):
    """Train a group of policies, before each chunk on the newest simulator of the exchange.

    It says which of them it uses, its swaps, and how far it is, by the exchange too, which also tells when to end.
    Every `keep_s` seconds the policies are written as they are.
    """

    group: Group
    exchange: Exchange
    keep_s: float

    @property
    def grows_with(self) -> dict[str, object]:
        return {"algorithm": self.group.training.algorithm}

    def run(self, folder: Path, progress: Progress) -> list[Path]:
        training = self.group.training
        training.register()
        swaps: list[dict[str, Any]] = []
        # The policies tell what they were trained on, the last of it known only in the end.
        group = replace(self.group, provenance={**self.group.provenance, "swaps": swaps})
        together = SideBySide(group)
        number, simulator, index, kept_s = -1, None, 0, time.monotonic()
        told: dict[str, Any] = {"using": number, "iterations": 0, "mean_return": float("nan"), "swaps": []}
        while not (self.exchange.is_finished and index):
            newer = self.exchange.newest(number)
            if newer is not None:
                number, start_min, simulator = newer
                swaps.append({"chunk": index, "iterations": told["iterations"], "recorded_at_min": start_min})
                told["using"] = number
                told["swaps"].append({"swap": number, **swaps[-1]})
                self.exchange.report(group.members[0], told)
            if simulator is None:
                raise AnimatError("live: expected a simulator in the exchange before training began, got none")
            told["mean_return"] = together.train(index, simulator)
            if time.monotonic() - kept_s > self.keep_s:
                save_policies(group, together.policies(), folder)
                kept_s = time.monotonic()
            index += 1
            told["iterations"] = training.chunk(index)[0] * training.algorithm.environments
            self.exchange.report(group.members[0], told)
        return save_policies(group, together.policies(), folder)


class Trainers:
    """One process a group of policies, which go into a folder; a context manager ends them whatever happens."""

    def __init__(self, groups: Sequence[Group], exchange: Exchange, folder: Path) -> None:
        self._exchange, self._folder = exchange, folder
        self._groups = {group.members[0]: group for group in groups}
        self._futures: dict[Future[TaskResult], Group] = {}
        self._told: dict[int, dict[str, Any]] = {}

    def __enter__(self) -> Trainers:
        # The last cores first: the process that records is where it is. All groups train at once, on any number.
        cores = sorted(os.sched_getaffinity(0), reverse=True)
        self._executor = PinnedProcesses([cores[i % len(cores)] for i in range(len(self._groups))])
        for first, group in self._groups.items():
            task = TrainAlongside(group, self._exchange, KEEP_S)
            notice = self._exchange.folder / f"progress-p{first}.json"
            self._futures[self._executor.submit(carry_out, task, self._folder, notice)] = group
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.kill_workers()

    @property
    def iterations(self) -> int:
        """Of the group that has done the fewest."""
        fewest: int = min(words["iterations"] for words in self._told.values())
        return fewest

    @property
    def mean_return(self) -> float:
        """Of the episodes that ended in the last chunk of a group; NaN for none."""
        return next((words["mean_return"] for words in self._told.values()), float("nan"))

    def swaps(self, wait_s: float) -> list[dict[str, Any]]:
        """Wait, and return the swaps that were made meanwhile.

        Raises:
            AnimatError: if a training failed, or its process ended.
        """
        for future in wait(self._futures, wait_s, FIRST_COMPLETED).done:
            try:
                future.result()
            except BrokenExecutor as error:
                names = " and ".join(f"p{member}" for member in self._futures[future].members)
                raise AnimatError(
                    f"training {names}: {error} while the culture was recorded; the recordings are kept"
                ) from error
        swaps: list[dict[str, Any]] = []
        for first, group in self._groups.items():
            words = self._exchange.reported(first)
            if words is not None:
                before = self._told.get(first, {"swaps": []})
                swaps += [{"members": list(group.members), **swap} for swap in words["swaps"][len(before["swaps"]) :]]
                self._told[first] = words
        return swaps

    def all_use(self, number: int) -> bool:
        """Whether every group trains on the simulator of this number or a newer one."""
        return len(self._told) == len(self._groups) and all(w["using"] >= number for w in self._told.values())

    def finish(self, patience_s: float = 120.0) -> list[dict[str, Any]]:
        """Tell them to end, wait until they have written their policies, and return the last swaps.

        Raises:
            AnimatError: if one does not end, or fails.
        """
        self._exchange.finish()
        if wait(self._futures, patience_s).not_done:
            raise AnimatError(f"training: expected it to end within {patience_s:g} s, but it goes on")
        return self.swaps(0.0)
