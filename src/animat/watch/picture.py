"""The robot of a tick as a picture, if the robot is known here and can be drawn."""

from __future__ import annotations

import functools
import io
import json
from typing import Any

import numpy as np
from PIL import Image

from animat.closed_loop.log import Record
from animat.errors import AnimatError
from animat.goals.robot import robot_of
from animat.robots.base import Robot
from animat.robots.drawing import draw_robot
from animat.watch.plain import mapped, numbers


def is_drawn(loop: dict[str, Any]) -> bool:
    """Whether the robot of a session's header is known here and can be drawn."""
    try:
        return _robot_of(loop) is not None
    except (AnimatError, ArithmeticError, ValueError, TypeError):
        return False


def picture_of(loop: dict[str, Any], record: Record, earlier: list[list[float | None]]) -> bytes | None:
    """A PNG of the robot in a session's header; None if it is not known here or cannot be drawn.

    The record has a tick; the earlier observations belong to its episode.
    """
    tick = mapped(record.fields.get("tick"))
    observation, command = numbers(tick.get("observation")), numbers(tick.get("command"))
    if not observation and earlier:
        observation = earlier[-1]
    try:
        robot = _robot_of(loop)
        if robot is None or not observation or None in observation:
            return None
        commands = np.array([0.0 if u is None else u for u in command or (0.0,)])
        picture = draw_robot(
            robot,
            np.array(observation, np.float64),
            command=commands if robot.n_commands > 1 else float(commands[0]),
            earlier=[np.array(past, np.float64) for past in earlier if None not in past],
        )
    except (AnimatError, ArithmeticError, ValueError, TypeError, IndexError, MemoryError):
        # A damaged log may contain anything.
        return None
    png = io.BytesIO()
    Image.fromarray(picture).save(png, "PNG", compress_level=1)
    return png.getvalue()


def _robot_of(loop: dict[str, Any]) -> Robot[Any] | None:
    return _robot(json.dumps({name: loop[name] for name in ("robot", "goal") if name in loop}))


@functools.lru_cache(maxsize=8)
def _robot(data: str) -> Robot[Any] | None:
    robot = robot_of(json.loads(data))
    return robot if hasattr(robot, "draw") else None
