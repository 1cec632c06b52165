"""Whose work is it, in closed loop: the policies' return with something in place of the culture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from animat.columns import align_columns
from animat.environment import Environment
from animat.evaluation.controls import Control
from animat.evaluation.rollouts import roll_out
from animat.evaluation.statistics import CONFIDENCE, Interval
from animat.neurons.simulator import NeuronSimulator
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


def half_an_episode(policies: Control, environment: Environment[Any], simulator: NeuronSimulator, seed: int) -> int:
    """Half of the policies' median episode on the simulator, in iterations; at least one."""
    ran = roll_out(environment, simulator, policies.actor, policies.n_actors, episodes=EPISODES, seed=seed)
    return max(1, int(np.median(ran.lengths)) // 2)


def run_ideal_actuator(
    ideal: Control, environment: Environment[Any], simulator: NeuronSimulator, seed: int
) -> tuple[str, Float64[np.ndarray, " episodes"]]:
    """The meaning of an ideal actuator, and returns of policies with one in place of the culture."""
    within = ideal.within(environment, simulator)
    ran = roll_out(*within, ideal.actor, ideal.n_actors, episodes=EPISODES, seed=seed)
    return ideal.meaning, np.asarray(ran.returns, np.float64).ravel()


def intervention_table(
    rows: Sequence[Row], meaning_of_ideal: str, with_ideal: Float64[np.ndarray, " episodes"]
) -> tuple[Intervention, ...]:
    """The table: the simulator, an ideal actuator (`run_ideal_actuator`), then the measured interventions.

    The session's rows have the policies first; without a complete episode of theirs it is empty.
    """
    usual_returns = rows[0].measured
    if not len(usual_returns):
        return ()
    measured = {row.name: row for row in rows if len(row.measured)}
    lost = _lost(usual_returns, with_ideal)
    table = [
        Intervention("its simulator", "as predicted", False, float(rows[0].predicted.mean()), rows[0].gap),
        Intervention("ideal actuator", meaning_of_ideal, False, float(with_ideal.mean()), lost),
    ]
    for row in (measured[name] for name in MEASURED if name in measured):
        lost = _lost(usual_returns, row.measured)
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


def _lost(usual: Float64[np.ndarray, " episodes"], changed: Float64[np.ndarray, " others"]) -> Interval:
    """Difference of means, with its bootstrap percentile interval over episodes; infinite with fewer than two."""
    value = float(usual.mean() - changed.mean())
    if min(len(usual), len(changed)) < 2:
        return Interval(value, -np.inf, np.inf, CONFIDENCE)
    rng = np.random.default_rng(0)
    drawn = resampled_means(usual, rng) - resampled_means(changed, rng)
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high), CONFIDENCE)
