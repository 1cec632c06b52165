"""What a tuning ends with: the best settings as a study's TOML, the finals, and figures of history and importance."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from animat.report.style import save_figure
from animat.report.tuning import draw_history, draw_importance
from animat.studies.places import RECORDINGS
from animat.studies.toml import study_to_toml
from animat.tuning.journal import Told
from animat.tuning.space import SEARCHABLE, THROUGH_NEURONS, Settings, with_settings
from animat.tuning.specification import Tuning
from animat.writing import write_whole

BEST, RESULTS, HISTORY, IMPORTANCE = "best.toml", "results.json", "history.png", "importance.png"


@dataclass(frozen=True)
class Final:
    """Settings that were trained anew.

    Attributes:
        trial: that tried them first; 0 are the study's own.
        settings: what was searched.
        returns: mean return of each policy in fresh episodes; None where one learned no finite number.
    """

    trial: int
    settings: Settings
    returns: tuple[float, ...] | None

    @property
    def mean(self) -> float:
        """Over policies; of none, less than any."""
        return -math.inf if self.returns is None else fmean(self.returns)

    @property
    def standard_error(self) -> float | None:
        """Of the mean; None for fewer policies than two."""
        if self.returns is None or len(self.returns) < 2:
            return None
        return stdev(self.returns) / math.sqrt(len(self.returns))


@dataclass(frozen=True)
class Tuned:
    """What a tuning found.

    Attributes:
        folder: where everything is.
        best: of the finals, the first of which are the study's own settings, and the defaults if they were tried.
        finals: in the order of the trials that they come from, by what they got there.
        told: all trials.
        importance: share of each setting, the largest first; empty for fewer trials than four.
    """

    folder: Path
    best: Final
    finals: tuple[Final, ...]
    told: tuple[Told, ...]
    importance: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        rows = [
            {**asdict(each), "mean_return": None if each.returns is None else each.mean,
             "standard_error": each.standard_error}
            for each in self.finals
        ]  # fmt: skip
        states = {
            state: sum(each.state == state for each in self.told) for state in ("complete", "stopped", "diverged")
        }
        best = {"trial": self.best.trial, "settings": self.best.settings}
        return {"best": best, "finals": rows, "trials": states, "importance": dict(self.importance)}


def write_results(
    folder: Path, tuning: Tuning, told: Sequence[Told], finals: Sequence[Final], importance: Mapping[str, float]
) -> Tuned:
    """Write all that a tuning ends with into its folder; done again, the same bytes."""
    # Of two that are as good, the study's own, or else the one that was found first.
    best = max(finals, key=lambda each: (each.mean, -each.trial))
    tuned = Tuned(folder, best, tuple(finals), tuple(told), importance)
    study = with_settings(tuning.study, best.settings)
    if study.culture.kind == "files":
        study = replace(study, culture=replace(study.culture, files=(RECORDINGS,)))
    write_whole(folder / BEST, f"# animat study {BEST}\n{study_to_toml(study)}")
    write_whole(folder / RESULTS, json.dumps(tuned.to_dict(), indent=1) + "\n")
    robot, own = tuning.study.robots[0].name, finals[0]
    rungs = [(each.trial, each.chunks, each.means) for each in told]
    chosen = (best.trial, best.mean, best.standard_error)
    reference = None if own.returns is None else (own.mean, own.standard_error)
    save_figure(draw_history(rungs, tuning.tune.chunks, chosen, reference, f"Tuning on {robot}"), folder / HISTORY)
    if importance:
        first = tuning.tune.chunks[0] / tuning.tune.chunks[-1]
        title = f"{robot}: importance for the return after {100 * first:.0f} % of training"
        save_figure(draw_importance(importance, title), folder / IMPORTANCE)
    return tuned


def settings_in_words(settings: Mapping[str, Any]) -> str:
    """Settings in one line, numbers to three digits."""
    ordered = sorted(settings, key=lambda name: (name not in THROUGH_NEURONS, SEARCHABLE.index(name)))
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in ((name, settings[name]) for name in ordered)
    )
