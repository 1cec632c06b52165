"""Pictures of a robot, one an iteration: anti-aliased shapes on a small numpy canvas, fast enough to film episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from animat.errors import InvalidArgument
from animat.robots.base import Robot
from animat.robots.capabilities import capability

Colour = tuple[int, int, int]
Point = tuple[float, float]
Plane = np.ndarray[Any, np.dtype[np.float64]]
Picture = UInt8[np.ndarray, "height width 3"]

PAPER: Colour = (250, 250, 248)
INK: Colour = (52, 58, 64)
RAIL: Colour = (206, 212, 218)
BODY: Colour = (51, 102, 170)
ACCENT: Colour = (222, 110, 50)
GOAL: Colour = (90, 170, 110)
GOAL_FILL: Colour = (214, 236, 219)
TRAIL: Colour = (150, 178, 214)

DONE, FAILED, AIM, EDGE = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
"""Of figures of paths: episodes that ended well or not, where they should end, and limits (Okabe and Ito's palette)."""


def draw_robot(
    robot: Robot[Any],
    observation: Float[np.ndarray, " observations"],
    *,
    command: float = 0.0,
    earlier: Sequence[Float[np.ndarray, " observations"]] = (),
    height_px: int = 360,
) -> Picture:
    """A picture of a robot as an observation describes it.

    Args:
        robot: one with a method `draw`.
        observation: in the robot's own units.
        command: the motor command u in [-1, 1] that led here.
        earlier: the observations of the episode before this one.
        height_px: height of the picture; its width follows.

    Returns:
        red, green, blue from 0 to 255.

    Raises:
        InvalidArgument: for a robot that has no such method, or one that gives no picture.
    """
    drawn = capability(robot, "draw")(np.asarray(observation, np.float64), command, earlier, height_px)
    picture = np.asarray(drawn)
    if picture.shape[2:] != (3,) or picture.dtype != np.uint8:
        got = f"{picture.dtype} of shape {picture.shape}"
        raise InvalidArgument(f"{robot.name}.draw: expected uint8 of shape (height, width, 3), got {got}")
    return picture


class Canvas:
    """A picture in the making; coordinates are in the task's units, turned into pixels here.

    Each shape is painted by its signed distance, so that edges fade over one pixel.
    """

    def __init__(self, width_px: int, height_px: int, origin_px: Point, px_per_unit: float) -> None:
        """An empty picture with the task's (0, 0) at `origin_px` (x right, y down)."""
        self._pixels = np.empty((height_px, width_px, 3))
        self._pixels[:] = PAPER
        self._origin_px, self._scale = np.array(origin_px), px_per_unit

    def stroke(self, points: Sequence[Point], width: float, colour: Colour) -> None:
        """A line through the points with round ends, `width` wide; a single point is a disc."""
        placed = [self._origin_px + self._scale * np.array(point) for point in points]
        for start, end in zip(placed, placed[1:] or placed, strict=False):

            def distance(x: Plane, y: Plane, start: Plane = start, end: Plane = end) -> Plane:
                along = end - start
                length = float(along @ along)
                share = np.clip(((x - start[0]) * along[0] + (y - start[1]) * along[1]) / (length or 1.0), 0, 1)
                off_x, off_y = x - start[0] - share * along[0], y - start[1] - share * along[1]
                away: Plane = np.sqrt(off_x**2 + off_y**2)
                return away

            self._paint(distance, np.minimum(start, end), np.maximum(start, end), width * self._scale / 2, colour)

    def disc(self, centre: Point, radius: float, colour: Colour) -> None:
        """A filled circle."""
        self.stroke([centre], 2 * radius, colour)

    def box(self, low: Point, high: Point, corner: float, colour: Colour) -> None:
        """A filled rectangle from corner to corner, its corners rounded by the radius `corner`."""
        inset = np.array([corner, corner])
        low_px = self._origin_px + self._scale * (np.array(low) + inset)
        high_px = self._origin_px + self._scale * (np.array(high) - inset)

        def distance(x: Plane, y: Plane) -> Plane:
            outside_x = np.maximum(np.maximum(low_px[0] - x, x - high_px[0]), 0)
            outside_y = np.maximum(np.maximum(low_px[1] - y, y - high_px[1]), 0)
            away: Plane = np.sqrt(outside_x**2 + outside_y**2)
            return away

        self._paint(distance, low_px, high_px, corner * self._scale, colour)

    def picture(self) -> Picture:
        """What was drawn so far."""
        pixels: Picture = np.rint(self._pixels).astype(np.uint8)
        return pixels

    def _paint(
        self,
        distance: Callable[[Plane, Plane], Plane],
        low_px: np.ndarray,
        high_px: np.ndarray,
        radius_px: float,
        colour: Colour,
    ) -> None:
        # Only the pixels around the shape are computed: a long path stays cheap. Pixel i covers i to i + 1.
        height, width, _ = self._pixels.shape
        x0, y0 = (max(0, math.floor(v - radius_px - 1)) for v in low_px)
        x1, y1 = (min(n, math.ceil(v + radius_px + 1)) for v, n in zip(high_px, (width, height), strict=True))
        if x0 >= x1 or y0 >= y1:
            return
        y, x = np.mgrid[y0:y1, x0:x1] + 0.5
        cover = np.clip(radius_px - distance(x, y) + 0.5, 0, 1)[..., None]
        region = self._pixels[y0:y1, x0:x1]
        region += cover * (np.array(colour) - region)
