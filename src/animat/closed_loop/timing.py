"""The clock of a closed loop, handed in so that a test can have its own."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
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


@contextlib.contextmanager
def ahead_of_other_programs(*, with_those_it_starts: bool) -> Iterator[None]:
    """Run the calling thread before all that has no deadline, where the system lets it.

    Linux lets root, and whoever was given a real-time priority (`ulimit -r`). Elsewhere nothing changes. Threads that
    are ahead take turns, also on a single core.

    Args:
        with_those_it_starts: whether threads and programs that it starts meanwhile are ahead, too.
    """
    before = None
    with contextlib.suppress(AttributeError, OSError):
        given = os.sched_getscheduler(0), os.sched_getparam(0)
        policy = os.SCHED_RR if with_those_it_starts else os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(1))
        before = given
    try:
        yield
    finally:
        if before is not None:
            policy, parameters = before
            # Whoever is not root may not take back that what it starts is not ahead; that does no harm.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)
                os.sched_setscheduler(0, policy, parameters)


def among_other_programs(thread: threading.Thread) -> None:
    """Take a thread back that runs ahead of other programs and does not end: it must not starve them."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        os.sched_setscheduler(thread.native_id, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))  # type: ignore[arg-type]
