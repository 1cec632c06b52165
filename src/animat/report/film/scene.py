"""What a film shows: moments of a robot that is moved by neurons, and their spikes where these were seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.robots.base import Robot


@dataclass(frozen=True)
class Moment:
    """What is known from one time on.

    Attributes:
        time_s: from when.
        agent: who acts.
        episode: number of its episode.
        iteration: of the robot; -1 before it moves.
        turn: the robot starts its episodes of the same number alike.
        observation: in the robot's units; empty where it was not written down.
        command: that led here; None where the robot was not moved.
        total: sum of rewards of the episode so far.
        delivered: label of the condition that the neurons got; "" for none.
        rate_hz: what they answered; NaN where nobody asked.
        ended: whether the episode did.
    """

    time_s: float
    agent: str
    episode: int
    iteration: int
    turn: int
    observation: tuple[float, ...]
    command: float | tuple[float, ...] | None
    total: float
    delivered: str
    rate_hz: float
    ended: bool = False


_NO_TIMES, _NO_CHANNELS = np.empty(0), np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Scene:
    """A stretch of time with all that is drawn of it.

    Attributes:
        title: what it is.
        robot: that is moved.
        conditions: labels of what can be delivered, in their order.
        moments: in the order of time; those of the first episode from its start on, so that a body can be moved again.
        start_s, stop_s: of what is shown.
        spike_times_s, spike_channels: that were seen, in the order of time.
        pulse_times_s: of all stimuli.
        n_channels: of the array; 0: there was none, and responses alone are shown.
        lost_bytes: of a session's log, from where it is torn or damaged on; nothing of them is shown.
        runner_seed: of the runner that moved a robot on the host (`animat.closed_loop.runner.HostRunner`).
    """

    title: str
    robot: Robot[Any]
    conditions: tuple[str, ...]
    moments: tuple[Moment, ...]
    start_s: float
    stop_s: float
    spike_times_s: Float64[np.ndarray, " spikes"] = field(default_factory=_NO_TIMES.copy)
    spike_channels: Int64[np.ndarray, " spikes"] = field(default_factory=_NO_CHANNELS.copy)
    pulse_times_s: Float64[np.ndarray, " pulses"] = field(default_factory=_NO_TIMES.copy)
    n_channels: int = 0
    lost_bytes: int = 0
    runner_seed: tuple[int, int] = (0, 0)
