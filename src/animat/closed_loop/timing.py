"""The clock of a closed loop, which tests can replace, and real-time priority."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator

_SPUN_S = 0.0003
"""The last part of a wait, spent spinning: the kernel wakes a sleeper up to some 0.1 ms late."""


class Clock:
    """The machine's monotonic clock, in seconds from any origin; tests replace it."""

    def now_s(self) -> float:
        return time.perf_counter()

    def sleep_until(self, time_s: float) -> None:
        """Return at `time_s`, immediately if it has passed: sleep, and spin for the last 0.3 ms."""
        left_s = time_s - time.perf_counter() - _SPUN_S
        if left_s > 0:
            time.sleep(left_s)
        while time.perf_counter() < time_s:
            pass


@contextlib.contextmanager
def real_time_priority(*, inherited: bool) -> Iterator[None]:
    """Run the calling thread with real-time priority, where the system allows it.

    Linux allows it to root, and to users with a real-time priority limit (`ulimit -r`). Elsewhere nothing changes.
    Threads with this priority take turns, even on a single core. If `inherited`, threads and programs that it starts
    meanwhile have the priority, too.
    """
    before = None
    with contextlib.suppress(AttributeError, OSError):
        current = os.sched_getscheduler(0), os.sched_getparam(0)
        policy = os.SCHED_RR if inherited else os.SCHED_RR | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(1))
        before = current
    try:
        yield
    finally:
        if before is not None:
            policy, parameters = before
            # Only root may clear the flag for reset on fork; it does no harm if it stays.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)
                os.sched_setscheduler(0, policy, parameters)


def drop_real_time_priority(thread: threading.Thread) -> None:
    """Take real-time priority from a thread that does not end: it must not starve other programs."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        os.sched_setscheduler(thread.native_id, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))  # type: ignore[arg-type]
