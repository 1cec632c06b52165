"""A study's policies against the best coupling: whether a task needs more than a reflex, and if policies do more."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from animat.evaluation.coupling import REFLEX_GAP, context_gap
from animat.evaluation.optimum import Optimum
from animat.evaluation.statistics import Interval
from animat.report.results import ReflexComparison, StudyOptimum
from animat.studies.episodes import COUPLING, POLICY, RANDOM, DataFrame, mean_returns
from animat.studies.evaluating import is_usual
from animat.studies.specification import RobotSpec, Study, mapping_label


def compare_with_reflex(
    study: Study, table: DataFrame, spec: RobotSpec, optima: Iterable[StudyOptimum]
) -> Iterator[ReflexComparison]:
    """Compare each arm that `is_usual` at the minute at which the best coupling was run; `table` is of episodes.

    Without an optimal return over all conditions there is no context gap, and hence no row.
    """
    at = table[(table["robot"] == spec.name) & ~table["over_time"]]
    known = {
        (each.mapping, each.percentiles, each.at_min): each
        for each in optima
        if each.robot == spec.name and each.left_out is None and each.best_return is not None
    }
    for arm in filter(is_usual, study.arms):
        of = at[at["arm"] == mapping_label(*arm.kind)]
        for at_min, coupled in of[of["agent"] == COUPLING].groupby("at_min")["return"]:
            best = known.get((*arm.kind, at_min))
            policies = at[(at["arm"] == arm.name) & (at["agent"] == POLICY) & (at["at_min"] == at_min)]
            if best is None or not len(policies):
                continue
            random = of[(of["agent"] == RANDOM) & (of["at_min"] == at_min)]["return"].to_numpy()
            nan = float("nan")
            optimum = Optimum(best.best_return or 0.0, best.grid_error or 0.0, nan, nan, nan, nan, 0, 0)
            context = context_gap(coupled.to_numpy(), random, optimum)
            gap, score = context.gap, context.score(mean_returns(policies), optimum)
            yield ReflexComparison(
                spec.name,
                arm.name,
                at_min,
                context.coupling,
                context.standard_error if len(coupled) > 1 else None,
                optimum.value,
                *_ends(gap),
                context.needs_context,
                *_ends(score),
            )


def describe_reflexes(rows: Iterable[ReflexComparison]) -> list[str]:
    """A sentence for each row whose gap is known."""
    sentences = []
    for row in rows:
        if row.gap is None:
            continue
        where = f"{row.robot}, {row.arm}, at {row.at_min:g} min: the best reflex returns {row.coupling:.1f}"
        if not row.needs_context:
            is_known = row.gap_high_95 is not None and row.gap_high_95 <= REFLEX_GAP
            more = "the task needs no more than that" if is_known else "whether the task needs more is not known"
            sentences.append(f"{where}; {more}.")
        else:
            score = "" if row.score is None else f"; the policies' context score is {row.score:.2f}"
            sentences.append(f"{where}; the task needs more{score}.")
    return sentences


def _ends(interval: Interval | None) -> tuple[float | None, float | None, float | None]:
    return (None, None, None) if interval is None else (interval.value, interval.low, interval.high)
