"""How fast work goes, and when it will be done, by what was seen of it since the page looks."""

from __future__ import annotations

import time
from collections import deque

_SPAN_S, _EVERY_S = 60.0, 1.0


class Speed:
    """Amounts of work that were seen to be done, and when."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()

    def see(self, done: float) -> None:
        """Note that so much is done by now."""
        now_s = time.monotonic()
        if self._seen and done < self._seen[-1][1]:
            self._seen.clear()
        if not self._seen or now_s - self._seen[-1][0] >= _EVERY_S:
            self._seen.append((now_s, done))
        while len(self._seen) > 2 and now_s - self._seen[0][0] > _SPAN_S:
            self._seen.popleft()

    @property
    def per_s(self) -> float | None:
        """In the last minute; None while nothing was seen to be done."""
        if len(self._seen) < 2:
            return None
        (from_s, before), (to_s, after) = self._seen[0], self._seen[-1]
        return (after - before) / (to_s - from_s) if after > before else None

    def left_s(self, left: float) -> float | None:
        """Until so much more is done; None where that is not known."""
        return None if self.per_s is None else left / self.per_s
