"""Whose work is it, in closed loop: the policies' return with something in place of the culture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.columns import align_columns
from animat.evaluation.controls import Control
from animat.evaluation.statistics import CONFIDENCE, Interval
from animat.reality_gap.row import Row, resampled_means
from animat.records import as_json

MEASURED = ("random spikes", "silent", "shuffled", "yoked", "turned round", "goal switched")
"""Interventions that are measured, in the order of the table."""
EPISODES = 100
"""Episodes of each policy on the simulator, with an ideal actuator and for the median length of an episode."""


@dataclass(frozen=True)
class Intervention:
    """The same policies with something in place of the culture, in closed loop (`is_measured`) or on its simulator.

    `lost` is the loss against the policies' measured return, with its interval over episodes.
    """

    name: str
    meaning: str
    is_measured: bool
    mean_return: float
    lost: Interval

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return vars(self) | {"lost": as_json(self.lost.to_dict())}


def intervention_table(
    rows: Sequence[Row], ideal: Control, with_ideal: Float64[np.ndarray, " episodes"]
) -> tuple[Intervention, ...]:
    """The table: the simulator, an ideal actuator with its returns on it, then the measured interventions.

    The session's rows have the policies first; without a complete episode of theirs it is empty.
    """
    if not len(rows[0].measured):
        return ()
    measured = {row.name: row for row in rows if len(row.measured)}
    lost = _lost(rows[0], with_ideal, None)
    table = [
        Intervention("its simulator", "as predicted", False, float(rows[0].predicted.mean()), rows[0].gap),
        Intervention(ideal.name, ideal.meaning, False, float(with_ideal.mean()), lost),
    ]
    for row in (measured[name] for name in MEASURED if name in measured):
        lost = _lost(rows[0], row.measured, row.turn)
        table.append(Intervention(row.name, row.meaning, True, float(row.measured.mean()), lost))
    return tuple(table)


def intervention_lines(policies: Row, table: Sequence[Intervention]) -> list[str]:
    """The table as lines for a terminal."""
    cells = []
    for each in table:
        where = "measured" if each.is_measured else "simulator"
        lost = f"{each.lost.value:.1f}", each.lost.ends
        cells.append([each.name, f"{each.mean_return:.1f}", *lost, where, each.meaning])
    return [
        "whose work is it: return with the culture replaced, and the loss from the measured "
        f"{policies.measured.mean():.1f}",
        *align_columns(["", "return", "lost", "95 % interval", "", ""], cells),
    ]


def _lost(usual: Row, changed: Float64[np.ndarray, " others"], turn: Int64[np.ndarray, " others"] | None) -> Interval:
    """Difference of means, with its interval over episodes (`resampled_means`); infinite where they are too few."""
    value, rng = float(usual.measured.mean() - changed.mean()), np.random.default_rng(0)
    one, other = resampled_means(usual.measured, rng, usual.turn), resampled_means(changed, rng, turn)
    if one is None or other is None:
        return Interval(value, -np.inf, np.inf, CONFIDENCE)
    low, high = np.quantile(one - other, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high), CONFIDENCE)
