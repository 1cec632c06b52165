"""From a session's log: the responses that moved the policies' robots, and the outcomes of episodes with a goal."""

from __future__ import annotations

from collections.abc import Collection
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

_TICK = [("condition", np.int64), ("rate_hz", np.float64), ("is_burst", np.bool_), ("active_ratio", np.float64)]
_TICK += [(name, np.float64) for name in ("read_s", "late_s", "first_s")] + [("episode", np.int64), ("moved", np.bool_)]


class CommandSums(NamedTuple):
    """How often each condition was presented, and the sum of the commands that it led to, each of them separately."""

    presented: Int64[np.ndarray, "*any conditions"]
    total: Float64[np.ndarray, "*any conditions commands"]

    @property
    def mean(self) -> Float64[np.ndarray, "*any conditions commands"]:
        """The mean commands of each condition; NaN for one that was never presented."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.total / self.presented[..., None])

    def summed(self, axis: int) -> CommandSums:
        """Summed over an axis of policies or episodes."""
        return CommandSums(self.presented.sum(axis=axis), self.total.sum(axis=axis))


@dataclass(frozen=True, eq=False)
class SessionResponses:
    """Responses in the complete episodes of policies, without the warm-up.

    Attributes:
        responses: in order of time, on the session's clock, with everything that was presented between them.
        episode: index in `returns` of each response's episode.
        moved: whether it moved the robot, and was not repeated or skipped as a burst; `command`: NaN if it did not.
    """

    responses: Responses
    episode: Int64[np.ndarray, " responses"]
    late_s: Float64[np.ndarray, " responses"]
    moved: Bool[np.ndarray, " responses"]
    command: Float64[np.ndarray, "responses *commands"]
    returns: Float64[np.ndarray, " episodes"]

    @property
    def commanded(self) -> CommandSums:
        """Commands of the responses that moved the robot in each episode, shape (episodes, conditions, ...)."""
        shape, command = (len(self.returns), len(self.responses.conditions)), np.atleast_2d(self.command.T).T
        presented, total = np.zeros(shape, np.int64), np.zeros((*shape, command.shape[1]))
        at = self.episode[self.moved], self.responses.condition[self.moved]
        np.add.at(presented, at, 1)
        np.add.at(total, at, command[self.moved])
        return CommandSums(presented, total)


def read_responses(session: Session, loop: Loop, policies: Collection[str]) -> SessionResponses:
    """Read the responses to policies, by their names, from the log of a session that has ended."""
    whole = [each for each in session.episodes if each.agent in policies and each.is_whole]
    place = {each.number: row for row, each in enumerate(whole)}
    shape = loop.decoder.percentiles_shape[:-1]
    no_command, commands, read_hz, rows = np.full(shape, np.nan).tolist(), [], [], []
    for record in session.log.fields():
        tick = record.get("tick")
        if not tick or not tick["pulse_time_s"]:
            continue
        episode, moved = place.get(tick["episode"], -1) if tick["iteration"] >= 0 else -1, tick["handled"] == "used"
        values = (tick[name] for name in ("delivered", "rate_hz", "is_burst", "active_ratio", "read_after_s", "late_s"))
        rows.append((*values, tick["pulse_time_s"][0], episode, moved))
        if episode >= 0:
            read_hz.append(tick.get("readout_hz") or [tick["rate_hz"]])
            commands.append(tick["command"] if moved else no_command)
    every = np.array(rows, _TICK)
    at = np.flatnonzero(every["episode"] >= 0)
    acted = every[at]
    x_hz = loop.readouts.squeeze(np.array(read_hz, np.float64).reshape(-1, len(loop.readouts)))
    is_rested = every["first_s"] - np.concatenate([[-np.inf], every["read_s"][:-1]]) > SILENCE_S
    responses = Responses(
        condition=acted["condition"],
        rate_hz=acted["rate_hz"],
        active_ratio=acted["active_ratio"],
        is_burst=acted["is_burst"],
        conditions=loop.conditions,
        window_ms=loop.window_ms,
        n_channels=len(session.log.header["channels"]["label"]),
        threshold=loop.burst_threshold,
        separability=float("nan"),
        presentation=loop.presentation,
        time_s=acted["read_s"],
        presented=Trials(every["condition"], every["rate_hz"], every["is_burst"], is_rested, every["read_s"]),
        place=at,
        readouts=loop.readouts,
        readout_hz=None if loop.readouts.are_all else x_hz,
    )
    returns = np.array([each.total for each in whole], np.float64)
    command = np.array(commands, np.float64).reshape(len(acted), *shape)
    return SessionResponses(responses, acted["episode"], acted["late_s"], acted["moved"], command, returns)


def outcomes(robot: Robot[Any], session: Session) -> dict[int, Outcome]:
    """The outcome of each complete episode, by its number; empty for a robot without a goal."""
    if not isinstance(robot, RobotWithGoal):
        return {}
    observed = {episode.number: [episode.start] for episode in session.episodes if episode.is_whole}
    for tick in session.ticks:
        if tick.reward is not None and tick.episode in observed:
            observed[tick.episode].append(tick.observation)
    return {number: robot.outcome_of(np.array(path, np.float32)) for number, path in observed.items()}
