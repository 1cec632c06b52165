"""The results of studies as typed records, from which tables, figures and the page are made."""

from __future__ import annotations

import math
from dataclasses import dataclass

from animat.evaluation.optimum import Optimum
from animat.recordings.findings import Finding

TRAINED = "trained: "
"""Precedes an arm's name among the controls."""
CONTEXT_GAP_LEVEL = 0.5
"""The context gap from which a reflex leaves half of a task undone."""


@dataclass(frozen=True)
class StudyOptimum:
    """The optimal return on a robot, as in `animat.evaluation.optimum.Optimum`; None for unknown values.

    Attributes:
        at_min: the recording whose simulator responds.
        low_95, high_95: ends of the interval due to the number of responses.
        left_out: the conditions that have too few responses, with their number.
    """

    robot: str
    mapping: str
    percentiles: str
    at_min: float
    best_return: float | None
    low_95: float | None
    high_95: float | None
    grid_error: float | None
    monte_carlo: float | None
    standard_error: float | None
    without_clock: float | None
    without_clock_standard_error: float | None
    nodes: int | None
    left_out: str | None

    @property
    def known(self) -> Optimum | None:
        """The optimum with NaN for unknown numbers; None without a value."""
        if self.best_return is None or self.grid_error is None:
            return None
        runs = self.monte_carlo, self.standard_error, self.without_clock, self.without_clock_standard_error
        timed, its_error, untimed, error = (math.nan if each is None else each for each in runs)
        return Optimum(self.best_return, self.grid_error, timed, its_error, untimed, error, 0, self.nodes or 0)

    @property
    def is_surpassed(self) -> bool:
        """`Optimum.is_surpassed`."""
        return self.known is not None and self.known.is_surpassed

    def findings(self) -> tuple[Finding, ...]:
        """A finding if the value and the better return of its controller differ."""
        return () if self.known is None else self.known.findings()


@dataclass(frozen=True)
class Score:
    """An arm at a minute: means over policies, with random actions and the optimum."""

    robot: str
    arm: str
    mapping: str
    at_min: float
    policies: int
    episodes: int
    mean_return: float
    standard_deviation: float | None
    interquartile_mean: float
    low_95: float | None
    high_95: float | None
    random: float | None
    optimum: float | None
    normalised_score: float | None


@dataclass(frozen=True)
class ComparedReturns:
    """Two arms on a robot: the test, its outcome, and the paper's result if it printed one."""

    comparison: str
    robot: str
    first: str
    second: str
    at_min: float
    episodes: int
    n: int
    mean_first: float
    mean_second: float
    score_first: float | None
    score_second: float | None
    random_second: float | None
    optimum_first: float | None
    optimum_second: float | None
    optimum_error_first: float | None
    optimum_error_second: float | None
    u: float
    p_normal: float
    p_exact: float
    p_holm: float
    effect: float
    effect_low_95: float
    effect_high_95: float
    outcome: str
    paper_u: float | None
    paper_p: float | None
    as_in_paper: str | None


@dataclass(frozen=True)
class ControlReturns:
    """A control, or trained policies with the same mapping, at a minute."""

    robot: str
    mapping: str
    percentiles: str
    at_min: float
    control: str
    actors: int
    mean_return: float
    standard_error: float | None
    random: float | None
    optimum: float | None
    normalised_score: float | None


@dataclass(frozen=True)
class HeuristicComparison:
    """Trained policies and the heuristic policy: mean returns, Mann-Whitney over episodes, share of pairs won.

    `p` is approximate; `p_exact`, which then decides, is None for many episodes.
    """

    robot: str
    arm: str
    at_min: float
    mean_return: float
    heuristic: float
    p: float
    wins: float
    outcome: str
    p_exact: float | None = None

    @property
    def p_best(self) -> float:
        """The p that decides, as in `animat.evaluation.statistics.EpisodeComparison`."""
        return self.p if self.p_exact is None else self.p_exact


@dataclass(frozen=True)
class ReflexComparison:
    """Trained policies and the best coupling, with context gap and score (`ContextGap`); None for unknown values."""

    robot: str
    arm: str
    at_min: float
    coupling: float
    coupling_standard_error: float | None
    optimum: float
    gap: float | None
    gap_low_95: float | None
    gap_high_95: float | None
    needs_context: bool
    score: float | None
    score_low_95: float | None
    score_high_95: float | None


@dataclass(frozen=True)
class ObjectiveMet:
    """How far an arm's policies or a control met an objective of a robot (`satisfaction`, %), and its whole goal."""

    robot: str
    arm: str
    agent: str
    at_min: float
    episodes: int
    success_share: float
    margin: float
    objective: str
    satisfaction: float


@dataclass(frozen=True)
class Results:
    """All results of a study."""

    scores: tuple[Score, ...]
    comparisons: tuple[ComparedReturns, ...]
    controls: tuple[ControlReturns, ...]
    heuristic: tuple[HeuristicComparison, ...]
    optima: tuple[StudyOptimum, ...]
    findings: tuple[Finding, ...]
    goals: tuple[ObjectiveMet, ...] = ()
    reflexes: tuple[ReflexComparison, ...] = ()


@dataclass(frozen=True)
class OverCultures:
    """A comparison on a robot, over cultures.

    Attributes:
        mean_first, mean_second: mean returns of the arms, each culture counting the same.
        difference: mean of the cultures' differences, second minus first.
        low_95, high_95: its interval over cultures, by Student's t; None with fewer than two.
        larger_in, holds_in: numbers of cultures in which the second arm's mean return is larger, and significantly so.
        tested: number of cultures with enough policies to find a difference.
    """

    comparison: str
    robot: str
    cultures: int
    mean_first: float
    mean_second: float
    difference: float
    low_95: float | None
    high_95: float | None
    larger_in: int
    holds_in: int
    tested: int

    @property
    def found_better(self) -> str:
        """In how many cultures the second arm was found to be better, as text."""
        return f"{self.holds_in} of {self.tested}" if self.tested else "too few policies"


@dataclass(frozen=True)
class ContextRow:
    """A task on a culture: mean returns on the simulator, and measured on the culture; None for unknown values.

    Attributes:
        best_known: if there is no optimal return, that of the best of the policies and the heuristic.
        gap, score: the context gap of the task and the policies' context score on the simulator; may be lower bounds.
        bits: goal information; None for a robot with only one goal.
    """

    culture: int
    robot: str
    random: float
    heuristic: float | None
    coupling: float | None
    policies: float
    optimum: float | None
    best_known: float | None
    gap: float | None
    gap_low_95: float | None
    gap_high_95: float | None
    score: float | None
    score_low_95: float | None
    score_high_95: float | None
    bits: float | None
    measured_random: float | None
    measured_heuristic: float | None
    measured_coupling: float | None
    measured_policies: float | None
    predicted_policies: float

    @property
    def is_least(self) -> bool:
        """Whether gap and score are lower bounds."""
        return self.best_known is not None

    @property
    def leaves_half(self) -> bool:
        """Whether a reflex leaves half of the task or more undone."""
        return self.gap is not None and self.gap >= CONTEXT_GAP_LEVEL

    @property
    def has_context(self) -> bool:
        """Whether the policies do more than the best reflex: the whole interval of their score is above 0."""
        return self.score_low_95 is not None and self.score_low_95 > 0


@dataclass(frozen=True)
class LostRow:
    """The return that policies lose by an intervention on a culture's simulator, with its 95 % interval over them."""

    culture: int
    robot: str
    intervention: str
    mean_return: float
    lost: float
    lost_low_95: float | None
    lost_high_95: float | None
