"""A request to a culture: stimuli and a stretch of time, as immutable plain values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

from animat.errors import InvalidArgument
from animat.stimulation.plain import seconds
from animat.stimulation.stimulus import Stimulus, plain_stimuli


class Request(NamedTuple):
    """Stimuli, with times counted from the start, and how long to observe; all of them begin within."""

    stimuli: tuple[Stimulus, ...]
    duration_s: float

    @staticmethod
    def of(stimuli: Iterable[Stimulus], duration_s: float) -> Request:
        """The caller's arguments as immutable values; refuses anything else, and a stimulus after the end."""
        request = Request(plain_stimuli(stimuli), plain_duration(duration_s))
        times_s = [stimulus.time_s for stimulus in request.stimuli]
        for time_s in times_s:
            if not time_s < request.duration_s:
                raise InvalidArgument(
                    f"stimuli: expected times before the delivery ends ({request.duration_s:g} s), got {time_s:g} s"
                )
        # The guard checks the times of pulses, and does not see rests.
        has_rests = any(stimulus.is_rest for stimulus in request.stimuli)
        if has_rests and not all(before <= after for before, after in pairwise([0.0, *times_s])):
            raise InvalidArgument(f"stimuli: expected times from 0 s in ascending order, got {times_s[:5]}")
        return request

    def counted_from(self, since_s: float, now_s: float) -> Request:
        """The request with times counted from now instead of from `since_s`; what is past begins now."""
        if not since_s <= now_s:
            raise InvalidArgument(f"since_s: expected a reading of the clock, which is at {now_s:g} s, got {since_s}")
        # All are moved equally, so that intervals stay as requested. Times below 0 are left to the guard.
        passed_s = now_s - since_s
        passed_s = min(passed_s, max(0.0, self.stimuli[0].time_s) if self.stimuli else self.duration_s)
        moved = tuple(replace(stimulus, time_s=stimulus.time_s - passed_s) for stimulus in self.stimuli)
        return Request(moved, self.duration_s - passed_s)


def plain_duration(duration_s: Any) -> float:
    """The duration as a float; refuses one that is negative, not finite, or less precise than float64."""
    duration_s = seconds("duration_s", duration_s)
    if not 0 <= duration_s < float("inf"):
        raise InvalidArgument(f"duration_s: expected a finite number of seconds from 0, got {duration_s}")
    return float(duration_s)
