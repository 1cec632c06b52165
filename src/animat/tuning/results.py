"""The results of a tuning: the best settings as a study's TOML, the finals, and figures of history and importance."""

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
from animat.studies.folder import RECORDINGS
from animat.studies.toml import study_to_toml
from animat.tuning.search import TrialResult, importance_of
from animat.tuning.specification import SEARCHABLE, THROUGH_NEURONS, Settings, Tuning, with_settings
from animat.writing import write_whole

BEST, RESULTS, HISTORY, IMPORTANCE = "best.toml", "results.json", "history.png", "importance.png"


@dataclass(frozen=True)
class Final:
    """Settings that were retrained at the end.

    Attributes:
        trial: the trial that tried them first; 0: the study's own settings.
        returns: mean return of each policy in fresh episodes; None if a policy's parameters were not finite.
    """

    trial: int
    settings: Settings
    returns: tuple[float, ...] | None

    @property
    def mean(self) -> float:
        """Mean over policies; -inf without returns."""
        return -math.inf if self.returns is None else fmean(self.returns)

    @property
    def standard_error(self) -> float | None:
        """Standard error of the mean; None for fewer than two policies."""
        if self.returns is None or len(self.returns) < 2:
            return None
        return stdev(self.returns) / math.sqrt(len(self.returns))


@dataclass(frozen=True)
class TuningResult:
    """The outcome of a tuning.

    Attributes:
        finals: the study's own settings, the defaults if they were tried, then the best trials, best first.
        importance: share of each setting, the largest first; empty for fewer than four trials.
    """

    folder: Path
    best: Final
    finals: tuple[Final, ...]
    trials: tuple[TrialResult, ...]
    importance: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        rows = [
            {**asdict(final), "mean_return": None if final.returns is None else final.mean,
             "standard_error": final.standard_error}
            for final in self.finals
        ]  # fmt: skip
        states = [trial.state for trial in self.trials]
        counts = {state: states.count(state) for state in ("complete", "stopped", "diverged")}
        best = {"trial": self.best.trial, "settings": self.best.settings}
        return {"best": best, "finals": rows, "trials": counts, "importance": dict(self.importance)}


def write_results(folder: Path, tuning: Tuning, trials: Sequence[TrialResult], finals: Sequence[Final]) -> TuningResult:
    """Write the results of a tuning into its folder, reproducibly."""
    importance = importance_of(tuning.space, trials)
    # Among equals the study's own, or else the one that was found first.
    best = max(finals, key=lambda final: (final.mean, -final.trial))
    tuned = TuningResult(folder, best, tuple(finals), tuple(trials), importance)
    study = with_settings(tuning.study, best.settings)
    if study.culture.kind == "files":
        study = replace(study, culture=replace(study.culture, files=(RECORDINGS,)))
    write_whole(folder / BEST, f"# animat study {BEST}\n{study_to_toml(study)}")
    write_whole(folder / RESULTS, json.dumps(tuned.to_dict(), indent=1) + "\n")
    robot, own = tuning.study.robots[0].name, finals[0]
    rungs = [
        (trial.trial, (), ()) if trial.state == "diverged" else (trial.trial, trial.chunks, trial.means)
        for trial in trials
    ]
    chosen = (best.trial, best.mean, best.standard_error)
    reference = None if own.returns is None else (own.mean, own.standard_error)
    save_figure(draw_history(rungs, tuning.tune.chunks, chosen, reference, f"Tuning on {robot}"), folder / HISTORY)
    if importance:
        first = tuning.tune.chunks[0] / tuning.tune.chunks[-1]
        title = f"{robot}: importance for the return after {100 * first:.0f} % of training"
        save_figure(draw_importance(importance, title), folder / IMPORTANCE)
    return tuned


def describe_settings(settings: Mapping[str, Any]) -> str:
    """Settings in one line, with three significant digits."""
    ordered = sorted(settings, key=lambda name: (name not in THROUGH_NEURONS, SEARCHABLE.index(name)))
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in ((name, settings[name]) for name in ordered)
    )
