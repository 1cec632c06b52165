"""What a culture could achieve at a task, before any training: the optimal return and that of random stimuli."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from animat.arguments import checked_arguments
from animat.coding.mapping import Mapping, Thresholds
from animat.environment import Animat
from animat.evaluation.coupling import ContextGap, best_coupling, context_gap
from animat.evaluation.optimum import Optimum, best_returns
from animat.evaluation.resampling import RESAMPLES, WellSampled, with_enough_samples
from animat.evaluation.rollouts import Uniform, roll_out
from animat.evaluation.statistics import standard_error
from animat.neurons.simulator import HistogramSimulator, fit_histogram, pooled_percentiles
from animat.progress import Part, Progress, Silent
from animat.responses.responses import Responses
from animat.robots.base import Robot


@dataclass(frozen=True)
class OptimalReturn:
    """The achievable return with one mapping.

    Attributes:
        random: mean return of random stimuli.
        best: the optimal return of any controller.
        context: how much of it a coupling from sensors to stimuli leaves unused.
    """

    robot: str
    mapping: str
    random: float
    random_standard_error: float
    best: Optimum
    context: ContextGap

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        return vars(self) | {"best": self.best.to_dict(), "context": self.context.to_dict()}

    def to_text(self) -> str:
        """One line."""
        random = f"random {self.random:.1f} +- {self.random_standard_error:.1f}"
        return f"{self.robot}, {self.mapping}: {random}; {self.best.to_text()}; {self.context.to_text()}"


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
        progress: what to report to; optima, their intervals, and couplings take about as long each.

    Raises:
        UnusableData: if no condition has 30 non-burst responses.
    """
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
        gap = context_gap(of_coupling, random, optimum)
        optima.append(
            OptimalReturn(robot.name, mapping.name, float(random.mean()), standard_error(random), optimum, gap)
        )
    return tuple(optima)
