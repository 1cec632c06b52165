"""How long a session will be and can be, reported before the first pulse."""

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

_BYTES_PER_MIN = 5e6
"""What the log and the recording of a session of 1,024 channels fill."""


@dataclass(frozen=True)
class Outlook:
    """What is known beforehand of a session's length; minutes are from its start.

    Attributes:
        drifted_min: time until the recordings' drift has changed P50 by a quarter since the last of them, and a lower
            bound of it; None if the recordings do not determine the drift.
        budget_min: time until the budget of pulses is spent; infinite without one.
        settling_min: of the planned time, what passes before the first episode.
    """

    planned_min: float
    drifted_min: tuple[float, float] | None
    budget_min: float
    settling_min: float = 0.0

    @property
    def room_bytes(self) -> float:
        """How much the session's files will fill."""
        return _BYTES_PER_MIN * min(self.planned_min, self.budget_min)

    def __str__(self) -> str:
        planned = f"{self.planned_min:.0f} min" if self.planned_min >= 1 else f"{60 * self.planned_min:.0f} s"
        text = f"the session is planned for about {planned} of the culture's time; "
        available_min, remedy = self.budget_min, ""
        if self.drifted_min is None:
            text += "at least two recordings are needed to estimate the culture's drift"
        else:
            (likely, least), by = self.drifted_min, f"by {100 * LARGE:.0f} %"
            if likely > 0:
                when = f"will have changed {by} in {_duration(likely)} ({_duration(max(0.0, least))} at the earliest)"
                available_min = min(likely, available_min)
            else:
                when = f"had already changed {by} {_duration(-likely)} ago"
                remedy = "; use newer recordings, with --at-min or by recording again"
            text += f"at the drift of the recordings the median response {when}, "
            text += "beyond which adaptive thresholds may not help"
        if np.isfinite(self.budget_min):
            text += f"; the budget of pulses lasts for about {self.budget_min:.0f} min"
        text += remedy
        if self.budget_min < self.settling_min:
            return f"{text}, but the settling before the first episode takes {self.settling_min:.1f} min (--settling)"
        return text + ("; the plan is longer: ask for fewer --episodes" if self.planned_min > available_min else "")


def _duration(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes < 600 else "more than 10 h"


def outlook(
    loop: Loop,
    calibration: Calibration,
    episodes: Sequence[tuple[int, Float64[np.ndarray, " conditions"], bool]],
    account: Account,
    age_min: float,
) -> Outlook:
    """How long a session will be and can be, `age_min` after the recording.

    `episodes` has for each agent the number of episodes, how often each condition is presented in one of them, and
    whether the culture gets pulses.
    """
    gives = np.array([condition.electrodes != RESTING for condition in loop.conditions])
    interval_s = loop.pulses * np.array([condition.interval_s for condition in loop.conditions])
    total_s = pulses = 0.0
    for n, acted, is_stimulated in episodes:
        presented = acted + (loop.warm_up or 0) * is_stimulated
        total_s += n * (loop.pause_s + float(presented @ interval_s))
        pulses += n * is_stimulated * loop.pulses * float(presented[gives].sum())
    settling = loop.settling or 0
    settling_s = settling * (loop.pause_s + SETTLING_ROUNDS * float(interval_s.sum()))
    total_s += settling_s
    pulses += settling * SETTLING_ROUNDS * loop.pulses * int(gives.sum())
    # On a clock that was restarted, the age is not known.
    of, drift, since_min = account.budget.pulses, calibration.drift, min(0.0, -age_min)
    return Outlook(
        total_s / 60,
        None if drift is None else tuple(since_min + each for each in drift.minutes_to(LARGE)),  # type: ignore[arg-type]
        np.inf if of is None or pulses == 0 else total_s / 60 * (of - account.pulses) / pulses,
        settling_s / 60,
    )
