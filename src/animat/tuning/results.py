"""The results of a tuning: the best settings as a study's TOML, the finals, and figures of history and importance."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from animat.lazy import Figure
from animat.report.colours import BLACK, BLUE, GREY, ORANGE, PURPLE, RED, SKY
from animat.report.style import add_common_legend, new_figure, save_figure, style_axes
from animat.studies.folder import RECORDINGS
from animat.studies.toml import study_to_toml
from animat.tuning.search import Trial, importance_of
from animat.tuning.specification import SEARCHABLE, THROUGH_NEURONS, Settings, Tuning, with_settings
from animat.writing import write_whole

BEST, RESULTS, HISTORY, IMPORTANCE = "best.toml", "results.json", "history.png", "importance.png"
_MARKERS = "ov^sDP"


@dataclass(frozen=True)
class Final:
    """Settings that were retrained at the end, and the trial that tried them first (0: the study's own settings).

    `returns` are each policy's mean return in fresh episodes; None if a policy's parameters were not finite.
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
    """The outcome of a tuning; in `finals` the study's own settings, the defaults if tried, then the best trials.

    `importance` is the share of each setting, the largest first; empty if the trials cannot tell.
    """

    folder: Path
    best: Final
    finals: tuple[Final, ...]
    trials: tuple[Trial, ...]
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


def write_results(folder: Path, tuning: Tuning, trials: Sequence[Trial], finals: Sequence[Final]) -> TuningResult:
    """Write the results of a tuning into its folder, reproducibly."""
    importance = importance_of(tuning.space, trials)
    # Of equal means the earliest trial's: the study's own settings are the first.
    best = max(finals, key=lambda final: (final.mean, -final.trial))
    tuned = TuningResult(folder, best, tuple(finals), tuple(trials), importance)
    study = with_settings(tuning.study, best.settings)
    if study.culture.kind == "files":
        study = replace(study, culture=replace(study.culture, files=(RECORDINGS,)))
    write_whole(
        folder / BEST,
        f"# To run it, in the folder where animat tune was run: animat study <this file>\n{study_to_toml(study)}",
    )
    write_whole(folder / RESULTS, json.dumps(tuned.to_dict(), indent=1) + "\n")
    robot = tuning.study.robots[0].name
    save_figure(draw_history(tuned, tuning.tune.chunks, f"Tuning on {robot}"), folder / HISTORY)
    if importance:
        first = tuning.tune.chunks[0] / tuning.tune.chunks[-1]
        title = f"{robot}: importance for the return after {100 * first:.0f} % of training"
        save_figure(draw_importance(importance, title), folder / IMPORTANCE)
    return tuned


def draw_history(tuned: TuningResult, rungs: Sequence[int], title: str) -> Figure:
    """One point per trial at its last mean return, by how far it was trained; the best full training so far; finals.

    `rungs` are the chunks done at the end of each; the last is the full training.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(7.0, 3.8)
    axes = figure.subplots()
    colours = (GREY, SKY, ORANGE, PURPLE, BLACK)[: len(rungs) - 1]
    known = [trial for trial in tuned.trials if trial.state != "diverged"]
    whole = []
    for rung, (chunks, colour) in enumerate(zip(rungs, (*colours, BLUE), strict=True)):
        ended = [(trial.trial, trial.means[-1]) for trial in known if trial.chunks[-1] == chunks]
        is_whole = chunks == rungs[-1]
        if ended:
            label = "fully trained" if is_whole else f"stopped at {100 * chunks / rungs[-1]:.0f} %"
            marker, size = _MARKERS[len(rungs) - 1 - rung], 6 if is_whole else 4
            axes.plot(*zip(*ended, strict=True), marker, color=colour, markersize=size, label=label)
        whole = ended
    if whole:
        so_far = list(accumulate((mean for _, mean in whole), max))
        x = [*(number for number, _ in whole), tuned.trials[-1].trial]
        axes.step(x, [*so_far, so_far[-1]], where="post", color=BLUE, linewidth=1.2, label="best fully trained so far")
    # Diverged trials are shown even if they were not trained to the end.
    if diverged := [trial.trial for trial in tuned.trials if trial.state == "diverged"]:
        low = axes.get_ylim()[0]
        axes.plot(diverged, [low] * len(diverged), "x", color=RED, label="diverged")
    own, best = tuned.finals[0], tuned.best
    if own.returns is not None:
        axes.axhline(own.mean, color=BLACK, linestyle="--", linewidth=1, label="own settings, retrained")
    error, label = best.standard_error or 0.0, "best, retrained"
    axes.errorbar([best.trial], [best.mean], [error], fmt="*", color=RED, markersize=11, capsize=3, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style_axes(axes, title, "trial", "mean return of an episode")
    add_common_legend(figure, [axes], columns=3)
    return figure


def draw_importance(shares: Mapping[str, float], title: str) -> Figure:
    """One bar per setting; `shares` are in descending order and sum to 1."""
    figure = new_figure(6.0, 1.1 + 0.27 * len(shares))
    axes = figure.subplots()
    places = range(0, -len(shares), -1)
    percent = [100 * share for share in shares.values()]
    axes.barh(places, percent, height=0.65, color=BLUE)
    for place, share in zip(places, percent, strict=True):
        axes.annotate(f"{share:.0f}", (share, place), (3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_yticks(places, list(shares))
    axes.set_xlim(0, max(1.0, 1.1 * max(percent)))
    style_axes(axes, title, "importance (%)", "")
    return figure


def describe_settings(settings: Mapping[str, Any]) -> str:
    """Settings in one line, with three significant digits, of a discount those of its distance from 1."""
    ordered = sorted(settings, key=lambda name: (name not in THROUGH_NEURONS, SEARCHABLE.index(name)))
    return ", ".join(f"{name} {_shown(name, settings[name])}" for name in ordered)


def _shown(name: str, value: Any) -> str:
    if name == "discount":
        return f"{1 - float(f'{1 - value:.3g}'):.12g}"
    return f"{value:.3g}" if isinstance(value, float) else str(value) or '""'
