"""A study's policies against the best coupling: gap and score follow their formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from animat.report.results import ReflexComparison, StudyOptimum
from animat.studies.episodes import COUPLING, RANDOM, episode_rows
from animat.studies.outperforming import compare_with_reflex, describe_reflexes
from animat.studies.specification import Arm, RobotSpec, Study
from test_study_results import episodes_of

STUDY = Study(robots=(RobotSpec("cartpole"),), arms=(Arm("taught"), Arm("control", delivery="shuffled")))
POLICIES = np.array([[80.0, 90.0], [100.0, 96.0], [70.0, 74.0]])
RANDOMS = np.array([[-80.0, -90.0, -85.0, -81.0]])


def optimum(**changed: object) -> StudyOptimum:
    known: dict[str, object] = {"best_return": 110.0, "grid_error": 0.5, "left_out": None}
    none = ("low_95", "high_95", "monte_carlo", "standard_error", "without_clock", "without_clock_standard_error")
    return StudyOptimum("cartpole", "1-threshold", "moving", 0.0, nodes=None, **dict.fromkeys(none), **known | changed)  # type: ignore[arg-type]


def found(coupled: np.ndarray, *optima: StudyOptimum) -> list[ReflexComparison]:
    returns_of = {"policy": POLICIES, RANDOM: RANDOMS, COUPLING: coupled}
    table = pd.concat(
        episode_rows(
            episodes_of(returns),
            robot="cartpole",
            arm="taught" if agent == "policy" else "1-threshold",
            agent=agent,
            at_min=0.0,
        )
        for agent, returns in returns_of.items()
    )
    return list(compare_with_reflex(STUDY, table, STUDY.robots[0], optima))


def test_gap_and_score_are_those_of_the_formulas() -> None:
    coupled = np.array([[40.0, 50.0, 45.0, 41.0, 49.0]])
    (row,) = found(coupled, optimum())
    assert row.arm == "taught" and row.needs_context
    # Errors of a ratio by its partial derivatives, in quadrature.
    span = 110 - RANDOMS.mean()
    gap = (110 - 45) / span
    errors = np.array([stats.sem(coupled[0]), gap * stats.sem(RANDOMS[0]), (1 - gap) * 0.5 / 1.96]) * 1.96 / span
    ends = row.gap, row.gap_low_95, row.gap_high_95
    assert ends == pytest.approx((gap, gap - np.linalg.norm(errors), gap + np.linalg.norm(errors)), rel=1e-4)
    means = POLICIES.mean(axis=1)
    score = (means.mean() - 45) / (110 - 45)
    parts = [
        stats.t.ppf(0.975, 2) * stats.sem(means),
        1.96 * (1 - score) * stats.sem(coupled[0]),
        score * 0.5,
    ]
    wide = np.linalg.norm(parts) / 65
    ends = row.score, row.score_low_95, row.score_high_95
    assert ends == pytest.approx((score, score - wide, score + wide), rel=1e-4)


def test_a_task_that_a_reflex_does_has_no_score() -> None:
    (row,) = found(np.array([[109.0, 111.0, 110.0]]), optimum())
    assert not row.needs_context and row.score is None
    assert row.gap == pytest.approx(0.0)
    returned = row.coupling
    assert list(describe_reflexes([row])) == [
        f"cartpole, taught, at 0 min: the best reflex returns {returned:.1f}; the task needs no more than that."
    ]
    (unsure,) = describe_reflexes([replace(row, gap_high_95=0.06)])
    assert unsure.endswith("; whether the task needs more is not known.")


@pytest.mark.parametrize("known", [[], [optimum(left_out="5 Hz: 3")], [optimum(best_return=None)]])
def test_without_the_optimum_of_all_conditions_there_is_no_row(known: list[StudyOptimum]) -> None:
    assert found(np.array([[40.0, 50.0]]), *known) == []


def test_gap_and_score_are_reported_in_a_sentence() -> None:
    (sentence,) = describe_reflexes(found(np.array([[45.0, 45.0]]), optimum()))
    assert sentence == (
        "cartpole, taught, at 0 min: the best reflex returns 45.0; the task needs more; "
        "the policies' context score is 0.62."
    )
