"""Training beside a culture that lives, as a task: on what it was last, until it is told to end."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from animat.errors import AnimatError
from animat.execution.task import Task
from animat.live.exchange import Exchange
from animat.progress import Progress
from animat.training.group import Group, SideBySide, save_policies


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
