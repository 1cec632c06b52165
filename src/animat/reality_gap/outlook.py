"""How long a session will be, and how long it can be: told before the first pulse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from animat.closed_loop.loop import SETTLING_ROUNDS, Loop
from animat.cultures.budget import Account
from animat.reality_gap.calibration import Calibration
from animat.responses.condition import RESTING
from animat.responses.quality.drift import LARGE


@dataclass(frozen=True)
class Outlook:
    """What is known of a session's length beforehand; minutes are from its start.

    Attributes:
        planned_min: all episodes, as they are on the simulator.
        drifted_min: until the recordings' drift has changed P50 by a quarter since the last of them, and how long it
            takes at least; None where they tell no drift.
        budget_min: until the budget of pulses is spent; infinite without one.
    """

    planned_min: float
    drifted_min: tuple[float, float] | None
    budget_min: float

    @property
    def has_drifted(self) -> bool:
        """Whether the drift was so large already before the session."""
        return self.drifted_min is not None and self.drifted_min[0] <= 0

    @property
    def _lasts_min(self) -> float:
        return min(np.inf if self.drifted_min is None else self.drifted_min[0], self.budget_min)

    def __str__(self) -> str:
        if self.drifted_min is None:
            drift = "how the culture drifts is known from two recordings on"
        else:
            likely, least = self.drifted_min
            drift = f"by the recordings' drift the median response {_when(likely, least)}, beyond which adaptive "
            drift += "thresholds may not help"
        said = f"the session is planned for about {self.planned_min:.0f} min of the culture's time; {drift}"
        if np.isfinite(self.budget_min):
            said += f"; the budget of pulses lasts for about {self.budget_min:.0f} min"
        if self.has_drifted:
            said += "; take newer recordings, with --at-min or by recording again"
        lasts_min = self.budget_min if self.has_drifted else self._lasts_min
        return said + ("; the plan is longer: ask for fewer --episodes" if self.planned_min > lasts_min else "")


def _when(likely: float, least: float) -> str:
    by = f"by {100 * LARGE:.0f} %"
    if likely <= 0:
        return f"had changed {by} already {_words(-likely)} ago"
    return f"has changed {by} in {_words(likely)} ({_words(max(0.0, least))} at least)"


def _words(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes < 600 else "more than 10 h"


def outlook(
    loop: Loop,
    calibration: Calibration,
    episodes: Sequence[tuple[int, Float64[np.ndarray, " conditions"], bool]],
    account: Account,
    now_min: float,
) -> Outlook:
    """How long a session will be and can be.

    Args:
        calibration: whose recordings' drift is gone on with.
        episodes: of each agent how many, how often each condition is presented in one of them, and whether the
            culture gets pulses then.
        now_min: on the culture's clock.
    """
    gives = np.array([condition.electrodes != RESTING for condition in loop.conditions])
    interval_s = loop.pulses * np.array([condition.interval_s for condition in loop.conditions])
    total_s = pulses = 0.0
    for n, acted, is_stimulated in episodes:
        presented = acted + (loop.warm_up or 0) * is_stimulated
        total_s += n * (loop.pause_s + float(presented @ interval_s))
        pulses += n * is_stimulated * loop.pulses * float(presented[gives].sum())
    settling = loop.settling or 0
    total_s += settling * (loop.pause_s + SETTLING_ROUNDS * float(interval_s.sum()))
    pulses += settling * SETTLING_ROUNDS * loop.pulses * int(gives.sum())
    of, drift, since_min = account.budget.pulses, calibration.drift, calibration.start_min - now_min
    return Outlook(
        total_s / 60,
        None if drift is None else tuple(since_min + each for each in drift.minutes_to(LARGE)),  # type: ignore[arg-type]
        np.inf if of is None or pulses == 0 else total_s / 60 * (of - account.pulses) / pulses,
    )
