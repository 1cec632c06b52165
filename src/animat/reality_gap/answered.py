"""What a session's log says of its episodes: the responses that moved the policies' robots, and what goals came to."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session
from animat.goals.robot import RobotWithGoal
from animat.goals.tally import Outcome
from animat.responses.extraction import SILENCE_S
from animat.responses.responses import Responses, Trials
from animat.robots.base import Robot


class Commanded(NamedTuple):
    """What each condition led to.

    Attributes:
        presented: how often it was presented, shape (..., conditions).
        total: the sum of its commands, the same shape; of several commands each on its own, shape (..., conditions,
            commands).
    """

    presented: Int64[np.ndarray, "*any conditions"]
    total: Float64[np.ndarray, "*any"]

    @property
    def mean(self) -> Float64[np.ndarray, "*any"]:
        """The mean command of each condition, in the shape of `total`; NaN for one that was never presented."""
        of_several = self.total.ndim > self.presented.ndim
        with np.errstate(invalid="ignore"):
            return np.asarray(self.total / (self.presented[..., None] if of_several else self.presented))

    def summed(self, axis: int) -> Commanded:
        """Over policies or episodes."""
        return Commanded(self.presented.sum(axis=axis), self.total.sum(axis=axis))


@dataclass(frozen=True, eq=False)
class Answered:
    """Responses in the episodes of policies that came to their end, without the warm-up.

    Attributes:
        responses: in the order of time, on the session's clock, with all that the culture was presented between them.
        episode: which of `returns` each one belongs to, shape (responses,).
        late_s: by how much its pulses came late, shape (responses,).
        moved: whether it moved the robot, and was not repeated or skipped as a burst, shape (responses,).
        command: that it moved the robot with, shape (responses,); of several commands each on its own, shape
            (responses, commands). NaN where it did not move it.
        returns: of the episodes, in the order of time, shape (episodes,).
    """

    responses: Responses
    episode: Int64[np.ndarray, " responses"]
    late_s: Float64[np.ndarray, " responses"]
    moved: Bool[np.ndarray, " responses"]
    command: Float64[np.ndarray, "responses *commands"]
    returns: Float64[np.ndarray, " episodes"]

    @property
    def commanded(self) -> Commanded:
        """Of the responses that moved the robot in each episode, shape (episodes, conditions)."""
        shape, moved = (len(self.returns), len(self.responses.conditions)), self.moved
        presented, total = np.zeros(shape, np.int64), np.zeros((*shape, *self.command.shape[1:]))
        at = self.episode[moved], self.responses.condition[moved]
        np.add.at(presented, at, 1)
        np.add.at(total, at, self.command[moved])
        return Commanded(presented, total)

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
    presented: list[tuple[int, float, bool, float, float]] = []
    acted: list[tuple[int, int, float, float, bool]] = []
    of_each = loop.decoder.percentiles_shape[:-1]
    nothing, commands = np.full(of_each, np.nan).tolist(), []
    read_hz: list[Sequence[float]] = []
    for words in session.log.records.words():
        tick = words.get("tick")
        if not tick or not tick["pulse_time_s"]:
            continue
        if tick["iteration"] >= 0 and tick["episode"] in place:
            moved = tick["handled"] == "used"
            read_hz.append(tick.get("readout_hz") or [tick["rate_hz"]])
            commands.append(tick["command"] if moved else nothing)
            acted.append((place[tick["episode"]], len(presented), tick["late_s"], tick["active_ratio"], moved))
        presented.append(
            (tick["delivered"], tick["rate_hz"], tick["is_burst"], tick["pulse_time_s"][0], tick["read_after_s"])
        )
    condition, rate_hz, is_burst, first_s, read_s = _columns(presented, 5)
    episode, at, late_s, active_ratio, moved = _columns(acted, 5)
    at = at.astype(np.int64)
    x_hz = loop.readouts.squeeze(np.array(read_hz, np.float64).reshape(-1, len(loop.readouts)))
    before_s = np.concatenate([[-np.inf], read_s[:-1]])
    is_rested = first_s - before_s > SILENCE_S
    every = Trials(condition.astype(np.int64), rate_hz, is_burst.astype(bool), is_rested, read_s)
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
    command = np.array(commands, np.float64).reshape(len(acted), *of_each)
    return Answered(responses, episode.astype(np.int64), late_s, moved.astype(bool), command, returns)


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
