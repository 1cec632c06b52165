"""The slow loss of excitation over hours, as a function of the tissue's clock alone."""

from __future__ import annotations

import numpy as np

from animat.cultures.tissue.parameters import TissueParameters

MARK_S = 10
"""Excitation is constant between marks of the tissue's clock, so that it does not depend on how time is cut."""


class Fatigue:
    """g(t) = 1 - a (1 - exp(-t / T)) + o(t), with o a slow Ornstein-Uhlenbeck drift that starts at 0.

    Args:
        seed: decides the drift.
        parameters: `fatigue_share` a, `fatigue_min` T, and `drift_share`, `drift_min` of o.
    """

    def __init__(self, seed: int, parameters: TissueParameters) -> None:
        self._parameters = parameters
        self._draws = np.random.default_rng([seed, 2])
        self._kept = float(np.exp(-MARK_S / (60 * parameters.drift_min)))
        self._drifts = [0.0]
        self._last = -1, 1.0

    def gain(self, mark: int) -> float:
        """The factor on all excitatory weights from `mark` to the next, marks being `MARK_S` apart."""
        if mark != self._last[0]:
            self._last = mark, self._gain(mark)
        return self._last[1]

    def _gain(self, mark: int) -> float:
        parameters, kept = self._parameters, self._kept
        # Every mark takes one draw, in order: the drift is one function of time, however time is passed.
        draws = self._draws.standard_normal(max(0, mark + 1 - len(self._drifts)))
        for draw in (draws * parameters.drift_share * np.sqrt(1 - kept**2)).tolist():
            self._drifts.append(self._drifts[-1] * kept + draw)
        minutes = mark * MARK_S / 60
        lost = parameters.fatigue_share * (1 - np.exp(-minutes / parameters.fatigue_min))
        return float(max(0.0, 1 - lost + self._drifts[mark]))
