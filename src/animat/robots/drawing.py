"""Pictures of a robot, one per iteration: anti-aliased shapes, drawn by Pillow fast enough to film episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from animat.errors import InvalidArgument, first_line
from animat.lazy import Axes
from animat.robots.base import Robot, capability

Colour = tuple[int, int, int]
Point = tuple[float, float]
Pixels = UInt8[np.ndarray, "height width 3"]

PAPER: Colour = (250, 250, 248)
INK: Colour = (52, 58, 64)
RAIL: Colour = (206, 212, 218)
BODY: Colour = (51, 102, 170)
ACCENT: Colour = (222, 110, 50)
GOAL: Colour = (90, 170, 110)
GOAL_FILL: Colour = (214, 236, 219)
TRAIL: Colour = (150, 178, 214)

_FINER = 4
"""How many times larger than its final size a picture is drawn."""

WIDEST = 4.0
"""Most times that a picture is wider than it is tall: a long track would fill the memory."""

ENDED, AIM, EDGE = {True: "#0072B2", False: "#D55E00"}, "#009E73", "#8C8C8C"
"""Colours in figures of paths (Okabe-Ito): episodes that ended well or not, where they should end, and limits."""


def draw_robot(
    robot: Robot[Any],
    observation: Float[np.ndarray, " observations"],
    *,
    command: float | Float[np.ndarray, " commands"] = 0.0,
    earlier: Sequence[Float[np.ndarray, " observations"]] = (),
    height_px: int = 360,
) -> Pixels:
    """A picture of a robot as an observation, in its own units, describes it: red, green and blue from 0 to 255.

    Args:
        command: the motor command u in [-1, 1] that led to it; for several commands, an array or one value for all.
        earlier: the earlier observations of the episode.

    Raises:
        InvalidArgument: for a robot without a method `draw`, or if it raises or does not return a picture.
    """
    if robot.n_commands > 1:
        command = np.broadcast_to(command, robot.n_commands)
    draw = capability(robot, "draw")
    try:
        drawn = draw(np.asarray(observation, np.float64), command, earlier, height_px)
    except Exception as error:
        # Anything may go wrong in a user's robot.
        raise InvalidArgument(f"{robot.name}.draw: expected a picture, got {first_line(error)}") from error
    picture = np.asarray(drawn)
    if picture.shape[2:] != (3,) or picture.dtype != np.uint8:
        got = f"{picture.dtype} of shape {picture.shape}"
        raise InvalidArgument(f"{robot.name}.draw: expected uint8 of shape (height, width, 3), got {got}")
    return picture


def fit(width: float, height: float, height_px: int) -> tuple[float, int, float]:
    """Pixels per unit with which a rectangle fits a picture, the picture's width, and the space left above it (px)."""
    scale = height_px * min(1 / height, WIDEST / width)
    return scale, round(scale * width), (height_px - scale * height) / 2


def draw_over_time(
    axes: Axes,
    robot: Any,
    values: Sequence[np.ndarray],
    ended_well: Sequence[bool],
    *,
    limits: Sequence[float],
    success: str,
) -> None:
    """Draw one number of each episode over time, coloured by how the episode ended, well (`success`) or not."""
    for course, is_good in zip(values, ended_well, strict=True):
        time_s = np.arange(len(course)) * robot.step_s
        axes.plot(time_s, course, color=ENDED[is_good], linewidth=0.7, alpha=0.8)
    for limit in limits:
        axes.axhline(limit, color=EDGE, linewidth=0.8, linestyle="--")
    axes.set_xlim(0, robot.episode_limit * robot.step_s)
    axes.set_xlabel(f"time (s); {sum(ended_well)} of {len(values)} {success}")


class Canvas:
    """A picture being drawn, with coordinates in the task's units; larger, and reduced at the end, for smooth edges."""

    def __init__(self, width_px: int, height_px: int, origin_px: Point, px_per_unit: float) -> None:
        """An empty picture with the task's (0, 0) at `origin_px` (x right, y down)."""
        self._image = Image.new("RGB", (_FINER * width_px, _FINER * height_px), PAPER)
        self._draw = ImageDraw.Draw(self._image)
        # Pillow's coordinates start at the middle of a pixel.
        self._origin_px, self._scale = _FINER * np.array(origin_px) - 0.5, _FINER * px_per_unit

    def stroke(self, points: Sequence[Point], width: float, colour: Colour) -> None:
        """A line through the points with round ends, however thin; a single point is a disc."""
        self._draw.line([self._to_px(point) for point in points], colour, max(1, round(width * self._scale)))
        for point in points:
            self.disc(point, width / 2, colour)

    def disc(self, centre: Point, radius: float, colour: Colour) -> None:
        """A filled circle; one too small to be seen is left out."""
        if radius * self._scale > 0.5:
            self._draw.circle(self._to_px(centre), radius * self._scale - 0.5, colour)

    def box(self, low: Point, high: Point, corner: float, colour: Colour) -> None:
        """A filled rectangle from corner to corner, its corners rounded by the radius `corner`."""
        (left, top), (right, bottom) = self._to_px(low), self._to_px(high)
        if left <= right and top <= bottom:
            self._draw.rounded_rectangle((left, top, right, bottom), max(0.0, corner) * self._scale, colour)

    def picture(self) -> Pixels:
        """The picture so far."""
        return np.array(self._image.reduce(_FINER))

    def _to_px(self, point: Point) -> Point:
        x, y = self._origin_px + self._scale * np.array(point)
        return float(x), float(y)
