"""Stimulation patterns: sets of electrodes that are pulsed together, none near another."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Int64

from animat.errors import InvalidArgument
from animat.stimulation.array import ElectrodeArray

_TRIES_A_PATTERN = 200
_MOST_LOOKED_AT = 2_000_000
"""Sets of electrodes that are looked at, some seconds, before it is given up to list all that keep the distance."""


def draw_patterns(
    array: ElectrodeArray,
    electrodes: Int64[np.ndarray, " electrodes"],
    *,
    seed: int,
    patterns: int = 100,
    size: int = 5,
    spacing_um: float = 100.0,
) -> Int64[np.ndarray, "patterns size"]:
    """Draw different patterns of electrodes, every two of a pattern more than `spacing_um` apart.

    Every set that keeps the distance is equally likely.

    Args:
        array: where the electrodes are.
        electrodes: to choose from.
        seed: decides the draw; 0 or more.
        patterns: how many, no two of them the same set.
        size: electrodes in each.
        spacing_um: the distance that every pair must exceed.

    Returns:
        Electrodes of each pattern, rising.

    Raises:
        InvalidArgument: if there are not that many, or too few were found; it says how many and what to relax. For a
            seed below 0.

    Source: the paper's methods (5 of 32 electrodes, more than 100 um apart, 100 patterns).
    """
    electrodes = np.unique(np.asarray(electrodes, dtype=np.int64))
    for name, number in (("patterns", patterns), ("size", size)):
        if number < 1:
            raise InvalidArgument(f"{name}: expected at least 1, got {number}")
    if seed < 0:
        raise InvalidArgument(f"seed: expected 0 or more, got {seed}")
    rng = np.random.default_rng([seed, 5])
    is_far = array.distance_um(electrodes, electrodes) > spacing_um
    found: dict[tuple[int, ...], None] = {}
    if size <= len(electrodes):
        for _ in range(_TRIES_A_PATTERN * patterns):
            chosen = np.sort(rng.choice(len(electrodes), size, replace=False))
            if all(is_far[i, j] for i, j in itertools.combinations(chosen, 2)):
                found[tuple(chosen.tolist())] = None
                if len(found) == patterns:
                    break
    if len(found) < patterns:
        # So few keep the distance that chance hardly meets them: there are few enough to list.
        every, is_all = _cliques(is_far, size, limit=max(1_000_000, 10 * patterns))
        if len(every) < patterns:
            there = f"{len(electrodes)} electrodes make only {len(every)}"
            if not is_all:
                there = f"among {_MOST_LOOKED_AT:,} beginnings of such sets {len(every)} could be completed"
            raise InvalidArgument(
                f"patterns: expected {patterns} different sets of {size} electrodes with every pair more than "
                f"{spacing_um:g} um apart, but {there}: ask for fewer patterns, fewer electrodes in each, a shorter "
                "distance, or more stimulation sites"
            )
        found = dict.fromkeys(every[i] for i in np.sort(rng.choice(len(every), patterns, replace=False)))
    return electrodes[np.array(list(found), dtype=np.int64).reshape(patterns, size)]


def _cliques(
    is_far: Bool[np.ndarray, "electrodes electrodes"], size: int, limit: int
) -> tuple[list[tuple[int, ...]], bool]:
    """Sets of `size` that are far from each other, up to `limit` of them, and whether those are all."""
    found: list[tuple[int, ...]] = []
    open_sets: list[tuple[tuple[int, ...], np.ndarray]] = [((), np.arange(len(is_far)))]
    looked_at = 0
    while open_sets:
        if len(found) == limit or looked_at >= _MOST_LOOKED_AT:
            return found, False
        chosen, possible = open_sets.pop()
        looked_at += len(possible)
        if len(chosen) == size:
            found.append(chosen)
            continue
        for place, i in enumerate(possible.tolist()):
            later = possible[place + 1 :]
            later = later[is_far[i, later]]
            # What has too few left to choose from is no beginning of a set.
            if len(chosen) + 1 + len(later) >= size:
                open_sets.append(((*chosen, i), later))
    return found, True
