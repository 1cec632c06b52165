"""Wheels: a small two-wheeled robot finds a goal among obstacles with its sensors, without knowing its position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jax, jnp
from animat.records import Number, record
from animat.robots.base import Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, RAIL, Canvas, Pixels, draw_over_time
from animat.robots.motion import cost_of_distance, within_half_a_turn
from animat.robots.registry import register_robot
from animat.robots.surroundings import MOST_PLACES, Obstacles, Surroundings, Walls, places_within_reach

SENSORS_DEG = (17.0, 46.0, 90.0, 151.0, -151.0, -90.0, -46.0, -17.0)
"""Directions of the e-puck's proximity sensors, IR0 to IR7, clockwise from straight ahead."""
_PARTS = ("front", "diagonal", "side", "back")
SENSORS = (*(f"right_{part}" for part in _PARTS), *(f"left_{part}" for part in reversed(_PARTS)))
APART, SLIPPING = 0.4, 0.21
"""In body radii: the spacing of the square lattice, through the start, from which goals are drawn; and the clearance on
such a lattice above which a robot could slip through a gap.

An iteration moves the robot by at most a radius and is checked at its end. Half way there is a clearance of at least
half a radius, so at the nearest lattice place at least 0.4 / sqrt(2) less, 0.217. No wall is mistaken for a gap, as
the lattice has a place with a clearance of at most 0.2 on one side of it.
"""
ARENA = ((0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 1.0, 1.0), (1.0, 1.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.0))
"""The walls of a square of 1 m."""


class WheelsState(NamedTuple):
    """Position (x to the right, y down), heading (clockwise from the right, in (-pi, pi]), and the goal."""

    x_m: Float[Array, ""]
    y_m: Float[Array, ""]
    heading_rad: Float[Array, ""]
    goal_x_m: Float[Array, ""]
    goal_y_m: Float[Array, ""]


@register_robot
@record
class Wheels(Robot[WheelsState]):
    """A robot with two wheels and eight proximity sensors that drives to a goal, by default among four obstacles.

        v = max_speed_m_per_s u,    forward = (v_left + v_right) / 2,    turning = (v_left - v_right) / wheel_distance_m
        reward = reward_goal if d <= R (and the episode ends), reward_bump where it bumped, else R / d - 1
        sensor = 1 - clip(distance / sensor_range_m, 0, 1)

    The commands are those of the left and the right wheel. The robot moves along an exact circular arc. If its body
    would touch a wall or an obstacle at the end of an iteration, it turns but stays where it is. d is the distance from
    its centre to the goal and R the goal's radius. A sensor points straight away from the centre and measures the
    distance from the edge of the body to the first thing it meets. An episode starts at `start_x_m`, `start_y_m` with
    a random heading. Its goal is drawn from the other places that the robot can reach with some space around it.

    Attributes:
        max_speed_m_per_s: of a wheel at u = 1.
        sensor_range_m: beyond it a sensor shows 0.
        walls: each from x, y to x, y (m), without thickness; by default an arena of 1 m.
        obstacles: each by the x and y of its centre and its radius (m).
        goal_radius_m: R.
        reward_bump: of an iteration in which it could not move.

    Raises:
        InvalidArgument: for a start without room or without goals within reach, walls that do not close, or a step so
            long that the robot could pass through a wall.

    Source: Mondada et al. 2009, the e-puck (body, wheels and sensors, which here measure distance).
    """

    body_radius_m: Size = 0.035
    wheel_distance_m: Size = 0.053
    max_speed_m_per_s: Size = 0.13
    sensor_range_m: Size = 0.1
    walls: Walls = ARENA
    obstacles: Obstacles = ((0.3, 0.3, 0.08), (0.72, 0.35, 0.06), (0.35, 0.72, 0.06), (0.7, 0.7, 0.08))
    start_x_m: Number = 0.5
    start_y_m: Number = 0.5
    goal_radius_m: Size = 0.05
    step_s: Size = 0.2
    reward_goal: Number = 50.0
    reward_bump: Number = -2.0
    episode_limit: Iterations = 100

    name: ClassVar[str] = "wheels"
    n_commands: ClassVar[int] = 2

    def __post_init__(self) -> None:
        stride_m = self.max_speed_m_per_s * self.step_s
        if stride_m > self.body_radius_m or 2 * stride_m > 2 * math.pi * self.wheel_distance_m:
            most_s = min(self.body_radius_m, math.pi * self.wheel_distance_m) / self.max_speed_m_per_s
            raise InvalidArgument(f"step_s: expected at most {most_s:.3g} at this speed, got {self.step_s:g}")
        if not len(self._goals_m):
            area = f"in at most {MOST_PLACES * (APART * self.body_radius_m) ** 2:.3g} m^2"
            expected = f"a place within the walls, with room for the robot and goals that it can reach ({area})"
            got = f"{self.start_x_m:g}, {self.start_y_m:g}"
            raise InvalidArgument(f"start_x_m, start_y_m: expected {expected}, got {got}")
        left, top, right, bottom = self._around.box_m()
        x_m, y_m = self._within_reach(SLIPPING).T
        if x_m.min() <= left or x_m.max() >= right or y_m.min() <= top or y_m.max() >= bottom:
            raise InvalidArgument("walls: expected walls all around the robot, got a gap through which it could leave")

    @property
    def return_range(self) -> tuple[float, float]:
        """From the worst reward in each iteration to reaching the goal immediately."""
        worst, best, last = min(-1.0, self.reward_bump), max(0.0, self.reward_bump), self.episode_limit - 1
        lowest = min(last * worst + worst, last * worst + self.reward_goal, self.reward_goal)
        return lowest, max(self.episode_limit * best, last * best + self.reward_goal)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """The sensors clockwise from the front right, then the distance and bearing of the goal."""
        left, top, right, bottom = self._around.box_m()
        farthest_m = math.hypot(right - left, bottom - top)
        return (
            *(Quantity(f"proximity_{sensor}", "1", 1.0, 0.0, 1.0) for sensor in SENSORS),
            Quantity("goal_distance", "m", farthest_m / 2, 0.0, farthest_m, of_goal=True),
            Quantity("goal_bearing", "rad", math.pi, -math.pi, math.pi, of_goal=True),
        )

    def reset(self, key: Array) -> WheelsState:
        """At the start, with a random heading and goal."""
        for_goal, for_heading = jax.random.split(key)
        number = jax.random.randint(for_goal, (), 0, len(self._goals_m), jnp.int32)
        goal = jnp.asarray(self._goals_m, jnp.float32)[number]
        heading = math.pi * (1 - 2 * jax.random.uniform(for_heading, (), jnp.float32))
        return WheelsState(jnp.float32(self.start_x_m), jnp.float32(self.start_y_m), heading, goal[0], goal[1])

    def advance(self, uniforms: Uniforms, state: WheelsState, u: Float[Array, "2"]) -> Transition[WheelsState]:
        left_m, right_m = self.max_speed_m_per_s * self.step_s * jnp.asarray(u)
        turn = (left_m - right_m) / self.wheel_distance_m
        # The arc's chord points half way between the headings at its ends; jnp.sinc includes a factor pi.
        chord_m = (left_m + right_m) / 2 * jnp.sinc(turn / (2 * math.pi))
        x_m = state.x_m + chord_m * jnp.cos(state.heading_rad + turn / 2)
        y_m = state.y_m + chord_m * jnp.sin(state.heading_rad + turn / 2)
        bumped = self._around.clearance_m(x_m, y_m) < self.body_radius_m
        x_m, y_m = jnp.where(bumped, state.x_m, x_m), jnp.where(bumped, state.y_m, y_m)
        after = WheelsState(x_m, y_m, within_half_a_turn(state.heading_rad + turn), *state[3:])

        distance_m = jnp.hypot(state.goal_x_m - x_m, state.goal_y_m - y_m)
        terminated = distance_m <= self.goal_radius_m
        cost = jnp.where(bumped, self.reward_bump, cost_of_distance(distance_m, self.goal_radius_m))
        reward = jnp.where(terminated, self.reward_goal, cost).astype(x_m.dtype)
        return after, reward, terminated

    def observe(self, state: WheelsState) -> Float[Array, " observations"]:
        """The sensors (1 at the body's edge, 0 out of range), distance of the goal, bearing (positive to the right)."""
        x_m, y_m, heading, goal_x_m, goal_y_m = state
        directions = heading + jnp.radians(jnp.asarray(SENSORS_DEG, x_m.dtype))
        free_m = self._around.along_rays_m(x_m, y_m, directions) - self.body_radius_m
        proximity = 1 - jnp.clip(free_m / self.sensor_range_m, 0.0, 1.0)
        to_x_m, to_y_m = goal_x_m - x_m, goal_y_m - y_m
        bearing = within_half_a_turn(jnp.arctan2(to_y_m, to_x_m) - heading)
        return jnp.concatenate([proximity, jnp.stack([jnp.hypot(to_x_m, to_y_m), bearing])])

    def with_goal_of(self, state: WheelsState, other: WheelsState) -> WheelsState:
        """The robot of one state, with the goal of the other."""
        return state._replace(goal_x_m=other.goal_x_m, goal_y_m=other.goal_y_m)

    def heuristic(self, observation: Any) -> Any:
        """Towards the goal and away from what the front sensors see, more slowly the more it turns."""
        xp = observation.__array_namespace__()
        bearing = observation[9]
        right = 2 * observation[0] + 2 * observation[1] + observation[2]
        left = 2 * observation[7] + 2 * observation[6] + observation[5]
        turn = xp.clip(bearing, -1.0, 1.0) + left - right
        ahead = xp.clip(1 - xp.abs(turn), 0.25, 1.0)
        return xp.clip(xp.stack([ahead + turn, ahead - turn]), -1.0, 1.0)

    def draw(
        self, observation: np.ndarray, command: np.ndarray, earlier: Sequence[np.ndarray], height_px: int
    ) -> Pixels:
        """Sensors, goal and wheels, centred on the robot with its heading upwards, as its position is not observed."""
        body, reach_m = self.body_radius_m, self.body_radius_m + self.sensor_range_m
        half_m = 1.4 * reach_m
        canvas = Canvas(height_px, height_px, (height_px / 2, height_px / 2), height_px / 2 / half_m)

        def at(bearing: float, distance_m: float) -> tuple[float, float]:
            return distance_m * math.sin(bearing), -distance_m * math.cos(bearing)

        distance_m, bearing = float(observation[8]), float(observation[9])
        # A goal outside the picture is drawn at its edge.
        goal = at(bearing, min(distance_m, 1.25 * reach_m))
        canvas.disc(goal, self.goal_radius_m, GOAL)
        canvas.disc(goal, 0.85 * self.goal_radius_m, GOAL_FILL)
        for degrees, proximity in zip(SENSORS_DEG, observation[:8], strict=True):
            end = at(math.radians(degrees), body + (1 - float(proximity)) * self.sensor_range_m)
            canvas.stroke([(0.0, 0.0), end], 0.06 * body, ACCENT if proximity > 0 else RAIL)
            if proximity > 0:
                canvas.disc(end, 0.12 * body, INK)
        canvas.disc((0.0, 0.0), body, BODY)
        for side, u in zip((-1, 1), command, strict=True):
            wheel = side * self.wheel_distance_m / 2
            canvas.stroke([(wheel, 0.0), (wheel, -0.8 * body * float(u))], 0.15 * body, ACCENT)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The distance to the goal over time in each episode."""
        distances_m, radius_m = [path[:, 8] for path in paths], self.goal_radius_m
        arrived = [bool(distance_m[-1] <= radius_m) for distance_m in distances_m]
        draw_over_time(axes, self, distances_m, arrived, limits=[radius_m], success="arrived")
        axes.set(ylabel="distance to the goal (m)", ylim=(0, None))

    @property
    def _around(self) -> Surroundings:
        return Surroundings(self.walls, self.obstacles)

    @property
    def _goals_m(self) -> Float[np.ndarray, "goals 2"]:
        """Possible goals: with half a body radius to spare, and more than twice the goal's radius from the start."""
        places = self._within_reach(1.5)
        apart_m = np.hypot(places[:, 0] - self.start_x_m, places[:, 1] - self.start_y_m)
        return places[apart_m > 2 * self.goal_radius_m]

    def _within_reach(self, room: float) -> Float[np.ndarray, "places 2"]:
        """Places to which a disc of `room` body radii could be moved from the start."""
        start_m, radius_m = (self.start_x_m, self.start_y_m), self.body_radius_m
        return places_within_reach(self._around, start_m, room * radius_m, APART * radius_m)
