"""What a simulator with memory answers on average after a history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float64, Int64

from animat.neurons.memory import MemorySimulator


@dataclass(frozen=True, eq=False)
class Expected:
    """Means of a memory simulator's answers, in NumPy: a closed loop asks for them trial by trial.

    Attributes:
        before: of each condition, the place of its responses in the order of their histories, rising, shape
            (responses,).
        sums_hz: of the responses up to each place in that order, shape (responses + 1, readouts).
        nearest: how many of a condition's responses are drawn from, shape (conditions,).
        toward: how trace and load make a place in that order, shape (conditions, 2).
    """

    before: tuple[Float64[np.ndarray, " responses"], ...]
    sums_hz: tuple[Float64[np.ndarray, "sums readouts"], ...]
    nearest: Int64[np.ndarray, " conditions"]
    toward: Float64[np.ndarray, "conditions 2"]

    @classmethod
    def of(cls, simulator: MemorySimulator) -> Self:
        """Of one recording's simulator."""
        followers = np.asarray(simulator.followers)
        before = np.asarray(simulator.before, np.float64)
        after_hz = np.asarray(simulator.after_hz, np.float64).reshape(*before.shape, -1)
        return cls(
            tuple(row[:n] for row, n in zip(before, followers, strict=True)),
            tuple(np.cumsum(np.pad(row[:n], ((1, 0), (0, 0))), 0) for row, n in zip(after_hz, followers, strict=True)),
            np.asarray(simulator.nearest, np.int64),
            np.asarray(simulator.toward, np.float64),
        )

    def mean_hz(self, condition: int, trace: float, load: float) -> Float64[np.ndarray, " readouts"]:
        """Of the responses that are drawn from at this trace and load, Hz a channel."""
        before, sums_hz, nearest = self.before[condition], self.sums_hz[condition], int(self.nearest[condition])
        here = self.toward[condition] @ (trace, load)
        smaller, no_larger = (int(np.searchsorted(before, here, side=side)) for side in ("left", "right"))
        # As the simulator draws (`MemorySimulator.rows_near`).
        first = min(max((smaller + no_larger - nearest) // 2, 0), len(before) - nearest)
        first, end = min(first, smaller), max(first + nearest, no_larger)
        return np.asarray((sums_hz[end] - sums_hz[first]) / (end - first))
