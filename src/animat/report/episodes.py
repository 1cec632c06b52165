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

Path = Float[np.ndarray, "iterations+1 observations"]
_FRAMES = 7
_WIDE_IN = 3.1
"""Width of a panel of paths."""


def draw_paths(robot: Robot[Any], paths: Mapping[str, Sequence[Path]], title: str) -> Figure:
    """One panel per arm with one episode of each policy, in the robot's units, drawn by its method `draw_paths`."""
    draw = capability(robot, "draw_paths")
    figure, panels = grid_of_panels(len(paths), 3, _WIDE_IN, 2.5, title)
    for axes, (name, episodes) in zip(panels, paths.items(), strict=True):
        draw(axes, episodes)
        style_axes(axes, wrapped(name, _WIDE_IN), axes.get_xlabel(), axes.get_ylabel())
    return figure


def draw_frames(robot: Robot[Any], episodes: Mapping[str, tuple[Path, Sequence[float]]], title: str) -> Figure:
    """One row per arm: pictures of the robot from the start of an episode to its end, evenly spaced.

    `episodes` has the observations and commands of one episode of each arm.
    """
    first = draw_robot(robot, next(iter(episodes.values()))[0][0])
    wide = first.shape[1] / first.shape[0]
    figure = new_figure(9.5, 0.6 + len(episodes) * (9.5 / _FRAMES / wide + 0.28), title)
    rows = figure.subplots(len(episodes), _FRAMES, squeeze=False)
    for axes_row, (name, (path, commands)) in zip(rows, episodes.items(), strict=True):
        for axes, i in zip(axes_row, np.linspace(0, len(path) - 1, _FRAMES).round().astype(int), strict=True):
            command = commands[i - 1] if i else 0.0
            axes.imshow(draw_robot(robot, path[i], command=command, earlier=list(path[:i]), height_px=240))
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
            axes.set_xlabel(f"{i}", fontsize=7, labelpad=1)
        axes_row[0].set_title(f"{name}: {len(path) - 1} iterations", fontsize=8, loc="left", pad=3)
    return figure
