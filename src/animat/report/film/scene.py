"""The data of a film: moments of a robot that is moved by neurons, and their spikes if recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.robots.base import Robot


@dataclass(frozen=True)
class Moment:
    """The state from one time on.

    Attributes:
        iteration: -1 before the robot moves.
        turn: number that decides how the episode starts.
        observation: empty if it was not recorded.
        command: that led to this state; None if the robot was not moved.
        total: sum of the episode's rewards so far.
        delivered, rate_hz: the condition's label, and the response; "" and NaN for none.
    """

    time_s: float
    agent: str
    episode: int
    iteration: int
    turn: int
    observation: tuple[float, ...]
    command: float | tuple[float, ...] | None = None
    total: float = 0.0
    delivered: str = ""
    rate_hz: float = math.nan


@dataclass(frozen=True, eq=False)
class Scene:
    """A stretch of time with everything that is drawn.

    Attributes:
        moments: in order of time; those of the first episode from its start, so that a host robot can be replayed.
        n_channels: of the array; 0 without an array, when only responses are shown.
        lost_bytes: bytes at the end of a session's log that are torn or damaged and not shown.
        seed: of the session or film, which decides how a host robot starts.
    """

    title: str
    robot: Robot[Any]
    conditions: tuple[str, ...]
    moments: tuple[Moment, ...]
    start_s: float
    stop_s: float
    spike_times_s: Float64[np.ndarray, " spikes"] = field(default_factory=lambda: np.empty(0))
    spike_channels: Int64[np.ndarray, " spikes"] = field(default_factory=lambda: np.empty(0, np.int64))
    pulse_times_s: Float64[np.ndarray, " pulses"] = field(default_factory=lambda: np.empty(0))
    n_channels: int = 0
    lost_bytes: int = 0
    seed: int = 0
