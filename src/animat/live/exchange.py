"""Where the process that records and those that train meet: a folder of simulators, the newest of which counts."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from animat.execution.task import report, reported
from animat.neurons.simulator import NeuronSimulator
from animat.writing import write_whole

_FINISH = "finish"


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
