"""Whose work is it, in closed loop: what the policies' measured return becomes without the culture, or against it."""

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

REPLACED = ("random spikes", "silent", "shuffled", "yoked", "turned round", "goal switched")
"""Those that were measured, in their order."""
EPISODES = 100
"""Of each policy on the simulator, with an ideal actuator, and to know when an episode is half over."""


@dataclass(frozen=True)
class Replaced:
    """One line: the same policies with something in the culture's place.

    Attributes:
        name, meaning: what.
        is_measured: whether in closed loop on the culture; else on its simulator.
        lost: how much less that is than the policies' measured return, with its interval over episodes.
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
    """Half of the median episode of policies on the simulator, in iterations; one at least."""
    ran = roll_out(environment, simulator, policies.actor, policies.n_actors, episodes=EPISODES, seed=seed)
    return max(1, int(np.median(ran.lengths)) // 2)


def with_ideal_actuator(
    ideal: Control, environment: Environment[Any], simulator: NeuronSimulator, seed: int
) -> tuple[str, Float64[np.ndarray, " episodes"]]:
    """What an ideal actuator is, and returns of policies that have one in the culture's place."""
    within = ideal.within(environment, simulator)
    ran = roll_out(*within, ideal.actor, ideal.n_actors, episodes=EPISODES, seed=seed)
    return ideal.meaning, np.asarray(ran.returns, np.float64).ravel()


def replaced(
    rows: Sequence[Row], meaning_of_ideal: str, with_ideal: Float64[np.ndarray, " episodes"]
) -> tuple[Replaced, ...]:
    """The table: its simulator, an ideal actuator, then what was measured; none where no policy came to an end.

    Args:
        rows: of the session's table, the policies first.
        meaning_of_ideal, with_ideal: as of `with_ideal_actuator`.
    """
    policies = rows[0]
    if not len(policies.measured):
        return ()
    by_name = {row.name: row for row in rows}
    found = [
        Replaced("its simulator", "as predicted", False, float(policies.predicted.mean()), policies.gap),
        Replaced(
            "ideal actuator", meaning_of_ideal, False, float(with_ideal.mean()), _lost(policies.measured, with_ideal)
        ),
    ]
    for name in REPLACED:
        row = by_name.get(name)
        if row is not None and len(row.measured):
            lost = _lost(policies.measured, row.measured)
            found.append(Replaced(name, row.meaning, True, float(row.measured.mean()), lost))
    return tuple(found)


def told_replaced(policies: Row, found: Sequence[Replaced]) -> list[str]:
    """The table as lines for a terminal."""
    cells = []
    for each in found:
        where = "measured" if each.is_measured else "simulator"
        lost = f"{each.lost.value:.1f}", each.lost.ends
        cells.append([each.name, f"{each.mean_return:.1f}", *lost, where, each.meaning])
    usual = f"{policies.measured.mean():.1f}"
    return [
        f"whose work is it: return with the culture replaced, and the loss from the measured {usual}",
        *align_columns(["", "return", "lost", "95 % interval", "", ""], cells),
    ]


def _lost(usual: Float64[np.ndarray, " episodes"], changed: Float64[np.ndarray, " others"]) -> Interval:
    """Difference of means, its percentile interval over episodes drawn anew; infinite ends with fewer than two."""
    value = float(usual.mean() - changed.mean())
    if min(len(usual), len(changed)) < 2:
        return Interval(value, -np.inf, np.inf, CONFIDENCE)
    rng = np.random.default_rng(0)
    drawn = resampled_means(usual, rng) - resampled_means(changed, rng)
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(value, float(low), float(high), CONFIDENCE)
