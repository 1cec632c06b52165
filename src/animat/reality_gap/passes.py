"""How often responses to each condition pass the median, P50: what a simulator says, and what was measured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64


class Passes(NamedTuple):
    """Counts of each condition.

    Attributes:
        presented: how often, shape (..., conditions).
        passed: how often the response was P50 or more, the same shape; of several readouts each on its own, shape
            (..., conditions, readouts).
    """

    presented: Int64[np.ndarray, "*any conditions"]
    passed: Int64[np.ndarray, "*any"]

    @property
    def share(self) -> Float64[np.ndarray, "*any"]:
        """P(x >= P50) of each condition, in the shape of `passed`; NaN for one that was never presented."""
        of_several = self.passed.ndim > self.presented.ndim
        with np.errstate(invalid="ignore"):
            return np.asarray(self.passed / (self.presented[..., None] if of_several else self.presented))

    def summed(self, axis: int) -> Passes:
        """Over policies or episodes."""
        return Passes(self.presented.sum(axis=axis), self.passed.sum(axis=axis))
