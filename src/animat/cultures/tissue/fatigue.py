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
        self._drift = 0.0
        self._gains: list[float] = []

    def gain(self, mark: int) -> float:
        """The factor on all excitatory weights from `mark` to the next, marks being `MARK_S` apart."""
        while len(self._gains) <= mark:
            self._gains.append(self._next())
        return self._gains[mark]

    def _next(self) -> float:
        """The gain after those that are known."""
        mark, parameters = len(self._gains), self._parameters
        if mark:
            # Every mark takes one draw, in order: the drift is one function of time, however time is passed.
            draw = self._draws.standard_normal() * parameters.drift_share * np.sqrt(1 - self._kept**2)
            self._drift = self._drift * self._kept + float(draw)
        minutes = mark * MARK_S / 60
        lost = parameters.fatigue_share * (1 - np.exp(-minutes / parameters.fatigue_min))
        return float(max(0.0, 1 - lost + self._drift))
