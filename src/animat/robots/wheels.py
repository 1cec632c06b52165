"""Wheels: a small two-wheeled robot finds a goal among obstacles with its sensors, without knowing its position."""

from __future__ import annotations

from typing import Any, ClassVar, final

from animat.records import record
from animat.robots.registry import register_robot
from animat.robots.surroundings import Obstacles
from animat.robots.wheeled import Wheeled


@final
@register_robot
@record
class Wheels(Wheeled):
    """A wheeled robot with four round obstacles around the start, and goals anywhere in the arena."""

    obstacles: Obstacles = ((0.3, 0.3, 0.08), (0.72, 0.35, 0.06), (0.35, 0.72, 0.06), (0.7, 0.7, 0.08))

    name: ClassVar[str] = "wheels"

    def heuristic(self, observation: Any) -> Any:
        """Towards the goal and away from what the front sensors see, more slowly the more it turns."""
        xp = observation.__array_namespace__()
        bearing = observation[9]
        right = 2 * observation[0] + 2 * observation[1] + observation[2]
        left = 2 * observation[7] + 2 * observation[6] + observation[5]
        turn = xp.clip(bearing, -1.0, 1.0) + left - right
        ahead = xp.clip(1 - xp.abs(turn), 0.25, 1.0)
        return xp.clip(xp.stack([ahead + turn, ahead - turn]), -1.0, 1.0)
