"""How a study compares its policies with the heuristic policy, for returns whose order is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import mannwhitneyu

from animat.evaluation.rollouts import Episodes
from animat.report.results import Results
from animat.studies.episodes import RANDOM, episode_rows
from animat.studies.outperforming import HEURISTIC, NOT, OUTPERFORM, TOO_FEW, compare_with_heuristic, not_outperforming
from animat.studies.report_tables import heuristic_table
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.tabulating import performances


def test_policies_that_do_not_outperform_the_heuristic_are_named() -> None:
    spec, arm = RobotSpec("cartpole"), Arm("1 threshold")
    without = Arm("without neurons", mapping="none", trained=False)
    study = Study(robots=(spec,), arms=(arm, without))
    rng = np.random.default_rng(1)
    minutes = {0.0: (30, 50.0), 10.0: (30, 0.0), 20.0: (30, -50.0), 30.0: (2, 50.0)}
    parts, ours, theirs = [], {}, {}
    for at_min, (episodes, by) in minutes.items():
        ours[at_min], theirs[at_min] = rng.normal(by, 10, (2, episodes)), rng.normal(0, 10, (1, episodes))
        parts.append(episode_rows(episodes_of(ours[at_min]), robot="cartpole", arm=arm.name, at_min=at_min))
        for agent, returns in ((HEURISTIC, theirs[at_min]), (RANDOM, np.full((1, episodes), -80.0))):
            columns = {"robot": "cartpole", "arm": "1-threshold", "agent": agent, "at_min": at_min}
            parts.append(episode_rows(episodes_of(returns), **columns))

    table = pd.concat(parts)
    rows = tuple(compare_with_heuristic(study, table, spec))
    assert [row.outcome for row in rows] == [OUTPERFORM, NOT, NOT, TOO_FEW]
    for row in rows:
        a, b = ours[row.at_min].ravel(), theirs[row.at_min].ravel()
        assert np.isclose(row.p, mannwhitneyu(a, b, method="asymptotic").pvalue)
        # What is shown is what decides.
        assert np.isclose(row.p_best, mannwhitneyu(a, b, method="exact").pvalue if len(a) * len(b) < 1000 else row.p)
        assert np.isclose(row.mean_return, np.mean(a)) and np.isclose(row.heuristic, np.mean(b))
        # To the bit as in the scores, or the two round to different digits.
        assert row.mean_return == performances(table, "cartpole", arm, row.at_min).mean()

    results = Results((), (), (), rows, (), ())
    shown = heuristic_table(results)
    # That they are not shown to be better does not mean that they are not.
    assert shown.marked == (1, 2) and shown.note.endswith("the policies are not shown to outperform it at p < 0.01.")
    messages = not_outperforming(results)
    assert [message.split(": ")[0] for message in messages] == [
        "cartpole, 1 threshold, at 10 min",
        "cartpole, 1 threshold, at 20 min",
    ]


def episodes_of(returns: np.ndarray) -> Episodes:
    """Episodes of a hundred iterations each."""
    none = np.zeros((*returns.shape, 0), np.int64)
    return Episodes(
        returns, np.full(returns.shape, 100), np.zeros(returns.shape, bool), none, none[:, 0].astype(np.float64)
    )
