"""How a session stands, for whoever watches it: whose episode it is, and the returns so far."""

from __future__ import annotations

from typing import final


@final
class Standing:
    """The episodes and returns so far; the loop's thread tells it, and another may read it at any time.

    Args:
        limit: iterations that an episode has at most.
    """

    def __init__(self, limit: int) -> None:
        self.episodes_done = 0
        self._limit = limit
        self._agent, self._return, self._iterations, self._is_over = "", 0.0, 0, True
        self._of_each: dict[str, tuple[float, int]] = {}
        """Of each agent, the sum of its returns and how many they are."""

    @property
    def episodes(self) -> float:
        """How many episodes are done, with the part of the one under way."""
        return self.episodes_done + (0.0 if self._is_over else min(1.0, self._iterations / self._limit))

    def begin(self, agent: str) -> None:
        """An agent's episode begins."""
        self._agent, self._return, self._iterations, self._is_over = agent, 0.0, 0, False

    def add(self, reward: float) -> None:
        """An iteration is done."""
        self._return += reward
        self._iterations += 1

    def end(self) -> None:
        """The episode is done."""
        total, episodes = self._of_each.get(self._agent, (0.0, 0))
        self._of_each[self._agent] = total + self._return, episodes + 1
        self._is_over = True
        self.episodes_done += 1

    def note(self) -> str:
        """The return of the episode, whole or so far, and each agent's mean; `"warm-up"` before the first move."""
        if not self._agent:
            return "warm-up"
        told = f"{self._agent}: return {self._return:.1f}{'' if self._is_over else ' so far'}"
        # Copied at once: the loop's thread adds to it.
        of_each = tuple(self._of_each.items())
        means = ", ".join(f"{name} {total / episodes:.1f}" for name, (total, episodes) in of_each)
        return f"{told}; means: {means}" if means else told
