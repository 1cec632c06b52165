"""Navigation: steer a robot that never stops to a goal in a walled arena."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float
from pydantic import Field

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jnp
from animat.records import Number, record
from animat.robots.base import Amount, Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, AIM, BODY, EDGE, ENDED, GOAL, GOAL_FILL, INK, TRAIL, Canvas, Pixels, fit
from animat.robots.grid import Axis, Grid
from animat.robots.motion import cost_of_distance, within_half_a_turn
from animat.robots.registry import register_robot


class NavigationState(NamedTuple):
    """Position from the top-left corner (x right, y down) and heading (clockwise from the right, in (-pi, pi])."""

    x_m: Float[Array, ""]
    y_m: Float[Array, ""]
    heading_rad: Float[Array, ""]


@final
@register_robot
@record
class Navigation(Robot[NavigationState]):
    """A robot that turns by the command, then moves ahead; 50 at the goal, else a cost that falls as it approaches.

        heading += turn_rad u,    position += stride_m (cos heading, sin heading), clipped to the arena
        reward   = reward_goal if d <= R (and the episode ends), else R / d - 1

    with d the distance to the goal after the move and R its radius. An episode starts at the top left, facing right.

    Attributes:
        turn_rad: turn per iteration at u = 1.
        goal_x_m, goal_y_m: from the top-left corner, to the right and down.

    Raises:
        InvalidArgument: for a goal outside the arena.

    Source: Sawada et al. 2022, the navigation task.
    """

    arena_width_m: Size = 1.0
    arena_height_m: Size = 1.0
    stride_m: Size = 0.025
    # A turn never exceeds half a circle, so one correction brings the heading back into (-pi, pi].
    turn_rad: Annotated[Number, Field(ge=0, le=math.pi)] = math.pi / 10
    goal_x_m: Amount = 0.7
    goal_y_m: Amount = 0.7
    goal_radius_m: Size = 0.1
    reward_goal: Number = 50.0
    episode_limit: Iterations = 100

    name: ClassVar[str] = "navigation"
    paper_iterations: ClassVar[int] = 500_000

    def __post_init__(self) -> None:
        for name, most_m in (("goal_x_m", self.arena_width_m), ("goal_y_m", self.arena_height_m)):
            if getattr(self, name) > most_m:
                raise InvalidArgument(f"{name}: expected at most {most_m:g}, got {getattr(self, name):g}")

    @property
    def return_range(self) -> tuple[float, float]:
        """From staying as far from the goal as possible to reaching it immediately."""
        farthest_m = math.hypot(
            max(self.goal_x_m, self.arena_width_m - self.goal_x_m),
            max(self.goal_y_m, self.arena_height_m - self.goal_y_m),
        )
        away = min(self.goal_radius_m / farthest_m - 1, 0.0)
        last = (self.episode_limit - 1) * away
        return min(last + away, last + self.reward_goal, self.reward_goal), max(0.0, self.reward_goal)

    @classmethod
    def as_printed(cls) -> Navigation:
        """The paper taken literally: 20 iterations per episode, too few to reach the goal."""
        return cls(episode_limit=20)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """Position from the top-left corner, and heading."""
        return (
            Quantity("x", "m", self.arena_width_m, 0.0, self.arena_width_m),
            Quantity("y", "m", self.arena_height_m, 0.0, self.arena_height_m),
            Quantity("heading", "rad", math.pi, -math.pi, math.pi),
        )

    @property
    def fewest_iterations_to_goal(self) -> int:
        """Iterations of a straight run from the start to the goal's edge: the fewest in which it can be reached."""
        distance_m = max(0.0, math.hypot(self.goal_x_m, self.goal_y_m) - self.goal_radius_m)
        # Rounding must not add an iteration to a goal exactly n strides away.
        return max(1, math.ceil(distance_m / self.stride_m - 1e-9))

    @property
    def goal_reachable(self) -> bool:
        """Whether an episode is long enough for a straight run to the goal; otherwise no policy can reach it."""
        return self.fewest_iterations_to_goal <= self.episode_limit

    def reset(self, key: Array) -> NavigationState:
        """In the top-left corner, facing right; `key` is not used."""
        zero = jnp.zeros((), jnp.float32)
        return NavigationState(zero, zero, zero)

    def advance(self, uniforms: Uniforms, state: NavigationState, u: Float[Array, ""]) -> Transition[NavigationState]:
        heading = within_half_a_turn(state.heading_rad + self.turn_rad * u)
        x = jnp.clip(state.x_m + self.stride_m * jnp.cos(heading), 0.0, self.arena_width_m)
        y = jnp.clip(state.y_m + self.stride_m * jnp.sin(heading), 0.0, self.arena_height_m)

        distance = jnp.sqrt((x - self.goal_x_m) ** 2 + (y - self.goal_y_m) ** 2)
        terminated = distance <= self.goal_radius_m
        cost = cost_of_distance(distance, self.goal_radius_m)
        reward = jnp.where(terminated, self.reward_goal, cost).astype(x.dtype)
        return NavigationState(x, y, heading), reward, terminated

    def observe(self, state: NavigationState) -> Float[Array, " observations"]:
        return jnp.stack(state)

    def caveats(self) -> tuple[str, ...]:
        """A warning if the goal cannot be reached within an episode."""
        if self.goal_reachable:
            return ()
        reach_m = self.episode_limit * self.stride_m
        return (
            f"navigation: the goal cannot be reached: {self.episode_limit} iterations of {self.stride_m:g} m cover "
            f"{reach_m:g} m, and a straight run to its edge takes {self.fewest_iterations_to_goal} iterations",
        )

    def departures(self) -> tuple[tuple[str, str], ...]:
        """The length of an episode, and the effect of a wall."""
        reachable = ("; with 20 no" if self.episode_limit > 20 else ", with which no") + " policy can reach the goal."
        return (
            (
                "20 iterations",
                "The paper prints at most 20 iterations for an episode of navigation: 0.5 m of path to a goal that is "
                f"0.89 m away. Here there are {self.episode_limit} (episode_limit){reachable}",
            ),
            (
                "Walls",
                "The paper does not describe the effect of a wall. Here the robot stays inside: one that runs into a "
                "wall slides along it, without a penalty.",
            ),
        )

    def heuristic(self, observation: Any) -> Any:
        """A full turn to the side of the goal: by the sign of d sin(a), with the goal d m away at an angle a."""
        xp = observation.__array_namespace__()
        x_m, y_m, heading_rad = observation
        right = xp.cos(heading_rad) * (self.goal_y_m - y_m) - xp.sin(heading_rad) * (self.goal_x_m - x_m)
        return 2.0 * (right > 0) - 1.0

    def value_grid(self) -> Grid:
        """The grid found by measurement to suit the task (see docs/evidence/optimal-return.md)."""
        return Grid(
            Axis("x", "m", 0.0, self.arena_width_m, 61),
            (
                Axis("y", "m", 0.0, self.arena_height_m, 61),
                # With a hundred headings, turns of u pi/10 with u a multiple of 0.2 lead exactly from one to another.
                Axis("heading", "rad", -math.pi, math.pi, 100, periodic=True),
            ),
            tuple,
            lambda coordinates: NavigationState(*coordinates),
        )

    def draw(self, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int) -> Pixels:
        """The robot in its arena, with the goal and the robot's path (see `animat.robots.drawing`)."""
        x, y, heading = (float(value) for value in observation)
        width_m, height_m = self.arena_width_m, self.arena_height_m
        margin = 0.06 * height_m
        scale, width_px, above_px = fit(width_m + 2 * margin, height_m + 2 * margin, height_px)
        canvas = Canvas(width_px, height_px, (scale * margin, above_px + scale * margin), scale)
        line, size = 0.008 * height_m, 0.03 * height_m

        goal = (self.goal_x_m, self.goal_y_m)
        canvas.disc(goal, self.goal_radius_m, GOAL)
        canvas.disc(goal, self.goal_radius_m - line, GOAL_FILL)
        walls = [(0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m), (0.0, 0.0)]
        canvas.stroke(walls, line, INK)
        canvas.stroke([*((float(past[0]), float(past[1])) for past in earlier), (x, y)], line, TRAIL)
        canvas.stroke([(x, y), (x + 1.8 * size * math.cos(heading), y + 1.8 * size * math.sin(heading))], line, ACCENT)
        canvas.disc((x, y), size, BODY)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The robot's path in each episode, seen from above."""
        from matplotlib.patches import Circle, Rectangle

        arena = Rectangle((0, 0), self.arena_width_m, self.arena_height_m, fill=False, color=EDGE, linewidth=0.8)
        axes.add_patch(arena)
        goal = (self.goal_x_m, self.goal_y_m)
        axes.add_patch(Circle(goal, self.goal_radius_m, color=AIM, alpha=0.35, linewidth=0))
        arrived = [math.hypot(*(path[-1, :2] - goal)) <= self.goal_radius_m for path in paths]
        for path, has_arrived in zip(paths, arrived, strict=True):
            axes.plot(path[:, 0], path[:, 1], color=ENDED[has_arrived], linewidth=0.7, alpha=0.8)
        axes.set_aspect("equal")
        axes.set_xlim(-0.03, self.arena_width_m + 0.03)
        axes.set_ylim(self.arena_height_m + 0.03, -0.03)
        axes.set(xlabel=f"x (m); {sum(arrived)} of {len(paths)} arrived", ylabel="y (m)")
