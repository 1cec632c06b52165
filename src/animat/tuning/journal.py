"""The journal of a tuning: one line per trial, with its settings and returns, in the order of their numbers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

from animat.errors import InvalidFile
from animat.records import Number, read_record
from animat.tuning.space import Settings
from animat.writing import write_whole

JOURNAL = "journal.jsonl"


@dataclass(frozen=True)
class TrialResult:
    """The result of a trial.

    Attributes:
        trial: number of the trial.
        settings: the settings tried.
        state: `"complete"`, `"stopped"` before the end of training, as others did better, or `"diverged"`: its
            parameters were no longer finite.
        chunks: chunks of training done at the end of each rung that it reached with finite parameters.
        returns: the mean return of each policy at these ends.
    """

    trial: int
    settings: Settings
    state: Literal["complete", "stopped", "diverged"]
    chunks: tuple[int, ...]
    returns: tuple[tuple[Number, ...], ...]

    @property
    def means(self) -> list[float]:
        """The mean over policies at the end of each rung."""
        return [fmean(each) for each in self.returns]


def write_journal(folder: Path, trials: Sequence[TrialResult]) -> None:
    """Write the whole journal, without times of day, so that the same search writes the same bytes."""
    write_whole(folder / JOURNAL, "".join(json.dumps(asdict(trial)) + "\n" for trial in trials))


def read_journal(folder: Path) -> list[TrialResult]:
    """The trials in the folder's journal, none without a journal; raises InvalidFile if it cannot be read."""
    path = folder / JOURNAL
    if not path.exists():
        return []
    try:
        trials = [read_record(TrialResult, json.loads(line)) for line in path.read_text().splitlines()]
        if [trial.trial for trial in trials] != list(range(len(trials))):
            raise ValueError("trials are missing")
    except (OSError, ValueError, RecursionError, TypeError) as error:
        raise InvalidFile(
            f"{path}: expected the journal of a tuning, got a file that cannot be read ({error}); remove it to run its "
            "trials again"
        ) from error
    return trials
