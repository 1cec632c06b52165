"""What studies come to, as typed records: tables, figures and the page are made of them."""

from __future__ import annotations

from dataclasses import dataclass

from animat.evaluation.optimum import bracket_findings
from animat.recordings.findings import Finding

TRAINED = "trained: "
"""In front of an arm's name among the controls."""
CONTEXT_GAP_LEVEL = 0.5
"""The context gap of a task that needs more than a reflex, on every culture."""


@dataclass(frozen=True)
class StudyOptimum:
    """The optimal return on a robot, as in `animat.evaluation.optimum.Optimum`; None for what is not known.

    Attributes:
        at_min: the recording that answers.
        low_95, high_95: of the interval that few responses leave.
        left_out: the conditions that have too few responses to count, with their number.
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

    def findings(self) -> tuple[Finding, ...]:
        """Where the value and its controller's return part."""
        known = (self.best_return, self.grid_error, self.monte_carlo, self.standard_error)
        told = [value for value in known if value is not None]
        return bracket_findings(*told) if len(told) == len(known) else ()


@dataclass(frozen=True)
class Score:
    """An arm at a minute: means over policies, beside random actions and the optimum."""

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
    """Two arms on a robot: the test, its outcome, and the paper's where it printed one."""

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
    """A control, or trained policies beside it, at a minute."""

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
    """Trained policies beside the heuristic policy: mean returns, Mann-Whitney over episodes, share of pairs won."""

    robot: str
    arm: str
    at_min: float
    mean_return: float
    heuristic: float
    p: float
    wins: float
    outcome: str


@dataclass(frozen=True)
class ReflexComparison:
    """Trained policies beside the best coupling, as in `animat.evaluation.coupling`; None for what is not known.

    Attributes:
        coupling: its mean return.
        gap: the context gap of the task, with the ends of its 95 % interval.
        needs_context: whether the task surely needs more than a reflex.
        score: the context score of the policies, with the ends of its 95 % interval.
    """

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
    """How far episodes of an arm's policies or of a control met an objective of a robot's goal, and all of the goal.

    Attributes:
        success_share, margin: of the goal, the same for all of its objectives.
        objective: as a text.
        satisfaction: of the objective, %.
    """

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
    """All that was found."""

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
        cultures: how many.
        mean_first, mean_second: mean returns of the arms, each culture counting the same.
        difference: mean of the cultures' differences, second less first.
        low_95, high_95: of its percentile bootstrap over cultures; None of fewer than two. Of few cultures it is too
            narrow.
        larger_in: cultures in which the second arm's mean return is the larger one.
        holds_in: cultures in which the second arm was found to be better.
        tested: cultures with enough policies that a difference could be found.
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
        """In how many cultures the second arm was found to be better, in words."""
        return f"{self.holds_in} of {self.tested}" if self.tested else "too few policies"


@dataclass(frozen=True)
class ContextRow:
    """A task on a culture: mean returns on the simulator and, measured, on the culture; None for what is not known.

    Attributes:
        best_known: where there is no optimal return, that of the best of the policies and the heuristic.
        gap, score: the context gap of the task and the context score of the policies, on the simulator; the least that
            they can be where there is no optimal return.
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
        """Whether gap and score are the least that they can be."""
        return self.best_known is not None

    @property
    def needs_context(self) -> bool:
        """Whether a reflex leaves half of the task undone."""
        return self.gap is not None and self.gap >= CONTEXT_GAP_LEVEL

    @property
    def has_context(self) -> bool:
        """Whether the policies do more than the best reflex: the whole interval of their score is above 0."""
        return self.score_low_95 is not None and self.score_low_95 > 0


@dataclass(frozen=True)
class LostRow:
    """What the policies lose by an intervention, with its 95 % interval over policies, on a culture's simulator."""

    culture: int
    robot: str
    intervention: str
    mean_return: float
    lost: float
    lost_low_95: float | None
    lost_high_95: float | None
