"""What a study says of its policies beside the rule made by hand, for returns whose order is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.stats import mannwhitneyu

from animat.studies.evaluating import HEAD
from animat.studies.heuristic import HEAD as COLUMNS
from animat.studies.heuristic import NOT, OUTPERFORM, TOO_FEW, not_outperforming, rows_beside_heuristic
from animat.studies.places import controls_file, episodes_file, table_file, write_table
from animat.studies.specification import Body, Study, StudyCondition


def test_policies_that_bring_no_more_than_the_rule_are_named(tmp_path: Path) -> None:
    body, condition = Body("cartpole"), StudyCondition("1 threshold")
    without = StudyCondition("without neurons", mapping="none", trained=False)
    study = Study(robots=(body,), conditions=(condition, without))
    rng = np.random.default_rng(1)
    minutes = {0.0: (30, 50.0), 10.0: (30, 0.0), 20.0: (30, -50.0), 30.0: (2, 50.0)}
    ours, theirs = [], []
    for at_min, (episodes, by) in minutes.items():
        ours += [(at_min, f"p{i % 2}", i // 2, x, 100, 0) for i, x in enumerate(rng.normal(by, 10, 2 * episodes))]
        theirs += [("made by hand", at_min, "", i, x, 100, 0) for i, x in enumerate(rng.normal(0, 10, episodes))]
        theirs += [("random", at_min, "", i, -80.0, 20, 1) for i in range(episodes)]
    write_table(episodes_file(tmp_path, body, condition), HEAD, ours)
    write_table(controls_file(tmp_path, body, condition), ("control", *HEAD), theirs)

    rows = list(rows_beside_heuristic(study, tmp_path, body))
    assert [row[-1] for row in rows] == [OUTPERFORM, NOT, NOT, TOO_FEW]
    for row in rows:
        found = dict(zip(COLUMNS, row, strict=True))
        a = [x for at_min, _, _, x, *_ in ours if at_min == found["at_min"]]
        b = [x for name, at_min, _, _, x, *_ in theirs if name == "made by hand" and at_min == found["at_min"]]
        assert np.isclose(found["p"], mannwhitneyu(a, b, method="asymptotic").pvalue)
        assert np.isclose(found["mean_return"], np.mean(a)) and np.isclose(found["heuristic"], np.mean(b))

    write_table(table_file(tmp_path, "heuristic"), COLUMNS, rows)
    sentences = not_outperforming(tmp_path)
    assert [sentence.split(": ")[0] for sentence in sentences] == [
        "cartpole, 1 threshold, at 10 min",
        "cartpole, 1 threshold, at 20 min",
    ]
    assert not not_outperforming(tmp_path / "of a former version")
