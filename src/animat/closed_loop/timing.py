"""The clock of a closed loop, handed in so that a test can have its own."""

from __future__ import annotations

import time
from typing import Protocol

_SPUN_S = 0.0003
"""The end of a wait that is spun: the kernel wakes a sleeper up to some 0.1 ms late."""


class Clock(Protocol):
    """A clock that runs forward, in seconds from anywhere, and waits."""

    def now_s(self) -> float:
        """What it shows."""

    def sleep_until(self, time_s: float) -> None:
        """Return when it shows `time_s`; at once if it is past that."""


class WallClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Seconds since the machine started, or so."""
        return time.perf_counter()

    def sleep_until(self, time_s: float) -> None:
        """Sleep, and spin for the last 0.3 ms."""
        left_s = time_s - time.perf_counter() - _SPUN_S
        if left_s > 0:
            time.sleep(left_s)
        while time.perf_counter() < time_s:
            pass
