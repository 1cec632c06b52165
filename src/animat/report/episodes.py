"""Episodes as paths and as frames, a condition beside the other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from animat.report.frames import draw_robot
from animat.report.style import BLUE, GREEN, GREY, RED, grid_of_panels, new_figure, style_axes
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Path = Float[np.ndarray, "iterations+1 observations"]
_FRAMES = 7


def draw_paths(robot: Robot[Any], paths: Mapping[str, Sequence[Path]], title: str) -> Figure:
    """A panel a condition with one episode of each policy: where the robot went, or how far the pole leaned.

    Args:
        robot: cartpole or navigation.
        paths: by condition, the observations of each episode, in the robot's own units.
        title: of the whole figure.
    """
    square = isinstance(robot, Navigation)
    figure, panels = grid_of_panels(len(paths), 4 if square else 3, 2.5 if square else 3.1, 2.5, title)
    for axes, (name, episodes) in zip(panels, paths.items(), strict=True):
        if isinstance(robot, Navigation):
            _draw_arena(axes, robot, episodes)
        elif isinstance(robot, Cartpole):
            _draw_angles(axes, robot, episodes)
        axes.set_title(name, fontsize=10, loc="left")
    return figure


def draw_frames(robot: Robot[Any], episodes: Mapping[str, tuple[Path, Sequence[float]]], title: str) -> Figure:
    """A row a condition: pictures of the robot from the start of an episode to its end, evenly spread.

    Args:
        robot: one that can be drawn.
        episodes: by condition, the observations of an episode and its commands.
        title: of the whole figure.
    """
    first = draw_robot(robot, next(iter(episodes.values()))[0][0])
    wide = first.shape[1] / first.shape[0]
    figure = new_figure(9.5, 0.6 + len(episodes) * (9.5 / _FRAMES / wide + 0.28))
    figure.suptitle(title, fontsize=10)
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


def _draw_arena(axes: Axes, robot: Navigation, episodes: Sequence[Path]) -> None:
    from matplotlib.patches import Circle, Rectangle

    axes.add_patch(Rectangle((0, 0), robot.arena_width_m, robot.arena_height_m, fill=False, color=GREY, linewidth=0.8))
    goal = (robot.goal_x_m, robot.goal_y_m)
    axes.add_patch(Circle(goal, robot.goal_radius_m, color=GREEN, alpha=0.35, linewidth=0))
    reached = 0
    for path in episodes:
        there = math.hypot(path[-1, 0] - goal[0], path[-1, 1] - goal[1]) <= robot.goal_radius_m
        reached += there
        axes.plot(path[:, 0], path[:, 1], color=BLUE if there else RED, linewidth=0.7, alpha=0.8)
    axes.set_aspect("equal")
    axes.set_xlim(-0.03, robot.arena_width_m + 0.03)
    axes.set_ylim(robot.arena_height_m + 0.03, -0.03)
    style_axes(axes, "", f"x (m); {reached} of {len(episodes)} arrived", "y (m)")


def _draw_angles(axes: Axes, robot: Cartpole, episodes: Sequence[Path]) -> None:
    limit_deg = math.degrees(robot.angle_limit_rad)
    stayed = 0
    for path in episodes:
        stayed += len(path) > robot.episode_limit
        colour = BLUE if len(path) > robot.episode_limit else RED
        axes.plot(np.arange(len(path)) * robot.step_s, np.degrees(path[:, 2]), color=colour, linewidth=0.7, alpha=0.8)
    for sign in (-1, 1):
        axes.axhline(sign * limit_deg, color=GREY, linewidth=0.8, linestyle="--")
    axes.set_xlim(0, robot.episode_limit * robot.step_s)
    axes.set_ylim(-1.25 * limit_deg, 1.25 * limit_deg)
    style_axes(axes, "", f"time (s); {stayed} of {len(episodes)} to the end", "pole angle (deg)")
