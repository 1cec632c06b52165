"""What a culture could achieve at a task, before any training, and how well its responses determine that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from animat.arguments import checked_arguments
from animat.coding.mapping import Mapping, Thresholds
from animat.environment import Animat
from animat.errors import UnusableData, expect_at_least
from animat.evaluation.coupling import ContextGap, best_coupling, context_gap
from animat.evaluation.optimum import Optimum, best_returns, optimal_values
from animat.evaluation.rollouts import Uniform, roll_out
from animat.evaluation.statistics import CONFIDENCE, Interval, standard_error
from animat.neurons.simulator import HistogramSimulator, NeuronSimulator, fit_histogram, pooled_percentiles
from animat.neurons.timeline import SimulatorTimeline, fit_simulator
from animat.progress import Part, Progress, Silent
from animat.responses.condition import Condition
from animat.responses.quality.responses import FEW_SAMPLES
from animat.responses.responses import Responses
from animat.robots.base import Robot
from animat.robots.grid import Grid, grid_of_optimum
from animat.wrappers import ShuffledDelivery

RESAMPLES = 39
"""The smallest number whose extremes are the 2.5 and 97.5 % quantiles: the k-th of n lies at k / (n + 1)."""
COARSE, COARSE_SMOOTH = 0.5, 0.2
"""Steps along each axis of the grid for bootstrapped responses, as a share of the usual ones. The latter applies where
a command acts smoothly and never decides whether an episode ends: its quantiles are those of 0.5 within 0.1."""


@dataclass(frozen=True, eq=False)
class WellSampled:
    """Environment, simulator and responses with only the conditions that have enough responses for an optimal return.

    Attributes:
        left_out: the other conditions, with the number of their responses.
        fit: makes a simulator of bootstrapped responses.
    """

    environment: Animat[Any]
    simulator: NeuronSimulator
    responses: Responses
    left_out: tuple[str, ...]
    fit: Callable[[Responses], NeuronSimulator]

    @classmethod
    def of(cls, environment: Animat[Any], timeline: SimulatorTimeline, minute: float, percentiles: str) -> Self:
        """Select the conditions of one recording; `percentiles` as in `SimulatorTimeline.with_percentiles`."""
        responses, left_out = with_enough_samples(timeline.responses[timeline.row_at(minute)])
        simulator = timeline.with_percentiles(percentiles).at(minute)
        # The mapping's thresholds are those of all responses, even if some of them are left out.
        of_all, kind = simulator.percentiles, timeline.fitted["kind"]
        fitted = {name: timeline.fitted[name] for name in ("bins", "range_hz") if timeline.fitted.get(name) is not None}

        def fit(these: Responses, kind: str) -> NeuronSimulator:
            made = fit_simulator(these, kind=kind, **fitted)
            return replace(made, percentiles=of_all) if percentiles == "first" or left_out else made  # type: ignore[type-var]

        if left_out:
            environment, simulator = replace(environment, n_conditions=len(responses.conditions)), fit(responses, kind)
        # Memory hardly changes the optimum's uncertainty: the interval is computed without, in a sixth of the time.
        spread = "histogram" if simulator.has_memory else kind
        return cls(environment, simulator, responses, left_out, lambda these: fit(these, spread))

    def with_interval(
        self,
        optimum: Optimum,
        *,
        resolution: float = 1.0,
        resamples: int = RESAMPLES,
        seed: int = 1,
        progress: Progress | None = None,
    ) -> Optimum:
        """The optimum in this environment with what was left out, and its interval.

            low = v + min(q, -p, 0) - e,    high = v + max(p, 0) + e,    q, p: 2.5 and 97.5 % quantile of v_b - v_0

        with v the optimum, v_0 the same on a coarse grid, v_b that of responses bootstrapped, condition by condition,
        39 times, and e the grid's error. The lower end is the lower of those of the percentile and the reversed
        interval, as an optimum is the best of several values and few responses raise it. If conditions do not differ
        significantly (Kruskal-Wallis, p > 0.05), it reaches down to the return of random stimuli. Neither end is
        outside the range of possible returns. `resolution` is that of the optimum's grid; the coarse one is not finer.
        """
        from scipy.stats import kruskal

        optimum = replace(optimum, left_out=self.left_out)
        if not resamples:
            return optimum
        responses, rng = self.responses, np.random.default_rng(seed)
        drawn = [responses, *(responses.bootstrapped(rng) for _ in range(resamples))]
        cases = [(self.environment, self.fit(each)) for each in drawn]
        grid = _coarse(grid_of_optimum(self.environment.robot), resolution)
        values, (least, most) = optimal_values(cases, grid, seed, progress)
        low, high = np.quantile(values[1:] - values[0], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="weibull")
        low, high = min(low, -high, 0.0), max(high, 0.0)
        rates_hz = [responses.read_of(i) for i in range(len(responses.conditions))]
        is_flat = len(rates_hz) == 1 or np.ptp(np.concatenate(rates_hz)) == 0
        if is_flat or not kruskal(*rates_hz).pvalue <= 1 - CONFIDENCE:
            at_random = ShuffledDelivery(self.environment), cases[0][1]
            low = min(low, float(optimal_values([at_random], grid, seed)[0][0] - values[0]))
        error = optimum.grid_error
        ends = np.clip(optimum.value + np.array([low - error, high + error]), least, most)
        return replace(optimum, interval=Interval(optimum.value, float(ends[0]), float(ends[1])))


def with_enough_samples(responses: Responses) -> tuple[Responses, tuple[str, ...]]:
    """Responses to the conditions with 30 or more non-burst responses, and the other conditions, with their number.

    The best of several values is likely a lucky one: a few responses promise too much, and the optimum's interval is as
    wide as the range of returns (docs/evidence/optimal-return.md). UnusableData if none has 30.
    """
    n = [len(responses.rates_of(i)) for i in range(len(responses.conditions))]
    few = too_few(responses.conditions, n)
    if len(few) == len(n):
        most = f"at most {max(n, default=0)}: record more trials"
        raise UnusableData(f"responses: expected at least {FEW_SAMPLES} non-burst ones to some condition, got {most}")
    return responses.only([i for i, count in enumerate(n) if count >= FEW_SAMPLES]) if few else responses, few


def undersampled(responses: Responses) -> tuple[str, ...]:
    """The conditions with fewer than 30 non-burst responses, each with their number."""
    return too_few(responses.conditions, [len(responses.rates_of(i)) for i in range(len(responses.conditions))])


def too_few(conditions: Sequence[Condition], n: Sequence[int]) -> tuple[str, ...]:
    """The conditions with fewer than 30 non-burst responses, each with their number; n: of each condition."""
    return tuple(f"{c.label} ({count})" for c, count in zip(conditions, n, strict=True) if count < FEW_SAMPLES)


def _coarse(grid: Grid, resolution: float) -> Grid:
    """A grid with fewer steps, three commands instead of five, and no robot noise: only the responses differ."""
    smooth = None if grid.smooth_commands is None else min(grid.smooth_commands, 3)
    noise = None if grid.noise_in_command is None else 0.0
    resolution = min(COARSE if smooth is None else COARSE_SMOOTH, resolution)
    return replace(grid.scaled(resolution, periodic=True), smooth_commands=smooth, noise_in_command=noise)


@dataclass(frozen=True)
class OptimalReturn:
    """The achievable return with one mapping.

    Attributes:
        random: mean return of random stimuli.
        context: how much of it a coupling from sensors to stimuli leaves unused; None if `best` is too low to tell, as
            its own controller surpasses it.
    """

    robot: str
    mapping: str
    random: float
    random_standard_error: float
    best: Optimum
    context: ContextGap | None

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        context = None if self.context is None else self.context.to_dict()
        return vars(self) | {"best": self.best.to_dict(), "context": context}

    def to_text(self) -> str:
        """One line."""
        random = f"random {self.random:.1f} +- {self.random_standard_error:.1f}"
        context = "no context gap, as its controller surpasses it" if self.context is None else self.context.to_text()
        return f"{self.robot}, {self.mapping}: {random}; {self.best.to_text()}; {context}"


@checked_arguments
def optimal_returns(
    responses: Responses,
    robot: Robot[Any],
    mappings: Sequence[Mapping] = (Thresholds(1), Thresholds(9)),
    *,
    resolution: float = 0.75,
    episodes: int = 1000,
    resamples: int = RESAMPLES,
    seed: int = 1,
    progress: Progress | None = None,
) -> tuple[OptimalReturn, ...]:
    """What the culture of one recording could achieve at a robot's task, with several mappings.

    Args:
        responses: of the recording; the simulator is the default one, a histogram of 20 bins. Conditions with fewer
            than 30 non-burst responses are left out, also for the random stimuli.
        resolution: of the optimum's grid (`best_returns`); the default moves the cartpole's optima by at most 1.1.
        episodes: of random stimuli, of the best coupling, and of the optimum's controller.
        resamples: of the responses, for the optimum's interval (`WellSampled.with_interval`).
        seed: decides every random draw.
        progress: optima, their intervals, and couplings take about as long each.

    Raises UnusableData if no condition has 30 non-burst responses, and InvalidArgument for fewer than 0 resamples.
    """
    expect_at_least("resamples", resamples, 0)
    enough, left_out = with_enough_samples(responses)

    def fit(these: Responses) -> HistogramSimulator:
        simulator = fit_histogram(these)
        # The mapping's thresholds are those of all responses, even if some of them are left out.
        return replace(simulator, percentiles=pooled_percentiles(responses)) if left_out else simulator

    simulator, n = fit(enough), len(mappings)
    cases = [(Animat(robot, mapping, len(enough.conditions)), simulator) for mapping in mappings]
    solving, resampling, searching = (Part(progress or Silent(), third, 1, 3) for third in range(3))
    options: dict[str, Any] = {"resolution": resolution, "seed": seed}
    best = list(best_returns(cases, episodes=episodes, progress=solving, **options))
    for i, case in enumerate(cases):
        of_case = WellSampled(*case, enough, left_out, fit)
        best[i] = of_case.with_interval(best[i], resamples=resamples, progress=Part(resampling, i, 1, n), **options)
    optima: list[OptimalReturn] = []
    for mapping, case, optimum in zip(mappings, cases, best, strict=True):
        random = roll_out(*case, Uniform(), episodes=episodes, seed=seed).returns[0]
        coupling = best_coupling(*case, seed=seed, progress=Part(searching, len(optima), 1, n))
        of_coupling = roll_out(*case, coupling, episodes=episodes, seed=seed).returns[0]
        context = None if optimum.is_surpassed else context_gap(of_coupling, random, optimum)
        optima.append(
            OptimalReturn(robot.name, mapping.name, float(random.mean()), standard_error(random), optimum, context)
        )
    return tuple(optima)
