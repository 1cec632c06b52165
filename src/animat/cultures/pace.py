"""Limits on pace on a device's own clock, where a request made in time can be delivered late."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from animat.cultures.history import History
from animat.cultures.safety import Guard, Limits
from animat.errors import UnsafeStimulus
from animat.stimulation.stimulus import Stimulus

DELAY_STEP_S = 0.001
"""Step by which stimuli are delayed when they would come too soon after earlier ones."""
PATIENCE_S = 2.0
"""Rates cover a second: what does not fit after two is not due to a late start."""
_PACE = frozenset({"overlap", "gap_us", "interval_us", "stimuli_per_electrode_s", "stimuli_per_s"})


class Pace:
    """A guard on the device's clock, behind the one on the culture's clock that every request passes.

    A request that begins late comes closer to the next one than intended: two that each keep a limit may break it
    together. So a second guard checks each at its actual time, and it is delayed if that is too soon.

    Args:
        limits: in force.
        sites: electrodes that can stimulate.
        history: of earlier sessions, on the device's clock.
        now_s: the device's clock.
    """

    def __init__(self, limits: Limits, sites: Iterable[int], history: History, now_s: float) -> None:
        self._guard = Guard(limits, sites, history, now_s)

    def earliest(self, stimuli: Sequence[Stimulus], from_s: float) -> float:
        """The earliest time from `from_s` on, on the device's clock, at which the stimuli may begin.

        Args:
            stimuli: with times counted from the first.
            from_s: when they could begin.

        Raises:
            UnsafeStimulus: for stimuli that no delay makes safe.
        """
        waited_s = 0.0
        while True:
            try:
                self._guard.check(stimuli, from_s + waited_s)
            except UnsafeStimulus as error:
                if error.limit not in _PACE or waited_s >= PATIENCE_S:
                    raise
                waited_s += DELAY_STEP_S
            else:
                return from_s + waited_s

    def count(self, stimuli: Sequence[Stimulus], at_s: float) -> None:
        """Remember stimuli as delivered at the earliest time or later.

        Raises:
            UnsafeStimulus: for a time at which they may not begin.
        """
        self._guard.admit(stimuli, at_s)


def from_zero(stimuli: Sequence[Stimulus]) -> list[Stimulus]:
    """Stimuli with times counted from the first of them."""
    return [replace(stimulus, time_s=stimulus.time_s - stimuli[0].time_s) for stimulus in stimuli]
