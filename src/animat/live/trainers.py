"""The processes that train while the culture is recorded, as seen from the one that records."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from animat.errors import AnimatError
from animat.live.exchange import Exchange
from animat.training.group import Group
from animat.training.worker import start_worker

KEEP_S = 10.0
"""Seconds between times that the policies are written as they are: what a killed run costs of training."""


class Trainers:
    """One process a group of policies; use it as a context manager, which ends them whatever happens.

    Args:
        groups: what they train.
        exchange: the simulators.
        folder: where the policies go.
    """

    def __init__(self, groups: Sequence[Group], exchange: Exchange, folder: Path) -> None:
        self._groups, self._exchange, self._folder = groups, exchange, folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._told: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._using: dict[tuple[int, ...], int] = {}
        self.iterations = 0
        """Of the group that has done the fewest."""
        self.mean_return = float("nan")
        """Of the episodes that ended in the last chunk."""
        self._iterations: dict[tuple[int, ...], int] = {}

    def __enter__(self) -> Trainers:
        # The last cores first: the process that records is where it is.
        cores = sorted(os.sched_getaffinity(0), reverse=True)
        for i, group in enumerate(self._groups):
            with tempfile.TemporaryFile() as job:
                pickle.dump((group, self._exchange, self._folder, KEEP_S), job)
                job.seek(0)
                process = start_worker("animat.live.worker", cores[i % len(cores)], job)
            self._processes.append(process)
            threading.Thread(target=self._listen, args=(process, group), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.wait()

    def swaps(self, wait_s: float) -> list[dict[str, Any]]:
        """Wait, and return the swaps that were made meanwhile.

        Raises:
            AnimatError: if a process ended without having been told to.
        """
        until_s = time.monotonic() + wait_s
        swaps: list[dict[str, Any]] = []
        while True:
            try:
                told = self._told.get(timeout=max(0.0, until_s - time.monotonic()))
            except Empty:
                return swaps
            members = tuple(told["members"])
            if "error" in told:
                raise AnimatError(told["error"])
            if "swap" in told:
                self._using[members] = told["swap"]
                swaps.append(told)
            if "done" in told:
                self._iterations[members] = told["iterations"]
                self.iterations = min(self._iterations.values())
                self.mean_return = told["mean_return"]
            if "ended" in told and not (self._exchange.is_finished and told["ended"] == 0):
                raise AnimatError(
                    f"training: the process of policies {members} ended with status {told['ended']} while the culture "
                    "was recorded; the recordings are kept"
                )

    def all_use(self, number: int) -> bool:
        """Whether every group trains on the simulator of this number or a newer one."""
        return len(self._using) == len(self._groups) and min(self._using.values()) >= number

    def finish(self, patience_s: float = 120.0) -> list[dict[str, Any]]:
        """Tell them to end, wait until they have written their policies, and return the last swaps.

        Raises:
            AnimatError: if one does not end, or fails.
        """
        self._exchange.finish()
        until_s = time.monotonic() + patience_s
        swaps: list[dict[str, Any]] = []
        while any(process.poll() is None for process in self._processes):
            swaps += self.swaps(0.1)
            if time.monotonic() > until_s:
                raise AnimatError(f"training: expected it to end within {patience_s:g} s, but it goes on")
        return swaps + self.swaps(0.1)

    def _listen(self, process: subprocess.Popen[bytes], group: Group) -> None:
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                self._told.put(json.loads(line))
        self._told.put({"members": list(group.members), "ended": process.wait()})
