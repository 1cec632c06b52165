"""The search itself, by Optuna's tree-structured Parzen estimator, its journal, and the importance of settings."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal

from animat.errors import InvalidFile
from animat.extras import expect_extra
from animat.records import Number, read_record
from animat.studies.task import derived_seed
from animat.training.settings import SAC
from animat.tuning.specification import Range, Settings, Space, Tuning, Value, first_settings
from animat.writing import write_whole

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as Proposed

JOURNAL = "journal.jsonl"
"""One line per trial, with its settings and returns, in the order of their numbers."""
FEWEST = 20
"""Fewest trials from which importance is reported: it compares the best tenth with all, which one trial cannot show."""


@dataclass(frozen=True)
class Trial:
    """Settings to try, and how they did so far.

    Attributes:
        trial: its number, from 0.
        state: `"complete"`, `"stopped"` early, as others did better, or `"diverged"`: its parameters were not finite.
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


def write_journal(folder: Path, trials: Sequence[Trial]) -> None:
    """Write the whole journal, without times of day, so that the same search writes the same bytes."""
    write_whole(folder / JOURNAL, "".join(json.dumps(asdict(trial)) + "\n" for trial in trials))


def read_journal(folder: Path) -> list[Trial]:
    """The trials in the folder's journal, none without a journal; raises InvalidFile if it cannot be read."""
    path = folder / JOURNAL
    if not path.exists():
        return []
    try:
        trials = [read_record(Trial, json.loads(line)) for line in path.read_text().splitlines()]
        if [trial.trial for trial in trials] != list(range(len(trials))):
            raise ValueError("trials are missing")
    except (OSError, ValueError, RecursionError, TypeError) as error:
        raise InvalidFile(
            f"{path}: expected the journal of a tuning, got a file that cannot be read ({error}); remove it to run its "
            "trials again"
        ) from error
    return trials


class Search:
    """Proposes the settings to try next (Bergstra et al. 2011, "Algorithms for hyper-parameter optimization").

    It lives in memory and is rebuilt from the journal at each start. Optuna's own journal file would not be
    reproducible: it holds times of day, and trials that a kill left half reported.
    """

    def __init__(self, tuning: Tuning) -> None:
        optuna = expect_optuna()
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        sampler = optuna.samplers.TPESampler(
            seed=derived_seed("search", tuning.tune.seed), n_startup_trials=tuning.tune.together, constant_liar=True
        )
        self._optuna = optuna
        self._study = optuna.create_study(direction="maximize", sampler=sampler)
        self._space, self._distributions = tuning.space, distributions(tuning.space)
        self._first = first_settings(tuning.study, tuning.space)
        for settings in self._first:
            self._study.enqueue_trial(_mirrored(tuning.space, settings))
        self._running: list[Proposed] = []

    def ask(self, n: int) -> list[Settings]:
        """Propose the settings of the next `n` trials, before the result of any of them is known."""
        self._running = [self._study.ask(self._distributions) for _ in range(n)]
        proposed = [_mirrored(self._space, trial.params) for trial in self._running]
        # The first as they were written: converted there and back, 0.1 would be 0.09999999999999998.
        first = self._first[self._running[0].number :][:n]
        return first + proposed[len(first) :]

    def report(self, results: Sequence[Trial]) -> None:
        """Report the results of the trials proposed last, in the same order."""
        for trial, result in zip(self._running, results, strict=True):
            if result.state != "diverged":
                for chunks, mean in zip(result.chunks, result.means, strict=True):
                    trial.report(mean, chunks)
            if result.state == "complete":
                self._study.tell(trial, result.means[-1])
            else:
                # A diverged trial reports nothing, however it began, and so counts as the worst.
                self._study.tell(trial, state=self._optuna.trial.TrialState.PRUNED)


def importance_of(space: Space, results: Sequence[Trial]) -> dict[str, float]:
    """The share of each setting in the return after the first rung, the largest first; empty if trials cannot tell.

    By PED-ANOVA (Watanabe et al. 2023, arXiv:2304.10255); every trial that did not diverge has the first rung's return.
    """
    known = [result for result in results if result.state != "diverged"]
    if len(known) < FEWEST or len({result.means[0] for result in known}) < 2:
        return {}
    optuna = expect_optuna()
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.RandomSampler(seed=0))
    among = distributions(space)
    for result in known:
        params = _mirrored(space, result.settings)
        study.add_trial(optuna.trial.create_trial(params=params, distributions=among, value=result.means[0]))
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        # Most returns are equal: all trials are among the best tenth, and Optuna would give equal shares.
        warnings.filterwarnings("error", message="Target and region quantiles")
        try:
            shares = optuna.importance.get_param_importances(study, evaluator=evaluator, params=list(space))
        except UserWarning:
            return {}
    return {name: float(share) for name, share in sorted(shares.items(), key=lambda pair: (-pair[1], pair[0]))}


def distributions(space: Space) -> dict[str, BaseDistribution]:
    """The search as Optuna's distributions, in which a discount may be replaced by its distance from 1."""
    d: Any = expect_optuna().distributions
    found: dict[str, BaseDistribution] = {}
    for name, among in space.items():
        if not isinstance(among, Range):
            found[name] = d.CategoricalDistribution(among)
        elif isinstance(getattr(SAC(), name), int):
            found[name] = d.IntDistribution(int(among.low), int(among.high), log=among.log)
        elif _is_mirrored(name, among):
            found[name] = d.FloatDistribution(1 - among.high, 1 - among.low, log=True)
        else:
            found[name] = d.FloatDistribution(among.low, among.high, log=among.log)
    return found


def _mirrored(space: Space, settings: Settings) -> Settings:
    """Convert settings to Optuna's and back: a discount on a log scale is replaced by its distance from 1."""
    return {name: 1 - value if _is_mirrored(name, space[name]) else value for name, value in settings.items()}  # type: ignore[operator]


def _is_mirrored(name: str, among: Range | tuple[Value, ...]) -> bool:
    return name == "discount" and isinstance(among, Range) and among.log


def expect_optuna() -> Any:
    """Import Optuna; raises AnimatError if it is not installed."""
    return expect_extra("optuna", package="Optuna", extra="tune")
