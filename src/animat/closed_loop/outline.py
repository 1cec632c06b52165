"""What a session came to, counted record by record: its episodes, its ticks in numbers, and what was never answered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from animat.stimulation.stimulus import NOTHING


@dataclass
class Episode:
    """One episode of an agent.

    Attributes:
        number: in the session, from 0.
        agent: who acted.
        start: what was observed before the first step; empty where the log is of before this was written.
        total: the sum of rewards, in the task's own units.
        iterations: of the robot.
        terminated: whether it ended by itself and not at the limit.
        is_whole: whether it came to its end; what the session broke off has no return.
        pulses: that the culture was given.
        warm_up_pulses: those of them before the robot moved; all that follows is without the warm-up.
        electrode_pulses: one for each electrode of each pulse.
        trials: repeated ones among them.
        bursts: responses that were bursts.
        late: trials that came late.
    """

    number: int
    agent: str
    start: tuple[float, ...] = ()
    total: float = 0.0
    iterations: int = 0
    terminated: bool = False
    is_whole: bool = False
    pulses: int = 0
    warm_up_pulses: int = 0
    electrode_pulses: int = 0
    trials: int = 0
    bursts: int = 0
    late: int = 0


class Outline:
    """Counts as records are added, in their order.

    Attributes:
        left_out: what the culture's device reported and the session does not have, by what it is; known at the end.
        ticks: how many.
        pulses: that the culture was given.
        bursts: responses that were bursts.
        late: ticks whose pulses came late.
        latest_s: the largest lateness.
        moved_at_s: when a robot first moved, on the clock of `wall_s`; None before.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, int] = {}
        self.ticks = self.pulses = self.bursts = self.late = 0
        self.latest_s = 0.0
        self.moved_at_s: float | None = None
        self._starts: dict[int, tuple[float, ...]] = {}
        self._episodes: dict[int, Episode] = {}
        self._asked: dict[int, dict[str, Any]] = {}
        self._answered = -1

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Every episode that was begun, in the order of time."""
        return tuple(episode for _, episode in sorted(self._episodes.items()))

    @property
    def unanswered(self) -> tuple[dict[str, Any], ...]:
        """What was asked of the culture and never answered in a way that can be used: whether its pulses came is not
        known, and they are in no recording. The words of its record: when, which stimuli."""
        return tuple(
            words
            for words in self._asked.values()
            if any(pattern != NOTHING for _, pattern, *_ in words["stimuli"]) and words.get("is_admitted", True)
        )

    @property
    def unanswered_pulses(self) -> int:
        """How many pulses were asked for and never answered."""
        return sum(pattern != NOTHING for words in self.unanswered for _, pattern, *_ in words["stimuli"])

    def add(self, words: Mapping[str, Any]) -> None:
        """Count one record in."""
        kind, stretch = words["kind"], words.get("stretch")
        if kind == "seen":
            # Sessions that were logged before this was have no stretches.
            if stretch is not None:
                self._asked.pop(stretch, None)
                self._answered = max(self._answered, stretch)
            if words["tick"]:
                self._add_tick(words["tick"], electrode_pulses_of(words))
        elif kind in ("asked", "event"):
            # What is under way is looked at while it is answered: it may be written down after its answer.
            # So may it be after the event that ended it, which knows more.
            if stretch is not None and stretch > self._answered and (kind == "event" or stretch not in self._asked):
                self._asked[stretch] = dict(words)
        elif kind == "start":
            self._starts[words["episode"]] = tuple(words["observation"])
        elif kind == "end":
            self.left_out = words.get("left_out", {})

    def _add_tick(self, tick: Mapping[str, Any], electrode_pulses: int) -> None:
        number, n_pulses, is_late = tick["episode"], len(tick["pulse_time_s"]), tick["late_s"] > 0
        n_pulses -= list(tick["patterns"]).count(NOTHING)
        episode = self._episodes.get(number)
        if episode is None:
            episode = Episode(number, tick["agent"], self._starts.pop(number, ()))
            self._episodes[number] = episode
        self.ticks += 1
        self.pulses += n_pulses
        self.bursts += tick["is_burst"]
        self.late += is_late
        self.latest_s = max(self.latest_s, tick["late_s"])
        episode.pulses += n_pulses
        episode.terminated = tick["terminated"]
        episode.is_whole = tick["terminated"] or tick["truncated"]
        if tick["handled"] == "warm-up":
            episode.warm_up_pulses += n_pulses
            return
        self.moved_at_s = tick.get("wall_s") if self.moved_at_s is None else self.moved_at_s
        episode.electrode_pulses += electrode_pulses
        episode.trials += 1
        episode.bursts += tick["is_burst"]
        episode.late += is_late
        if tick["reward"] is not None:
            episode.total += tick["reward"]
            episode.iterations += 1


def electrode_pulses_of(seen: Mapping[str, Any]) -> int:
    """How many electrodes were pulsed in a stretch of time, each as often as it was, from the words of its record."""
    return sum(len(electrodes) for _, _, _, electrodes in seen["stimuli"])
