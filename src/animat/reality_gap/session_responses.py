"""From a session's log: the responses that moved the policies' robots, and the outcomes of episodes with a goal."""

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


class CommandSums(NamedTuple):
    """The commands that each condition led to.

    Attributes:
        presented: how often each condition was presented, shape (..., conditions).
        total: the sum of its commands, the same shape; several commands separately, shape (..., conditions, commands).
    """

    presented: Int64[np.ndarray, "*any conditions"]
    total: Float64[np.ndarray, "*any"]

    @property
    def mean(self) -> Float64[np.ndarray, "*any"]:
        """The mean command of each condition, in the shape of `total`; NaN for one that was never presented."""
        of_several = self.total.ndim > self.presented.ndim
        with np.errstate(invalid="ignore"):
            return np.asarray(self.total / (self.presented[..., None] if of_several else self.presented))

    def summed(self, axis: int) -> CommandSums:
        """Summed over an axis of policies or episodes."""
        return CommandSums(self.presented.sum(axis=axis), self.total.sum(axis=axis))


@dataclass(frozen=True, eq=False)
class SessionResponses:
    """Responses in the complete episodes of policies, without the warm-up.

    Attributes:
        responses: in order of time, on the session's clock, with everything that was presented between them.
        episode: index in `returns` of each response's episode.
        late_s: lateness of its pulses.
        moved: whether it moved the robot, and was not repeated or skipped as a burst.
        command: with which it moved the robot; NaN if it did not.
        returns: of the episodes, in order of time.
    """

    responses: Responses
    episode: Int64[np.ndarray, " responses"]
    late_s: Float64[np.ndarray, " responses"]
    moved: Bool[np.ndarray, " responses"]
    command: Float64[np.ndarray, "responses *commands"]
    returns: Float64[np.ndarray, " episodes"]

    @property
    def commanded(self) -> CommandSums:
        """Commands of the responses that moved the robot in each episode, shape (episodes, conditions)."""
        shape, moved = (len(self.returns), len(self.responses.conditions)), self.moved
        presented, total = np.zeros(shape, np.int64), np.zeros((*shape, *self.command.shape[1:]))
        at = self.episode[moved], self.responses.condition[moved]
        np.add.at(presented, at, 1)
        np.add.at(total, at, self.command[moved])
        return CommandSums(presented, total)


def read_responses(session: Session, loop: Loop, policies: Collection[str]) -> SessionResponses:
    """Read the responses to policies, by their names, from the log of a session that has ended."""
    whole = [each for each in session.episodes if each.agent in policies and each.is_whole]
    place = {each.number: row for row, each in enumerate(whole)}
    presented: list[tuple[int, float, bool, float, float]] = []
    acted: list[tuple[int, int, float, float, bool]] = []
    shape = loop.decoder.percentiles_shape[:-1]
    no_command, commands = np.full(shape, np.nan).tolist(), []
    read_hz: list[Sequence[float]] = []
    for record in session.log.records.fields():
        tick = record.get("tick")
        if not tick or not tick["pulse_time_s"]:
            continue
        if tick["iteration"] >= 0 and tick["episode"] in place:
            moved = tick["handled"] == "used"
            read_hz.append(tick.get("readout_hz") or [tick["rate_hz"]])
            commands.append(tick["command"] if moved else no_command)
            acted.append((place[tick["episode"]], len(presented), tick["late_s"], tick["active_ratio"], moved))
        presented.append(
            (tick["delivered"], tick["rate_hz"], tick["is_burst"], tick["pulse_time_s"][0], tick["read_after_s"])
        )
    condition, rate_hz, is_burst, first_s, read_s = _columns(presented, 5)
    episode, at, late_s, active_ratio, moved = _columns(acted, 5)
    at = at.astype(np.int64)
    x_hz = loop.readouts.squeeze(np.array(read_hz, np.float64).reshape(-1, len(loop.readouts)))
    is_rested = first_s - np.concatenate([[-np.inf], read_s[:-1]]) > SILENCE_S
    presentations = Trials(condition.astype(np.int64), rate_hz, is_burst.astype(bool), is_rested, read_s)
    responses = Responses(
        condition=presentations.condition[at],
        rate_hz=presentations.rate_hz[at],
        active_ratio=active_ratio,
        is_burst=presentations.is_burst[at],
        conditions=loop.conditions,
        window_ms=loop.window_ms,
        n_channels=len(session.log.header["channels"]["label"]),
        threshold=loop.burst_threshold,
        separability=float("nan"),
        presentation=loop.presentation,
        time_s=read_s[at],
        presented=presentations,
        place=at,
        readouts=loop.readouts,
        readout_hz=None if loop.readouts.are_all else x_hz,
    )
    returns = np.array([each.total for each in whole], np.float64)
    command = np.array(commands, np.float64).reshape(len(acted), *shape)
    return SessionResponses(responses, episode.astype(np.int64), late_s, moved.astype(bool), command, returns)


def outcomes(robot: Robot[Any], session: Session) -> dict[int, Outcome]:
    """The outcome of each complete episode, by its number; empty for a robot without a goal."""
    if not isinstance(robot, RobotWithGoal):
        return {}
    observed = {episode.number: [episode.start] for episode in session.episodes if episode.is_whole}
    for tick in session.ticks:
        if tick.reward is not None and tick.episode in observed:
            observed[tick.episode].append(tick.observation)
    return {number: robot.outcome_of(np.array(path, np.float32)) for number, path in observed.items()}


def _columns(rows: Sequence[tuple[float, ...]], n: int) -> Float64[np.ndarray, "columns rows"]:
    return np.array(rows, np.float64).reshape(-1, n).T
