"""The search itself: Optuna's tree-structured Parzen estimator, told in order, and which settings mattered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from animat.extras import expect_extra
from animat.studies.task import draw_seed
from animat.training.settings import SAC
from animat.tuning.journal import Told
from animat.tuning.space import Range, Settings, Space, Value, first_settings
from animat.tuning.specification import Tuning

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial

FEWEST = 4
"""Trials from which is told which settings mattered."""


class Search:
    """Which settings to try next (Bergstra et al. 2011, "Algorithms for hyper-parameter optimization").

    It is in memory, and made again from the journal at each start. Optuna's own journal file would hold times of day,
    and trials that a kill had left half told: it would not be the same twice.
    """

    def __init__(self, tuning: Tuning) -> None:
        optuna = expect_optuna()
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        sampler = optuna.samplers.TPESampler(
            seed=draw_seed("search", tuning.tune.seed), n_startup_trials=tuning.tune.together, constant_liar=True
        )
        self._optuna = optuna
        self._study = optuna.create_study(direction="maximize", sampler=sampler)
        self._space, self._distributions = tuning.space, distributions(tuning.space)
        for settings in first_settings(tuning.study, tuning.space):
            self._study.enqueue_trial(_mirrored(tuning.space, settings))
        self._running: list[Trial] = []

    def ask(self, n: int) -> list[Settings]:
        """Settings of the next trials, before any of them is known."""
        self._running = [self._study.ask(self._distributions) for _ in range(n)]
        return [_mirrored(self._space, trial.params) for trial in self._running]

    def tell(self, told: Sequence[Told]) -> None:
        """What the trials that were asked for last got, in the same order."""
        states = self._optuna.trial.TrialState
        for trial, each in zip(self._running, told, strict=True):
            if each.state != "diverged":
                for chunks, mean in zip(each.chunks, each.means, strict=True):
                    trial.report(mean, chunks)
            if each.state == "complete":
                self._study.tell(trial, each.means[-1])
            else:
                # One that diverged reports nothing, however it began, and is then the worst of all.
                self._study.tell(trial, state=states.PRUNED)


def importance_of(space: Space, told: Sequence[Told]) -> dict[str, float]:
    """The share of each setting in what trials got after the first rung, the largest first; nothing of a few trials.

    By PED-ANOVA (Watanabe et al. 2023, arXiv:2304.10255). All trials that did not diverge were run until there; of
    those that were stopped no more is known.
    """
    known = [each for each in told if each.state != "diverged"]
    if len(known) < FEWEST or len({each.means[0] for each in known}) < 2:
        return {}
    optuna = expect_optuna()
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.RandomSampler(seed=0))
    among = distributions(space)
    for each in known:
        params = _mirrored(space, each.settings)
        study.add_trial(optuna.trial.create_trial(params=params, distributions=among, value=each.means[0]))
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    shares = optuna.importance.get_param_importances(study, evaluator=evaluator, params=list(space))
    return {name: float(share) for name, share in sorted(shares.items(), key=lambda pair: (-pair[1], pair[0]))}


def distributions(space: Space) -> dict[str, BaseDistribution]:
    """The search in Optuna's words, where a discount may stand for its distance from 1."""
    return {name: _distribution(name, among) for name, among in space.items()}


def _mirrored(space: Space, settings: Settings) -> Settings:
    """Settings as Optuna has them, and back: a discount that is searched in its logarithm is its distance from 1."""
    return {name: 1 - value if _is_mirrored(name, space[name]) else value for name, value in settings.items()}  # type: ignore[operator]


def _is_mirrored(name: str, among: Range | tuple[Value, ...]) -> bool:
    return name == "discount" and isinstance(among, Range) and among.log


def _distribution(name: str, among: Range | tuple[Value, ...]) -> BaseDistribution:
    d: Any = expect_optuna().distributions
    if not isinstance(among, Range):
        made: BaseDistribution = d.CategoricalDistribution(among)
        return made
    if isinstance(asdict(SAC())[name], int):
        made = d.IntDistribution(int(among.low), int(among.high), log=among.log)
    elif _is_mirrored(name, among):
        made = d.FloatDistribution(1 - among.high, 1 - among.low, log=True)
    else:
        made = d.FloatDistribution(among.low, among.high, log=among.log)
    return made


def expect_optuna() -> Any:
    """Optuna, which is imported nowhere else; raises AnimatError if it is not installed."""
    return expect_extra("optuna", package="Optuna", extra="tune", what="tuning")
