"""Surroundings of a driving robot: straight walls and round obstacles, their distances, and free places."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field

from animat.lazy import Array
from animat.records import Number
from animat.robots.base import Size

Wall = tuple[Number, Number, Number, Number]
"""From (x, y) to (x, y), in metres, without thickness."""

Obstacle = tuple[Number, Number, Size]
"""Centre x and y, and radius, in metres."""

MOST_SHAPES = 200
Walls = Annotated[tuple[Wall, ...], Field(max_length=MOST_SHAPES)]
Obstacles = Annotated[tuple[Obstacle, ...], Field(max_length=MOST_SHAPES)]

MOST_PLACES = 1_000_000


class Surroundings(NamedTuple):
    """Walls and obstacles."""

    walls: tuple[Wall, ...]
    obstacles: tuple[Obstacle, ...]

    def clearance_m(self, x_m: Float[Array, "*places"], y_m: Float[Array, "*places"]) -> Float[Array, "*places"]:
        """Distance to the nearest wall or obstacle's edge; below 0 inside an obstacle, infinite if there is nothing."""
        xp = x_m.__array_namespace__()
        distance_m: Array = xp.full_like(x_m, math.inf)
        for x1, y1, x2, y2 in self.walls:
            along = ((x_m - x1) * (x2 - x1) + (y_m - y1) * (y2 - y1)) / max((x2 - x1) ** 2 + (y2 - y1) ** 2, 1e-18)
            nearest = xp.clip(along, 0.0, 1.0)
            to_wall_m = xp.hypot(x_m - x1 - nearest * (x2 - x1), y_m - y1 - nearest * (y2 - y1))
            distance_m = xp.minimum(distance_m, to_wall_m)
        for x, y, radius in self.obstacles:
            distance_m = xp.minimum(distance_m, xp.hypot(x_m - x, y_m - y) - radius)
        return distance_m

    def along_rays_m(
        self, x_m: Float[Array, ""], y_m: Float[Array, ""], directions_rad: Float[Array, " rays"]
    ) -> Float[Array, " rays"]:
        """Distance from a place to the first wall or obstacle in given directions; infinite if there is nothing.

        A ray from p along the unit vector d meets the wall from a to b at t = (a - p) x (b - a) / d x (b - a), if that
        is at least 0 and s = (a - p) x d / d x (b - a) lies in [0, 1]. It meets the circle about c with radius r at
        t = h - sqrt(h^2 - |c - p|^2 + r^2) with h = (c - p) . d, or at 0 from within. The arguments are all NumPy or
        all JAX arrays.
        """
        xp = directions_rad.__array_namespace__()
        dx, dy = xp.cos(directions_rad), xp.sin(directions_rad)
        nearest: Array = xp.full_like(dx, math.inf)
        if self.walls:
            x1, y1, x2, y2 = (xp.asarray(of, dtype=dx.dtype)[:, None] for of in zip(*self.walls, strict=True))
            cross = dx * (y2 - y1) - dy * (x2 - x1)
            met = xp.abs(cross) > 1e-9
            cross = xp.where(met, cross, 1.0)
            t = ((x1 - x_m) * (y2 - y1) - (y1 - y_m) * (x2 - x1)) / cross
            s = ((x1 - x_m) * dy - (y1 - y_m) * dx) / cross
            # A ray into a corner must not slip between two walls.
            met &= (t >= 0) & (s >= -1e-6) & (s <= 1 + 1e-6)
            nearest = xp.minimum(nearest, xp.min(xp.where(met, t, math.inf), axis=0))
        if self.obstacles:
            x, y, radius = (xp.asarray(of, dtype=dx.dtype)[:, None] for of in zip(*self.obstacles, strict=True))
            ahead = (x - x_m) * dx + (y - y_m) * dy
            outside = (x - x_m) ** 2 + (y - y_m) ** 2 - radius**2
            under = ahead**2 - outside
            met = (under >= 0) & (ahead >= 0) & (outside > 0)
            t = xp.where(met, ahead - xp.sqrt(xp.maximum(under, 0.0)), math.inf)
            nearest = xp.minimum(nearest, xp.min(xp.where(outside <= 0, 0.0, t), axis=0))
        return nearest

    def box_m(self) -> tuple[float, float, float, float]:
        """The smallest rectangle around all walls and obstacles: left, top, right and bottom."""
        points = [(x, y) for wall in self.walls for x, y in (wall[:2], wall[2:])]
        points += [(x + sign * r, y + sign * r) for x, y, r in self.obstacles for sign in (-1, 1)]
        xs, ys = zip(*points, strict=True)
        return min(xs), min(ys), max(xs), max(ys)


@lru_cache(maxsize=64)
def places_within_reach(
    around: Surroundings, start_m: tuple[float, float], room_m: float, spacing_m: float
) -> Float[np.ndarray, "places 2"]:
    """The places of a square lattice through the start to which a disc can be moved from the start.

    Its centre stays `room_m` or more from walls and obstacles, and moves from a place to its four neighbours. They are
    `spacing_m` away, which must be less than twice `room_m`, or the disc passes through walls. The start is one of the
    places; there are none without room at the start, or with over a million to check.
    """
    from scipy.ndimage import label

    left, top, right, bottom = around.box_m() if around.walls or around.obstacles else (*start_m, *start_m)
    spans_m = ((start_m[0], left, right), (start_m[1], top, bottom))
    ends = [((low - at) / spacing_m, (high - at) / spacing_m) for at, low, high in spans_m]
    # A single side may be too long for the memory, or infinite.
    if max(abs(end) for side in ends for end in side) > MOST_PLACES:
        return np.zeros((0, 2))
    steps = [np.arange(math.floor(low), math.ceil(high) + 1) for low, high in ends]
    if len(steps[0]) * len(steps[1]) > MOST_PLACES:
        return np.zeros((0, 2))
    x_m, y_m = np.meshgrid(*(at + spacing_m * of for at, of in zip(start_m, steps, strict=True)), indexing="ij")
    regions, _ = label(around.clearance_m(x_m, y_m) >= room_m)
    own = regions[np.ix_(steps[0] == 0, steps[1] == 0)].max(initial=0)
    reached = (regions == own) & (own > 0)
    return np.stack([x_m[reached], y_m[reached]], axis=1)
