"""What a session's log says of its episodes: the responses that moved the policies' robots, and what goals came to."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session
from animat.coding.mapping import N_PERCENTILES
from animat.goals.robot import RobotWithGoal
from animat.goals.tally import Outcome
from animat.responses.extraction import SILENCE_S
from animat.responses.responses import Presented, Responses
from animat.robots.base import Robot


class Passes(NamedTuple):
    """Counts of each condition.

    Attributes:
        presented: how often, shape (..., conditions).
        passed: how often the response was P50 or more, the same shape; of several readouts each on its own, shape
            (..., conditions, readouts).
    """

    presented: Int64[np.ndarray, "*any conditions"]
    passed: Int64[np.ndarray, "*any"]

    @property
    def share(self) -> Float64[np.ndarray, "*any"]:
        """P(x >= P50) of each condition, in the shape of `passed`; NaN for one that was never presented."""
        of_several = self.passed.ndim > self.presented.ndim
        with np.errstate(invalid="ignore"):
            return np.asarray(self.passed / (self.presented[..., None] if of_several else self.presented))

    def summed(self, axis: int) -> Passes:
        """Over policies or episodes."""
        return Passes(self.presented.sum(axis=axis), self.passed.sum(axis=axis))


@dataclass(frozen=True, eq=False)
class Answered:
    """Responses in the episodes of policies that came to their end, without the warm-up.

    Attributes:
        responses: in the order of time, on the session's clock, with all that the culture was presented between them.
        episode: which of `returns` each one belongs to, shape (responses,).
        late_s: by how much its pulses came late, shape (responses,).
        moved: whether it moved the robot, and was not repeated or skipped as a burst, shape (responses,).
        passed: whether it was P50 or more, as P50 was held or had followed by then, shape (responses,); of several
            readouts each on its own, shape (responses, readouts).
        returns: of the episodes, in the order of time, shape (episodes,).
    """

    responses: Responses
    episode: Int64[np.ndarray, " responses"]
    late_s: Float64[np.ndarray, " responses"]
    moved: Bool[np.ndarray, " responses"]
    passed: Bool[np.ndarray, "responses *readouts"]
    returns: Float64[np.ndarray, " episodes"]

    @property
    def passes(self) -> Passes:
        """Of the responses that moved the robot in each episode, shape (episodes, conditions)."""
        shape, readouts = (len(self.returns), len(self.responses.conditions)), self.passed.shape[1:]
        presented, passed = np.zeros(shape, np.int64), np.zeros((*shape, *readouts), np.int64)
        np.add.at(presented, (self.episode, self.responses.condition), self.moved)
        np.add.at(passed, (self.episode[self.moved], self.responses.condition[self.moved]), self.passed[self.moved])
        return Passes(presented, passed)

    @property
    def span_min(self) -> float:
        """From the first response to the last."""
        time_s = self.responses.time_s
        return 0.0 if time_s is None or not len(time_s) else float(time_s[-1] - time_s[0]) / 60


def answered(session: Session, loop: Loop, policies: Collection[str]) -> Answered:
    """Read what policies were answered from a session's log.

    Args:
        session: that ended.
        policies: their names among the agents.
    """
    whole = [each for each in session.episodes if each.agent in policies and each.is_whole]
    place = {each.number: row for row, each in enumerate(whole)}
    p50_hz = np.asarray(loop.percentiles, np.float64)[..., N_PERCENTILES // 2]
    presented: list[tuple[int, float, bool, float, float]] = []
    acted: list[tuple[int, int, float, float, bool]] = []
    passes: list[Bool[np.ndarray, "*readouts"]] = []
    read_hz: list[Sequence[float]] = []
    for words in session.log.records.words():
        before_hz, tick = p50_hz, words.get("tick")
        # Those that a tick moved count from the next one on; logs of before have records of their own.
        if "percentiles_hz" in words:
            p50_hz = np.array(words["percentiles_hz"], np.float64)[..., N_PERCENTILES // 2]
        if not tick or not tick["pulse_time_s"]:
            continue
        if tick["iteration"] >= 0 and tick["episode"] in place:
            moved = tick["handled"] == "used"
            read_hz.append(tick.get("readout_hz") or [tick["rate_hz"]])
            passes.append(loop.readouts.alone(np.array(read_hz[-1])) >= before_hz)
            acted.append((place[tick["episode"]], len(presented), tick["late_s"], tick["active_ratio"], moved))
        presented.append(
            (tick["delivered"], tick["rate_hz"], tick["is_burst"], tick["pulse_time_s"][0], tick["read_after_s"])
        )
    condition, rate_hz, is_burst, first_s, read_s = _columns(presented, 5)
    episode, at, late_s, active_ratio, moved = _columns(acted, 5)
    at = at.astype(np.int64)
    x_hz = loop.readouts.alone(np.array(read_hz, np.float64).reshape(-1, len(loop.readouts)))
    before_s = np.concatenate([[-np.inf], read_s[:-1]])
    is_rested = first_s - before_s > SILENCE_S
    every = Presented(condition.astype(np.int64), rate_hz, is_burst.astype(bool), is_rested, read_s)
    responses = Responses(
        condition=every.condition[at],
        rate_hz=every.rate_hz[at],
        active_ratio=active_ratio,
        is_burst=every.is_burst[at],
        conditions=loop.conditions,
        window_ms=loop.window_ms,
        n_channels=len(session.log.header["channels"]["label"]),
        threshold=loop.burst_threshold,
        separability=float("nan"),
        presentation=loop.presentation,
        time_s=read_s[at],
        presented=every,
        place=at,
        readouts=loop.readouts,
        readout_hz=None if loop.readouts.are_all else x_hz,
    )
    returns = np.array([each.total for each in whole], np.float64)
    passed = np.array(passes, bool).reshape(len(acted), *loop.decoder.percentiles_shape[:-1])
    return Answered(responses, episode.astype(np.int64), late_s, moved.astype(bool), passed, returns)


def outcomes(robot: Robot[Any], session: Session) -> dict[int, Outcome]:
    """Of each episode that came to its end, by its number, what it came to; none of a robot without a goal."""
    if not isinstance(robot, RobotWithGoal):
        return {}
    observed = {episode.number: [episode.start] for episode in session.episodes if episode.is_whole}
    for tick in session.ticks:
        if tick.reward is not None and tick.episode in observed:
            observed[tick.episode].append(tick.observation)
    return {number: robot.outcome_of(np.array(path, np.float32)) for number, path in observed.items()}


def _columns(rows: Sequence[tuple[float, ...]], n: int) -> Float64[np.ndarray, "columns rows"]:
    return np.array(rows, np.float64).reshape(-1, n).T
