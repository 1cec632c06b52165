"""A study's policies beside the rule made by hand: whether learning did more than steering by a formula."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from animat.evaluation.verdict import beside
from animat.studies.evaluating import is_usual
from animat.studies.places import controls_file, episodes_file, read_table, table_file
from animat.studies.specification import Body, Study

HEURISTIC = "made by hand"
HEAD = ("robot", "condition", "at_min", "mean_return", "heuristic", "p", "wins", "outcome")
OUTPERFORM, NOT, TOO_FEW = "outperform it", "do not outperform it", "too few episodes to tell"


def rows_beside_heuristic(study: Study, folder: Path, body: Body) -> Iterator[tuple[Any, ...]]:
    """A row for each condition that is trained as usual and each minute at which the rule was run too, by `HEAD`."""
    for condition in study.conditions:
        if not is_usual(condition):
            continue
        controls = read_table(controls_file(folder, body, condition))
        heuristic = _by_minute([row for row in controls if row["control"] == HEURISTIC])
        policies = _by_minute(read_table(episodes_file(folder, body, condition)))
        for at_min in sorted(heuristic.keys() & policies.keys()):
            ours, theirs = policies[at_min], heuristic[at_min]
            found = beside(ours, theirs)
            outcome = (OUTPERFORM if found.is_outperformed else NOT) if found.can_tell else TOO_FEW
            means = float(np.mean(ours)), float(np.mean(theirs))
            yield body.name, condition.name, at_min, *means, found.p, found.wins, outcome


def not_outperforming(folder: Path) -> list[str]:
    """A sentence for each row whose policies do not outperform the rule; none for a folder without that table."""
    path = table_file(folder, "heuristic")
    return [
        f"{row['robot']}, {row['condition']}, at {row['at_min']:g} min: the policies do not outperform the rule made "
        f"by hand ({row['mean_return']:.1f} against {row['heuristic']:.1f}; p = {row['p']:.2g})"
        for row in (read_table(path) if path.exists() else ())
        if row["outcome"] == NOT
    ]


def _by_minute(rows: list[dict[str, Any]]) -> dict[float, list[float]]:
    returns: dict[float, list[float]] = defaultdict(list)
    for row in rows:
        returns[row["at_min"]].append(row["return"])
    return returns
