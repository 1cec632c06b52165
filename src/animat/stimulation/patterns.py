"""Stimulation patterns: sets of electrodes that are pulsed together, no two of them close to each other."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Int64

from animat.errors import InvalidArgument, expect_at_least
from animat.stimulation.array import ElectrodeArray, Electrodes

Patterns = Int64[np.ndarray, "patterns size"]
"""Electrodes of each pattern; of patterns of different sizes, padded with -1."""
_TRIES_A_PATTERN = 200


def draw_patterns(
    array: ElectrodeArray,
    electrodes: Electrodes,
    *,
    seed: int,
    patterns: int = 100,
    size: int = 5,
    spacing_um: float = 100.0,
) -> Patterns:
    """Draw distinct patterns of electrodes, every two electrodes of a pattern more than `spacing_um` apart.

    Every set that keeps the distance is equally likely.

    Args:
        electrodes: to choose from.
        seed: of the draw; 0 or more.
        patterns: how many, no two of them the same set.
        size: electrodes in each, in ascending order.
        spacing_um: the distance that every pair must exceed.

    Raises:
        InvalidArgument: if too few were found, with how many and what to relax; for a seed below 0.

    Source: the paper's methods (5 of 32 electrodes, more than 100 um apart, 100 patterns).
    """
    electrodes = np.unique(np.asarray(electrodes, dtype=np.int64))
    expect_at_least("patterns", patterns, 1)
    expect_at_least("size", size, 1)
    expect_at_least("seed", seed, 0)
    rng = np.random.default_rng([seed, 5])
    is_far = array.distance_um(electrodes, electrodes) > spacing_um
    drawn: dict[tuple[int, ...], None] = {}
    if size <= len(electrodes):
        for _ in range(_TRIES_A_PATTERN * patterns):
            chosen = np.sort(rng.choice(len(electrodes), size, replace=False))
            if all(is_far[i, j] for i, j in itertools.combinations(chosen, 2)):
                drawn[tuple(chosen.tolist())] = None
                if len(drawn) == patterns:
                    break
    if len(drawn) < patterns:
        expected = f"{patterns} different sets of {size} electrodes with every pair more than {spacing_um:g} um apart"
        found = f"random draws among {len(electrodes)} electrodes found only {len(drawn)}"
        remedy = "ask for fewer patterns, fewer electrodes in each, a shorter distance, or more stimulation sites"
        raise InvalidArgument(f"patterns: expected {expected}, but {found}: {remedy}")
    return electrodes[np.array(list(drawn), dtype=np.int64).reshape(patterns, size)]
