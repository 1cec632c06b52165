"""Pictures of a robot, one an iteration: shapes with soft edges, drawn by Pillow fast enough to film episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from animat.errors import InvalidArgument
from animat.lazy import Axes
from animat.robots.base import Robot, capability

Colour = tuple[int, int, int]
Point = tuple[float, float]
Picture = UInt8[np.ndarray, "height width 3"]

PAPER: Colour = (250, 250, 248)
INK: Colour = (52, 58, 64)
RAIL: Colour = (206, 212, 218)
BODY: Colour = (51, 102, 170)
ACCENT: Colour = (222, 110, 50)
GOAL: Colour = (90, 170, 110)
GOAL_FILL: Colour = (214, 236, 219)
TRAIL: Colour = (150, 178, 214)

_FINER = 4
"""How many times larger a picture is drawn than it is given out."""

DONE, FAILED, AIM, EDGE = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
"""Of figures of paths: episodes that ended well or not, where they should end, and limits (Okabe and Ito's palette)."""


def draw_robot(
    robot: Robot[Any],
    observation: Float[np.ndarray, " observations"],
    *,
    command: float | Float[np.ndarray, " commands"] = 0.0,
    earlier: Sequence[Float[np.ndarray, " observations"]] = (),
    height_px: int = 360,
) -> Picture:
    """A picture of a robot as an observation describes it.

    Args:
        robot: one with a method `draw`.
        observation: in the robot's own units.
        command: the motor command u in [-1, 1] that led here; of several, all or the one that they all were.
        earlier: the observations of the episode before this one.
        height_px: height of the picture; its width follows.

    Returns:
        red, green, blue from 0 to 255.

    Raises:
        InvalidArgument: for a robot that has no such method, or one that gives no picture.
    """
    if robot.n_commands > 1:
        command = np.broadcast_to(command, robot.n_commands)
    drawn = capability(robot, "draw")(np.asarray(observation, np.float64), command, earlier, height_px)
    picture = np.asarray(drawn)
    if picture.shape[2:] != (3,) or picture.dtype != np.uint8:
        got = f"{picture.dtype} of shape {picture.shape}"
        raise InvalidArgument(f"{robot.name}.draw: expected uint8 of shape (height, width, 3), got {got}")
    return picture


def draw_over_time(
    axes: Axes,
    robot: Any,
    values: Sequence[np.ndarray],
    ended_well: Sequence[bool],
    *,
    limits: Sequence[float],
    told: str,
    ylabel: str,
) -> None:
    """One number of each episode over time, in the colour of how the episode ended.

    Args:
        robot: whose iterations last `step_s`.
        values: of each episode, a number an iteration.
        limits: of the number, drawn across.
        told: what those that ended well did, in words: `end upright`.
        ylabel: what the number is, with its unit.
    """
    for course, is_good in zip(values, ended_well, strict=True):
        time_s = np.arange(len(course)) * robot.step_s
        axes.plot(time_s, course, color=DONE if is_good else FAILED, linewidth=0.7, alpha=0.8)
    for limit in limits:
        axes.axhline(limit, color=EDGE, linewidth=0.8, linestyle="--")
    axes.set_xlim(0, robot.episode_limit * robot.step_s)
    axes.set(xlabel=f"time (s); {sum(ended_well)} of {len(values)} {told}", ylabel=ylabel)


class Canvas:
    """A picture in the making; coordinates are in the task's units, turned into pixels here.

    It is drawn several times as large and made smaller at the end, so that edges are soft.
    """

    def __init__(self, width_px: int, height_px: int, origin_px: Point, px_per_unit: float) -> None:
        """An empty picture with the task's (0, 0) at `origin_px` (x right, y down)."""
        self._image = Image.new("RGB", (_FINER * width_px, _FINER * height_px), PAPER)
        self._draw = ImageDraw.Draw(self._image)
        # Pillow counts from the middle of a pixel.
        self._origin_px, self._scale = _FINER * np.array(origin_px) - 0.5, _FINER * px_per_unit

    def stroke(self, points: Sequence[Point], width: float, colour: Colour) -> None:
        """A line through the points with round ends, `width` wide; a single point is a disc."""
        self._draw.line([self._placed(point) for point in points], colour, round(width * self._scale))
        for point in points:
            self.disc(point, width / 2, colour)

    def disc(self, centre: Point, radius: float, colour: Colour) -> None:
        """A filled circle; one too small to be seen is left out."""
        if radius * self._scale <= 0.5:
            return
        self._draw.circle(self._placed(centre), radius * self._scale - 0.5, colour)

    def box(self, low: Point, high: Point, corner: float, colour: Colour) -> None:
        """A filled rectangle from corner to corner, its corners rounded by the radius `corner`."""
        (left, top), (right, bottom) = self._placed(low), self._placed(high)
        if left <= right and top <= bottom:
            self._draw.rounded_rectangle((left, top, right, bottom), max(0.0, corner) * self._scale, colour)

    def picture(self) -> Picture:
        """What was drawn so far."""
        return np.array(self._image.reduce(_FINER))

    def _placed(self, point: Point) -> Point:
        x, y = self._origin_px + self._scale * np.array(point)
        return float(x), float(y)
