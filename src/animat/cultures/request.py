"""What is asked of a culture: stimuli and a stretch of time, as plain values that cannot change."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

from animat.errors import InvalidArgument
from animat.stimulation.plain import seconds
from animat.stimulation.stimulus import Stimulus, plain_stimuli


class Request(NamedTuple):
    """Stimuli, and how long to observe.

    Attributes:
        stimuli: times counted from the start.
        duration_s: all stimuli begin within.
    """

    stimuli: tuple[Stimulus, ...]
    duration_s: float

    @staticmethod
    def of(stimuli: Iterable[Stimulus], duration_s: float) -> Request:
        """What a caller gave, as values that cannot change.

        Raises:
            InvalidArgument: for what is no stimulus or no duration, or a stimulus after the end.
        """
        request = Request(plain_stimuli(stimuli), plain_duration(duration_s))
        for stimulus in request.stimuli:
            if not stimulus.time_s < request.duration_s:
                raise InvalidArgument(
                    f"stimuli: expected times before the delivery ends ({request.duration_s:g} s), got "
                    f"{stimulus.time_s:g} s"
                )
        if any(stimulus.is_rest for stimulus in request.stimuli):
            # The guard, who looks at the times of pulses, does not see it.
            times_s = [0.0, *(stimulus.time_s for stimulus in request.stimuli)]
            if not all(before <= after for before, after in pairwise(times_s)):
                raise InvalidArgument(f"stimuli: expected times from 0 s on that do not fall, got {times_s[1:][:5]}")
        return request

    def counted_from(self, since_s: float, now_s: float) -> Request:
        """The same, counted from a time before, now counted from now; what is past begins now.

        Raises:
            InvalidArgument: for a time that is still to come.
        """
        if not since_s <= now_s:
            raise InvalidArgument(f"since_s: expected a reading of the clock, which is at {now_s:g} s, got {since_s}")
        # All by as much, so that times between stimuli are as they were asked for. What is before 0 is for the guard.
        passed_s = now_s - since_s
        passed_s = min(passed_s, max(0.0, self.stimuli[0].time_s) if self.stimuli else self.duration_s)
        moved = tuple([replace(each, time_s=each.time_s - passed_s) for each in self.stimuli])
        return Request(moved, self.duration_s - passed_s)


def plain_duration(duration_s: Any) -> float:
    """A duration as a float.

    Raises:
        InvalidArgument: for one that is negative, not finite, or less precise than float64.
    """
    duration_s = seconds("duration_s", duration_s)
    if not 0 <= duration_s < float("inf"):
        raise InvalidArgument(f"duration_s: expected finite seconds from 0, got {duration_s}")
    return float(duration_s)
