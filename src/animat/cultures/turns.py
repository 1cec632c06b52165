"""One thing at a time on a culture, from whatever threads it is asked for."""

from __future__ import annotations

import os
import threading
from typing import Any

from animat.cultures.safety import Guard
from animat.errors import InvalidArgument, UnsafeStimulus

_LOOK_S = 0.02
"""How often whoever waits looks whether an emergency stop ended what it waits for."""


class Turns:
    """The turns of one session: `with turns:` waits until no other thread has one.

    A session ends with its turns. What hangs in an earlier one keeps nobody waiting in the next. Whoever waits is
    refused when the guard is stopped, as what it waits for may never end.

    Args:
        guard: of the session.
    """

    def __init__(self, guard: Guard) -> None:
        self.guard = guard
        self._lock = threading.RLock()
        self._is_taken = self._is_over = False
        self._process = os.getpid()

    @property
    def is_elsewhere(self) -> bool:
        """Whether this is the copy of another process, which a fork made."""
        return self._process != os.getpid()

    def __enter__(self) -> Guard:
        if not self._lock.acquire(blocking=False):
            while not self._lock.acquire(timeout=_LOOK_S):
                if (reason := self.guard.stopped) is not None:
                    raise UnsafeStimulus(
                        "stopped",
                        f"an emergency stop is in force ({reason}) and a call from another thread has not come back: "
                        "close and open again",
                    )
        wrong = None
        if self._is_over:
            wrong = "an open one, got one that was closed meanwhile"
        elif self._is_taken:
            wrong = "one call to be over before the next, got one from within another"
        if wrong is not None:
            self._lock.release()
            raise InvalidArgument(f"culture: expected {wrong}")
        self._is_taken = True
        return self.guard

    def __exit__(self, *_: Any) -> None:
        self._is_taken = False
        self._lock.release()

    def end(self, wait_s: float) -> None:
        """Let no further call have a turn, and wait for the one that has it to end.

        Args:
            wait_s: at most so long; below 0: however long.
        """
        self._is_over = True
        if self._lock.acquire(timeout=wait_s):
            self._lock.release()

    @property
    def is_taken_elsewhere(self) -> bool:
        """Whether a call from another thread has its turn now."""
        if self._lock.acquire(blocking=False):
            self._lock.release()
            return False
        return True
