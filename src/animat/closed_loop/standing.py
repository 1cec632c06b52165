"""The progress of a session for its display: whose episode it is, and the returns so far."""

from __future__ import annotations

from typing import final


@final
class Standing:
    """The episodes and returns so far; the loop's thread updates it, and other threads may read it at any time.

    Args:
        limit: most iterations of an episode.
    """

    def __init__(self, limit: int) -> None:
        self.episodes_done = 0
        self._limit = limit
        self._agent, self._return, self._iterations, self._is_over = "", 0.0, 0, True
        self._totals: dict[str, tuple[float, int]] = {}
        """Sum and number of each agent's returns."""

    @property
    def episodes(self) -> float:
        """Number of finished episodes, plus the finished fraction of the current one."""
        return self.episodes_done + (0.0 if self._is_over else min(1.0, self._iterations / self._limit))

    def begin(self, agent: str) -> None:
        """Begin an agent's episode."""
        self._agent, self._return, self._iterations, self._is_over = agent, 0.0, 0, False

    def add(self, reward: float) -> None:
        """Add an iteration."""
        self._return += reward
        self._iterations += 1

    def end(self) -> None:
        """End the episode."""
        total, episodes = self._totals.get(self._agent, (0.0, 0))
        self._totals[self._agent] = total + self._return, episodes + 1
        self._is_over = True
        self.episodes_done += 1

    def note(self) -> str:
        """The return of the episode, final or so far, and each agent's mean; `"warm-up"` before the first move."""
        if not self._agent:
            return "warm-up"
        current = f"{self._agent}: return {self._return:.1f}{'' if self._is_over else ' so far'}"
        # Copied first, as the loop's thread adds to it.
        totals = tuple(self._totals.items())
        means = ", ".join(f"{name} {total / episodes:.1f}" for name, (total, episodes) in totals)
        return f"{current}; means: {means}" if means else current
