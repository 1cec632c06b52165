"""Detour: a small two-wheeled robot drives to a goal behind one of four screens that stand around it."""

from __future__ import annotations

from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.records import record
from animat.robots.registry import register_robot
from animat.robots.surroundings import Obstacles, Surroundings, Walls
from animat.robots.wheels import ARENA, Wheels

_NEAR_M, _FAR_M, _LEFT_M, _RIGHT_M = 0.29, 0.71, 0.42, 0.58
_SCREENS = (
    (_LEFT_M, _NEAR_M, _RIGHT_M, _NEAR_M),
    (_LEFT_M, _FAR_M, _RIGHT_M, _FAR_M),
    (_NEAR_M, _LEFT_M, _NEAR_M, _RIGHT_M),
    (_FAR_M, _LEFT_M, _FAR_M, _RIGHT_M),
)
_POSTS = tuple((x, y, 0.015) for x1, y1, x2, y2 in _SCREENS for x, y in ((x1, y1), (x2, y2)))
"""At both ends of each screen, as no sensor detects the end of a wall without thickness."""


@final
@register_robot
@record
class Detour(Wheels):
    """The two-wheeled robot in an arena where the straight path from the start to the goal is always blocked.

    A goal is drawn from the places that the robot can reach but not by driving straight. By default the start is in the
    middle of four screens, and goals are behind them.

    Raises:
        InvalidArgument: as `Wheels`, and for surroundings in which no straight path is blocked.

    Source: the detour problem, in which an animal has to move away from what it wants (Köhler 1921,
    Intelligenzprüfungen an Menschenaffen, ch. 1).
    """

    walls: Walls = (*ARENA, *_SCREENS)
    obstacles: Obstacles = _POSTS

    name: ClassVar[str] = "detour"
    paper_iterations: ClassVar[int] = 2_000_000

    def __post_init__(self) -> None:
        if len(super()._goals_m) and not len(self._goals_m):
            raise InvalidArgument("walls, obstacles: expected some that block the straight path to places, got none")
        super().__post_init__()

    def heuristic(self, observation: Any) -> Any:
        """Towards the goal; if something is on the goal's side, along it at some distance, past its end."""
        xp = observation.__array_namespace__()
        bearing = observation[9]
        right, left = observation[:4], xp.flip(observation[4:8])
        # The side on which the sensors see more: 1 is right, -1 is left.
        side = xp.where(xp.sum(left) > xp.sum(right), -1.0, 1.0)
        proximity = xp.where(side < 0, left, right)
        is_blocked = (xp.sum(proximity) > 0.05) & (bearing * side > -0.2)
        along = side * (0.5 * (0.35 - proximity[2]) - 2 * proximity[0] - proximity[1])
        turn = xp.where(is_blocked, along, xp.clip(bearing, -1.0, 1.0))
        ahead = xp.clip(1 - 0.7 * xp.abs(turn), 0.0, 1.0)
        return xp.clip(xp.stack([ahead + turn, ahead - turn]), -1.0, 1.0)

    @property
    def _goals_m(self) -> Float[np.ndarray, "goals 2"]:
        """Places within reach that the robot cannot drive straight to.

        Both ends of a path are free. So if the body touches a wall on it, its centre crosses the wall, or a disc of the
        body's radius around one of the wall's ends.
        """
        places, radius_m = super()._goals_m, self.body_radius_m
        discs = [(x_m, y_m, r_m + radius_m) for x_m, y_m, r_m in self.obstacles]
        discs += [(x_m, y_m, radius_m) for wall in self.walls for x_m, y_m in (wall[:2], wall[2:])]
        grown, start_m = Surroundings(self.walls, tuple(discs)), np.array([self.start_x_m, self.start_y_m])
        are_blocked = []
        # In batches: all at once would not fit in memory for a million places and 200 walls.
        for ends_m in np.array_split(places, 1 + len(places) // 10_000):
            x_m, y_m = (ends_m - start_m).T
            free_m = grown.along_rays_m(start_m[0], start_m[1], np.arctan2(y_m, x_m))
            are_blocked.append(free_m < np.hypot(x_m, y_m))
        return np.asarray(places[np.concatenate(are_blocked)])
