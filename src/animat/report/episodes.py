"""Episodes as paths and as frames, arm by arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from animat.lazy import Figure
from animat.report.style import grid_of_panels, new_figure, style_axes, wrapped
from animat.robots.base import Robot, capability
from animat.robots.drawing import draw_robot

Episode = tuple[Float[np.ndarray, "iterations+1 observations"], Sequence[Any]]
"""Observations and commands."""
_FRAMES = 7
_WIDE_IN = 3.1
"""Width of a panel of paths."""


def draw_paths(robot: Robot[Any], arms: Mapping[str, Sequence[Episode]], title: str) -> Figure:
    """One panel per arm with one episode of each policy, in the robot's units, drawn by its method `draw_paths`."""
    draw = capability(robot, "draw_paths")
    figure, panels = grid_of_panels(len(arms), 3, _WIDE_IN, 2.5, title)
    for axes, (name, episodes) in zip(panels, arms.items(), strict=True):
        draw(axes, [path for path, _ in episodes])
        style_axes(axes, wrapped(name, _WIDE_IN), axes.get_xlabel(), axes.get_ylabel())
    return figure


def draw_frames(robot: Robot[Any], arms: Mapping[str, Sequence[Episode]], title: str) -> Figure:
    """One row per arm: evenly spaced pictures of the robot in its episode of median length, from start to end."""
    middle = {arm: sorted(each, key=lambda one: len(one[0]))[len(each) // 2] for arm, each in arms.items()}
    first = draw_robot(robot, next(iter(middle.values()))[0][0])
    wide = first.shape[1] / first.shape[0]
    figure = new_figure(9.5, 0.6 + len(middle) * (9.5 / _FRAMES / wide + 0.28), title)
    rows = figure.subplots(len(middle), _FRAMES, squeeze=False)
    for axes_row, (name, (path, commands)) in zip(rows, middle.items(), strict=True):
        for axes, i in zip(axes_row, np.linspace(0, len(path) - 1, _FRAMES).round().astype(int), strict=True):
            command = commands[i - 1] if i else 0.0
            axes.imshow(draw_robot(robot, path[i], command=command, earlier=list(path[:i]), height_px=240))
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
            axes.set_xlabel(f"{i}", fontsize=7, labelpad=1)
        axes_row[0].set_title(f"{name}: {len(path) - 1} iterations", fontsize=8, loc="left", pad=3)
    return figure
