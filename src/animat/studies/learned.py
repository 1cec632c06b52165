"""Learning as good as the optimum allows: how arms that are trained on one recording do on that very one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from animat.report.html import Table, columns_of, table_of, with_error
from animat.report.results import Score
from animat.studies.specification import RobotSpec, Study
from animat.studies.tabulating import AIM


def learned_of(study: Study, scores: Sequence[Score]) -> list[Score]:
    """Of the table of scores, the rows of arms on the one recording that they were trained on, the first."""
    learned = {arm.name for arm in study.arms if arm.learns_one_recording}
    first: dict[tuple[str, str], Score] = {}
    for row in scores:
        if row.arm in learned:
            known = first.setdefault((row.robot, row.arm), row)
            if row.at_min < known.at_min:
                first[row.robot, row.arm] = row
    return list(first.values())


def beside_the_optimum(study: Study, rows: Sequence[Score]) -> Table:
    """Scores beside `AIM`, with what is known of the difference."""
    bodies = {spec.name: spec for spec in study.robots}

    def mean_with_error(row: Score) -> str:
        spread = row.standard_deviation
        return with_error(row.mean_return, None if spread is None else spread / math.sqrt(row.policies))

    return table_of(
        f"As good as the optimum: scores on the simulator trained on, beside {AIM:g}",
        rows,
        [
            *columns_of("robot", "arm", "mapping"),
            ("at (min)", "at_min"),
            ("mean ± s.e.", mean_with_error),
            *columns_of("random", "optimum"),
            ("run", "optimum_run"),
            ("without clock", "optimum_without_clock"),
            ("score", "normalised_score"),
            ("of without clock", "score_without_clock"),
            ("what is known", lambda row: known_of(row, bodies[row.robot])),
        ],
        note="Run: the return that the optimum's controller was seen to get. Without clock: what the same controller "
        "gets if it does not know the time left, as policies do not; a better one may exist, not above the optimum. Of "
        "without clock: the score with this in place of the optimum.",
        beside="tables/scores.csv",
        marked=tuple(i for i, row in enumerate(rows) if (row.normalised_score or 0.0) < AIM),
    )


def known_of(row: Score, spec: RobotSpec) -> str:
    """What is known of a score: that it is reached, or what stands between it and the optimum."""
    score, without_clock = row.normalised_score, row.score_without_clock
    if row.optimum is None:
        return "no optimum: conditions with few responses are left out of it"
    if score is None:
        return "nothing to learn: the optimum is not above random actions"
    if score >= AIM:
        return "reached"
    run, random = row.optimum_run, row.random
    if run is not None and random is not None and (row.mean_return - random) >= AIM * (run - random):
        return f"short of the optimum, not of what its controller was seen to get ({run:.1f})"
    if without_clock is not None and without_clock >= AIM:
        return "short by the clock: reached against the same controller without knowing the time left"
    known = f"short by {AIM - score:.2f}, which neither the clock nor the grid explains"
    usual = spec.robot().paper_iterations
    if spec.trained_for < usual:
        known += f"; trained for {spec.trained_for:,} iterations, not {usual:,}"
    return known
