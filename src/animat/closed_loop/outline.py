"""A session in numbers, counted record by record: its episodes, ticks, and unanswered requests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from animat.stimulation.stimulus import NOTHING


@dataclass
class Episode:
    """One episode of an agent.

    Attributes:
        start: the observation before the first step; empty in older logs, which do not have it.
        total: the sum of rewards, in the task's own units.
        terminated: whether it ended by itself and not at the limit.
        is_whole: whether it was completed; an episode that the session cut short has no return.
        pulses: that the culture received.
        warm_up_pulses: those before the robot moved; the following counts exclude the warm-up.
        electrode_pulses: one for each electrode of each pulse.
        trials: including repeated ones.
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
    """Counts of a session's records, which are added in order: those of an `Episode`, for all together.

    Attributes:
        left_out: what the culture's device reported and the session lacks, by kind; known at the end.
        late: ticks whose pulses came late.
        moved_at_s: when a robot first moved, on the clock of `wall_s`; None before.
        answered: the last stretch of time that the culture answered; -1 before.
        moving: the last episode in which a robot moved; None before.
        returns: of each agent's whole episodes.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, int] = {}
        self.ticks = self.pulses = self.bursts = self.late = 0
        self.latest_s = 0.0
        self.moved_at_s: float | None = None
        self.moving: Episode | None = None
        self.returns: dict[str, list[float]] = {}
        self._starts: dict[int, tuple[float, ...]] = {}
        self._episodes: dict[int, Episode] = {}
        self._pending: dict[int, dict[str, Any]] = {}
        self.answered = -1

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Every episode that began, in order of time."""
        return tuple(episode for _, episode in sorted(self._episodes.items()))

    @property
    def unanswered(self) -> tuple[dict[str, Any], ...]:
        """Fields of requests that were never answered in a usable way: whether their pulses were delivered is not
        known, and no recording has them."""
        pending = self._pending.values()
        return tuple(fields for fields in pending if _count_pulses(fields) and fields.get("is_admitted", True))

    @property
    def unanswered_pulses(self) -> int:
        """Number of pulses that were requested and never answered."""
        return sum(map(_count_pulses, self.unanswered))

    def add(self, fields: Mapping[str, Any]) -> Episode | None:
        """Count one record; returns the episode of its tick, if it has one."""
        kind, stretch = fields["kind"], fields.get("stretch")
        if kind == "seen":
            # Older logs do not number their stretches.
            if stretch is not None:
                self._pending.pop(stretch, None)
                self.answered = max(self.answered, stretch)
            if fields["tick"]:
                return self._add_tick(fields["tick"], count_electrode_pulses(fields))
        elif kind in ("asked", "event"):
            # Another thread writes the request: its record may follow that of its answer, or that of the event that
            # ended it, which has more fields.
            if stretch is not None and stretch > self.answered and (kind == "event" or stretch not in self._pending):
                self._pending[stretch] = dict(fields)
        elif kind == "start":
            self._starts[fields["episode"]] = tuple(fields["observation"])
        elif kind == "end":
            self.left_out = fields.get("left_out", {})
        return None

    def _add_tick(self, tick: Mapping[str, Any], electrode_pulses: int) -> Episode:
        number, n_pulses, is_late = tick["episode"], len(tick["pulse_time_s"]), tick["late_s"] > 0
        n_pulses -= list(tick["patterns"]).count(NOTHING)
        episode = self._episodes.get(number)
        if episode is None:
            episode = self._episodes[number] = Episode(number, tick["agent"], self._starts.pop(number, ()))
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
            return episode
        self.moved_at_s = tick.get("wall_s") if self.moved_at_s is None else self.moved_at_s
        self.moving = episode
        episode.electrode_pulses += electrode_pulses
        episode.trials += 1
        episode.bursts += tick["is_burst"]
        episode.late += is_late
        if tick["reward"] is not None:
            episode.total += tick["reward"]
            episode.iterations += 1
        if episode.is_whole:
            self.returns.setdefault(episode.agent, []).append(episode.total)
        return episode


def _count_pulses(fields: Mapping[str, Any]) -> int:
    return sum(pattern != NOTHING for _, pattern, *_ in fields["stimuli"])


def count_electrode_pulses(fields: Mapping[str, Any]) -> int:
    """The number of electrode pulses in a stretch of time, from the fields of its record."""
    return sum(len(electrodes) for _, _, _, electrodes in fields["stimuli"])
