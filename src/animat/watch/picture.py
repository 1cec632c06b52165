"""The robot of a tick as a picture, if the robot is known here and can be drawn."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from animat.goals.robot import robot_of
from animat.robots.base import Robot
from animat.robots.drawing import draw_robot


def drawn_robot(loop: dict[str, Any]) -> Robot[Any] | None:
    """The robot of a session's header; None if it is not known here or cannot be drawn."""
    try:
        robot = robot_of(loop)
    except Exception:  # a robot of a third party may raise anything
        return None
    return robot if hasattr(robot, "draw") else None


def picture_of(robot: Robot[Any], tick: dict[str, Any], earlier: Sequence[Any]) -> bytes | None:
    """A PNG of a robot at a tick with the earlier observations of its episode; None if nothing has been observed."""
    observation = tick["observation"] or (earlier[-1] if earlier else None)
    if not observation:
        return None
    picture = draw_robot(
        robot,
        np.array(observation, np.float64),
        command=np.array(tick["command"] or 0.0, np.float64)[()],
        earlier=[np.array(past, np.float64) for past in earlier],
    )
    png = io.BytesIO()
    Image.fromarray(picture).save(png, "PNG", compress_level=1)
    return png.getvalue()
