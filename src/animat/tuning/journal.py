"""The journal of a tuning: every trial with its settings and what it got, a line each in the order of their numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

from animat.errors import InvalidFile
from animat.records import read_record
from animat.tuning.space import Settings
from animat.writing import write_whole

JOURNAL = "journal.jsonl"


@dataclass(frozen=True)
class Told:
    """A trial that is done.

    Attributes:
        trial: its number.
        settings: what was tried.
        state: `"complete"`, `"stopped"` before the whole training, as others did better, or `"diverged"`: what it
            learned was no finite number any more.
        chunks: of the training, done at the end of each rung that it reached with finite numbers.
        returns: the mean return of each policy then.
    """

    trial: int
    settings: Settings
    state: Literal["complete", "stopped", "diverged"]
    chunks: tuple[int, ...]
    returns: tuple[tuple[float, ...], ...]

    @property
    def means(self) -> list[float]:
        """The mean over policies at the end of each rung."""
        return [fmean(each) for each in self.returns]


def write_journal(folder: Path, told: Sequence[Told]) -> None:
    """Write all of it; no times of day, so that the same search leaves the same bytes."""
    write_whole(folder / JOURNAL, "".join(json.dumps(asdict(each)) + "\n" for each in told))


def read_journal(folder: Path) -> list[Told]:
    """What is in the folder's journal, nothing where there is none; raises InvalidFile if it cannot be read."""
    path = folder / JOURNAL
    if not path.exists():
        return []
    try:
        told = [read_record(Told, json.loads(line)) for line in path.read_text().splitlines()]
        if [each.trial for each in told] != list(range(len(told))):
            raise ValueError("trials are missing")
        if not all(math.isfinite(x) for each in told for of in each.returns for x in of):
            raise ValueError("a return is no finite number")
    except (OSError, ValueError, RecursionError, TypeError) as error:
        raise InvalidFile(
            f"{path}: expected the journal of a tuning, got a file that cannot be read ({error}); remove it, and its "
            "trials are made again"
        ) from error
    return told
