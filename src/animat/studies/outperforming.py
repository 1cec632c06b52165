"""A study's policies against the heuristic policy, a formula, and the best coupling, a reflex: whether they do more."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain

from animat.errors import counted
from animat.evaluation.coupling import REFLEX_GAP, context_gap
from animat.evaluation.statistics import Interval, compare_episodes, is_worse
from animat.report.results import HeuristicComparison, ReflexComparison, Results, StudyOptimum
from animat.studies.episodes import COUPLING, POLICY, RANDOM, DataFrame, mean_returns, rows_where
from animat.studies.evaluating import is_usual
from animat.studies.optima import complete_optima, key_of
from animat.studies.specification import RobotSpec, Study, mapping_label

HEURISTIC = "heuristic"
OUTPERFORM, NOT, TOO_FEW = "outperform it", "do not outperform it", "too few episodes to tell"


def compare_with_heuristic(study: Study, table: DataFrame, spec: RobotSpec) -> Iterator[HeuristicComparison]:
    """Compare each arm that `is_usual` at each minute at which the heuristic was run too; `table` is of episodes."""
    at = rows_where(table, robot=spec.name, over_time=False)
    for arm in filter(is_usual, study.arms):
        heuristic = rows_where(at, arm=mapping_label(*arm.kind), agent=HEURISTIC).groupby("at_min")["return"]
        heuristic_returns = {at_min: returns.to_numpy() for at_min, returns in heuristic}
        for at_min, episodes in rows_where(at, arm=arm.name, agent=POLICY).groupby("at_min"):
            if at_min in heuristic_returns:
                found = compare_episodes(episodes["return"].to_numpy(), heuristic_returns[at_min])
                outcome = (OUTPERFORM if found.is_outperformed else NOT) if found.has_enough_episodes else TOO_FEW
                # The mean of the policies' means, as in the scores: another order of summation can round differently.
                means = float(mean_returns(episodes).mean()), float(heuristic_returns[at_min].mean())
                yield HeuristicComparison(
                    spec.name, arm.name, at_min, *means, found.p, found.wins, outcome, found.p_exact
                )


def not_outperforming(results: Results) -> list[str]:
    """A sentence for each row whose policies do not outperform the heuristic policy."""
    return [
        f"{row.robot}, {row.arm}, at {row.at_min:g} min: the policies do not outperform the heuristic policy "
        f"({row.mean_return:.1f} against {row.heuristic:.1f}; p = {row.p_best:.2g} over episodes"
        f"{'; they are worse' if is_worse(row.p_best, row.wins) else ''})"
        for row in results.heuristic
        if row.outcome == NOT
    ]


def not_outperforming_over(cultures: Iterable[Results]) -> list[str]:
    """The same over cultures: in how many of those that were compared the policies do not outperform it."""
    outcomes: dict[tuple[str, str, float], list[str]] = {}
    for row in chain.from_iterable(results.heuristic for results in cultures):
        if row.outcome != TOO_FEW:
            outcomes.setdefault((row.robot, row.arm, row.at_min), []).append(row.outcome)
    return [
        f"{robot}, {arm}, at {at_min:g} min: the policies do not outperform the heuristic policy in "
        f"{found.count(NOT)} of {counted(len(found), 'culture')}"
        for (robot, arm, at_min), found in outcomes.items()
        if NOT in found
    ]


def compare_with_reflex(
    study: Study, table: DataFrame, spec: RobotSpec, optima: Iterable[StudyOptimum]
) -> Iterator[ReflexComparison]:
    """Compare each arm that `is_usual` at the minute at which the best coupling was run; `table` is of episodes.

    Without an optimal return over all conditions, or if its own controller surpasses it, there is no context gap, and
    hence no row.
    """
    at = rows_where(table, robot=spec.name, over_time=False)
    known = complete_optima(each for each in optima if each.robot == spec.name)
    for arm in filter(is_usual, study.arms):
        controls = rows_where(at, arm=mapping_label(*arm.kind))
        for at_min, coupled in rows_where(controls, agent=COUPLING).groupby("at_min")["return"]:
            best = known.get(key_of(arm, at_min))
            policies = rows_where(at, arm=arm.name, agent=POLICY, at_min=at_min)
            if best is None or best.is_surpassed or (optimum := best.known) is None:
                continue
            random = rows_where(controls, agent=RANDOM, at_min=at_min)["return"].to_numpy()
            context = context_gap(coupled.to_numpy(), random, optimum)
            yield ReflexComparison(
                spec.name,
                arm.name,
                at_min,
                context.coupling,
                context.standard_error if len(coupled) > 1 else None,
                optimum.value,
                *_ends(context.gap),
                context.needs_context,
                *_ends(context.score(mean_returns(policies), optimum)),
            )


def describe_reflexes(rows: Iterable[ReflexComparison]) -> Iterator[str]:
    """A sentence for each row whose gap is known."""
    for row in (row for row in rows if row.gap is not None):
        if row.needs_context:
            score = "" if row.score is None else f"; the policies' context score is {row.score:.2f}"
            needs = f"the task needs more{score}"
        elif row.gap_high_95 is not None and row.gap_high_95 <= REFLEX_GAP:
            needs = "the task needs no more than that"
        else:
            needs = "whether the task needs more is not known"
        where = f"{row.robot}, {row.arm}, at {row.at_min:g} min"
        yield f"{where}: the best reflex returns {row.coupling:.1f}; {needs}."


def _ends(interval: Interval | None) -> tuple[float | None, float | None, float | None]:
    return (None, None, None) if interval is None else (interval.value, interval.low, interval.high)
