"""What each action can lead to on a grid: where the robot lands, and what its neurons remember then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32

from animat.evaluation.commands import Commands


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Pairs of a landing of the robot and a layer of values, and how they weigh in each action's mean.

    Attributes:
        pairs: a landing and a layer, shape (outcomes, 2).
        weights: of each pair, for each layer that an iteration starts in and each action, shape
            (layers, actions, outcomes).
    """

    pairs: Int32[np.ndarray, "outcomes 2"]
    weights: Float32[np.ndarray, "layers actions outcomes"]

    @classmethod
    def of(
        cls,
        after: Sequence[Sequence[Commands]],
        nodes: Float64[np.ndarray, " nodes"],
        *,
        smooth: bool,
        n_draws: int,
    ) -> Outcomes:
        """Of one case.

        Args:
            after: the commands, as `commands_after` tells them.
            nodes, smooth: the commands whose landings are known, as in `Commands.onto`.
            n_draws: of the robot's noise, all equally likely; a landing is a pair of a node and a draw, nodes outer.
        """
        spread = np.array([[commands.onto(nodes, smooth=smooth) for commands in row] for row in after])
        weights = np.moveaxis(np.repeat(spread / n_draws, n_draws, axis=-1), 1, 2).astype(np.float32)
        then, landings = np.nonzero(np.any(weights != 0, axis=(0, 1)))
        return cls(np.stack([landings, then], axis=1).astype(np.int32), weights[:, :, then, landings])


def side_by_side(
    cases: Sequence[Outcomes],
) -> tuple[Int32[np.ndarray, "layers outcomes 2"], Float32[np.ndarray, "layers actions outcomes"]]:
    """Pairs and weights of several cases, the layers of one after those of another.

    A case of fewer actions has its last one again, one of fewer outcomes has some that weigh nothing.
    """
    most_actions, most_outcomes = (max(case.weights.shape[axis] for case in cases) for axis in (1, 2))
    pairs, weights = [], []
    first = 0
    for case in cases:
        layers, actions, outcomes = case.weights.shape
        room = most_outcomes - outcomes
        shifted = np.pad(case.pairs + np.array([0, first], np.int32), ((0, room), (0, 0)))
        pairs.append(np.repeat(shifted[None], layers, axis=0))
        more = np.pad(case.weights, ((0, 0), (0, most_actions - actions), (0, 0)), mode="edge")
        weights.append(np.pad(more, ((0, 0), (0, 0), (0, room))))
        first += layers
    return np.concatenate(pairs), np.concatenate(weights)
