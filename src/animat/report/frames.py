"""Pictures of a robot, one an iteration: anti-aliased shapes on a small numpy canvas, fast enough to film episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from animat.errors import InvalidArgument
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

Colour = tuple[int, int, int]
Point = tuple[float, float]
Plane = np.ndarray[Any, np.dtype[np.float64]]

PAPER: Colour = (250, 250, 248)
INK: Colour = (52, 58, 64)
RAIL: Colour = (206, 212, 218)
BODY: Colour = (51, 102, 170)
ACCENT: Colour = (222, 110, 50)
GOAL: Colour = (90, 170, 110)
GOAL_FILL: Colour = (214, 236, 219)
TRAIL: Colour = (150, 178, 214)


def draw_robot(
    robot: Robot[Any],
    observation: Float[np.ndarray, " observations"],
    *,
    command: float = 0.0,
    earlier: Sequence[Float[np.ndarray, " observations"]] = (),
    height_px: int = 360,
) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of the robot as an observation describes it.

    Args:
        robot: its parameters give the sizes of what is drawn.
        observation: in the robot's own units.
        command: the motor command u in [-1, 1] that led here, drawn as an arrow (cartpole).
        earlier: the observations of the episode before this one, drawn as a path (navigation).
        height_px: height of the picture; its width follows.

    Returns:
        red, green, blue from 0 to 255.

    Raises:
        InvalidArgument: for a robot that no drawing is known for.
    """
    draw = _DRAWINGS.get(type(robot))
    if draw is None:
        known = ", ".join(kind.name for kind in _DRAWINGS)
        raise InvalidArgument(f"robot: expected one that can be drawn ({known}), got {robot.name}")
    return draw(robot, np.asarray(observation, np.float64), command, earlier, height_px)


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

    def picture(self) -> UInt8[np.ndarray, "height width 3"]:
        """What was drawn so far."""
        pixels: UInt8[np.ndarray, "height width 3"] = np.rint(self._pixels).astype(np.uint8)
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


def _draw_cartpole(
    robot: Cartpole, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int
) -> UInt8[np.ndarray, "height width 3"]:
    half_track, pole = robot.track_length_m / 2, robot.pole_length_m
    margin = 0.25 * pole
    x, angle = float(observation[0]), float(observation[2])
    # Room for a pole that hangs as well as for one that stands, once the limits allow it to hang.
    below = pole if robot.angle_limit_rad > math.pi / 2 else 0.1 * pole
    scale = height_px / (pole + below + 2 * margin)
    width_px = round(scale * 2 * (half_track + pole / 2 + margin))
    canvas = Canvas(width_px, height_px, (width_px / 2, scale * (pole + margin)), scale)

    cart_width, cart_height, thick = 0.3 * pole, 0.14 * pole, 0.045 * pole
    canvas.stroke([(-half_track, 0.0), (half_track, 0.0)], 0.02 * pole, RAIL)
    for end in (-half_track, half_track):
        canvas.stroke([(end, -0.5 * cart_height), (end, 0.5 * cart_height)], 0.02 * pole, INK)
    canvas.box((x - cart_width / 2, -cart_height / 2), (x + cart_width / 2, cart_height / 2), 0.02 * pole, INK)
    tip = (x + pole * math.sin(angle), -pole * math.cos(angle))
    canvas.stroke([(x, 0.0), tip], thick, BODY)
    canvas.disc((x, 0.0), 0.6 * thick, PAPER)
    if command:
        y = cart_height / 2 + 0.12 * pole
        head = x + 0.3 * pole * command
        back = head - math.copysign(0.05 * pole, command)
        canvas.stroke([(x, y), (head, y)], 0.02 * pole, ACCENT)
        canvas.stroke([(back, y - 0.04 * pole), (head, y), (back, y + 0.04 * pole)], 0.02 * pole, ACCENT)
    return canvas.picture()


def _draw_navigation(
    robot: Navigation, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int
) -> UInt8[np.ndarray, "height width 3"]:
    x, y, heading = (float(value) for value in observation)
    width_m, height_m = robot.arena_width_m, robot.arena_height_m
    margin = 0.06 * height_m
    scale = height_px / (height_m + 2 * margin)
    canvas = Canvas(round(scale * (width_m + 2 * margin)), height_px, (scale * margin, scale * margin), scale)
    line, size = 0.008 * height_m, 0.03 * height_m

    goal = (robot.goal_x_m, robot.goal_y_m)
    canvas.disc(goal, robot.goal_radius_m, GOAL)
    canvas.disc(goal, robot.goal_radius_m - line, GOAL_FILL)
    walls = [(0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m), (0.0, 0.0)]
    canvas.stroke(walls, line, INK)
    canvas.stroke([*((float(past[0]), float(past[1])) for past in earlier), (x, y)], line, TRAIL)
    canvas.stroke([(x, y), (x + 1.8 * size * math.cos(heading), y + 1.8 * size * math.sin(heading))], line, ACCENT)
    canvas.disc((x, y), size, BODY)
    return canvas.picture()


_DRAWINGS: dict[type[Any], Callable[..., UInt8[np.ndarray, "height width 3"]]] = {
    Cartpole: _draw_cartpole,
    Navigation: _draw_navigation,
}
