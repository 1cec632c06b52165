"""The slow drift of excitation over hours, independent of the culture's activity."""

from __future__ import annotations

import numpy as np

from animat.cultures.tissue.parameters import TissueParameters

MARK_S = 10
"""Excitation is constant between marks of the tissue's clock, so it does not depend on how time is divided."""


class Drift:
    """g(t) = 1 + o(t), with o a slow Ornstein-Uhlenbeck process that starts at 0."""

    def __init__(self, seed: int, parameters: TissueParameters) -> None:
        self._draws = np.random.default_rng([seed, 2])
        self._kept = float(np.exp(-MARK_S / (60 * parameters.drift_min)))
        self._spread = parameters.drift_share * float(np.sqrt(1 - self._kept**2))
        self._drifts = [0.0]

    def gain(self, mark: int) -> float:
        """The factor on all excitatory weights from `mark` to the next, `MARK_S` later."""
        # One draw per mark, in order: the drift is the same function of time, however time is divided.
        for draw in self._draws.standard_normal(max(0, mark + 1 - len(self._drifts))).tolist():
            self._drifts.append(self._drifts[-1] * self._kept + self._spread * draw)
        return max(0.0, 1 + self._drifts[mark])
