"""What episodes on the culture came to, of a robot with a goal: by what its log says that was observed."""

from __future__ import annotations

from typing import Any

import numpy as np

from animat.closed_loop.session import Session
from animat.goals.robot import RobotWithGoal
from animat.goals.tally import Outcome
from animat.robots.base import Robot


def outcomes(robot: Robot[Any], session: Session) -> dict[int, Outcome]:
    """Of each episode that came to its end, by its number; none of a robot without a goal."""
    if not isinstance(robot, RobotWithGoal):
        return {}
    observed = {episode.number: [episode.start] for episode in session.episodes if episode.is_whole}
    for tick in session.ticks:
        if tick.reward is not None and tick.episode in observed:
            observed[tick.episode].append(tick.observation)
    return {number: robot.outcome_of(np.array(path, np.float32)) for number, path in observed.items()}
