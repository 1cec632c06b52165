"""A study's policies against the heuristic policy: whether learning did more than a formula."""

from __future__ import annotations

from collections.abc import Iterator

from animat.evaluation.statistics import compare_episodes, is_worse
from animat.report.results import HeuristicComparison, Results
from animat.studies.episodes import POLICY, DataFrame, mean_returns, rows_where
from animat.studies.evaluating import is_usual
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
                yield HeuristicComparison(spec.name, arm.name, at_min, *means, found.p, found.wins, outcome)


def not_outperforming(results: Results) -> list[str]:
    """A sentence for each row whose policies do not outperform the heuristic policy."""
    return [
        f"{row.robot}, {row.arm}, at {row.at_min:g} min: the policies do not outperform the heuristic policy "
        f"({row.mean_return:.1f} against {row.heuristic:.1f}; p = {row.p:.2g} over episodes"
        f"{'; they are worse' if is_worse(row.p, row.wins) else ''})"
        for row in results.heuristic
        if row.outcome == NOT
    ]
