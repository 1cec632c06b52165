"""Shuttle: a cart goes to the one of two places on a track that a cue indicates, and keeps off the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Float

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jax, jnp
from animat.records import Number, record
from animat.robots.base import Iterations, Quantity, Robot, Size, Transition, Uniforms
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, RAIL, Canvas, Pixels, draw_over_time
from animat.robots.grid import TAPS, Axis, Grid
from animat.robots.registry import register_robot

BRAKE_S = 0.2
"""How far ahead of the cart the heuristic looks, in seconds of its current velocity."""


class ShuttleState(NamedTuple):
    """The cart's position, from the middle of the track to the right, its velocity, and the cue."""

    position_m: Float[Array, ""]
    velocity_m_per_s: Float[Array, ""]
    cue: Float[Array, ""]
    """1 for the place on the right, -1 for that on the left."""


@final
@register_robot
@record
class Shuttle(Robot[ShuttleState]):
    """A cart between two places; +1 for an iteration that ends at the cue's place, -1 at the other, else 0.

        time_constant_s v' = speed_m_per_s u - v,    x' = v

    with x the cart's position and v its velocity. An iteration is the exact solution for a constant u. A cart that
    reaches an end of the track stops there. An episode starts at rest in the middle and is never terminated. Its cue is
    drawn, right and left with equal probability.

    Attributes:
        place_m: distance of both places from the middle.
        place_radius_m: within which the cart counts as being at a place.
        speed_m_per_s: the cart's final speed at u = 1.
        time_constant_s: of its approach to that speed.

    Raises:
        InvalidArgument: for places that overlap, or are not on the track.

    Source: the two-way shuttle box, crossed on a cue (Warner 1932, Journal of Genetic Psychology 41:57-90).
    """

    track_length_m: Size = 1.0
    place_m: Size = 0.3
    place_radius_m: Size = 0.1
    speed_m_per_s: Size = 0.5
    time_constant_s: Size = 0.2
    step_s: Size = 0.1
    reward_there: Number = 1.0
    reward_elsewhere: Number = -1.0
    episode_limit: Iterations = 120

    name: ClassVar[str] = "shuttle"

    def __post_init__(self) -> None:
        if self.place_radius_m >= self.place_m:
            most = f"{self.place_m:g}, so that the places do not overlap"
            raise InvalidArgument(f"place_radius_m: expected less than {most}, got {self.place_radius_m:g}")
        if self.place_m > self.track_length_m / 2:
            most = f"{self.track_length_m / 2:g}, where the track ends"
            raise InvalidArgument(f"place_m: expected at most {most}, got {self.place_m:g}")

    @property
    def return_range(self) -> tuple[float, float]:
        """From always being at the worse of the two places to always at the better."""
        rewards = (0.0, self.reward_there, self.reward_elsewhere)
        return self.episode_limit * min(rewards), self.episode_limit * max(rewards)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """Position and velocity of the cart, and the cue."""
        half_m, fastest = self.track_length_m / 2, self.speed_m_per_s
        return (
            Quantity("cart_position", "m", half_m, -half_m, half_m),
            Quantity("cart_velocity", "m/s", fastest, -fastest, fastest),
            Quantity("cue", "1", 1.0, -1.0, 1.0, of_goal=True),
        )

    def reset(self, key: Array) -> ShuttleState:
        """At rest in the middle; the cue is drawn."""
        zero = jnp.zeros((), jnp.float32)
        cue = jnp.where(jax.random.uniform(key, dtype=jnp.float32) < 0.5, 1.0, -1.0)
        return ShuttleState(zero, zero, cue.astype(jnp.float32))

    def advance(self, uniforms: Uniforms, state: ShuttleState, u: Float[Array, ""]) -> Transition[ShuttleState]:
        kept = math.exp(-self.step_s / self.time_constant_s)
        final = self.speed_m_per_s * u
        moved = final * self.step_s + (state.velocity_m_per_s - final) * self.time_constant_s * (1 - kept)
        half_m = self.track_length_m / 2
        free_m = state.position_m + moved
        position = jnp.clip(free_m, -half_m, half_m)
        velocity = jnp.where(position == free_m, final + (state.velocity_m_per_s - final) * kept, 0.0)
        off_m = jnp.abs(position - state.cue * self.place_m)
        off_other_m = jnp.abs(position + state.cue * self.place_m)
        other = jnp.where(off_other_m <= self.place_radius_m, self.reward_elsewhere, 0.0)
        reward = jnp.where(off_m <= self.place_radius_m, self.reward_there, other).astype(position.dtype)
        after = ShuttleState(position, velocity.astype(position.dtype), state.cue)
        return after, reward, jnp.zeros((), bool)

    def observe(self, state: ShuttleState) -> Float[Array, " observations"]:
        return jnp.stack(state)

    def with_goal_of(self, state: ShuttleState, other: ShuttleState) -> ShuttleState:
        """The cart of one state, with the cue of the other."""
        return state._replace(cue=other.cue)

    def heuristic(self, observation: Any) -> Any:
        """Towards the cue's place, more slowly the nearer it gets, allowing for the current velocity."""
        xp = observation.__array_namespace__()
        position, velocity, cue = observation
        return xp.clip((cue * self.place_m - position - BRAKE_S * velocity) / self.place_radius_m, -1.0, 1.0)

    def value_grid(self) -> Grid:
        """Cue by position by velocity, for every command, as a command may decide whether an iteration is rewarded."""
        half_m, fastest = self.track_length_m / 2, self.speed_m_per_s
        return Grid(
            Axis("cue", "1", -1.0, 1.0, TAPS),
            (
                Axis("cart_position", "m", -half_m, half_m, 201),
                Axis("cart_velocity", "m/s", -fastest, fastest, 41),
            ),
            lambda state: (state.cue, state.position_m, state.velocity_m_per_s),
            lambda coordinates: ShuttleState(coordinates[1], coordinates[2], coordinates[0]),
        )

    def draw(self, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int) -> Pixels:
        """The cart on its track, with the cue's place filled and the command as a line under the cart."""
        position, _, cue = (float(value) for value in observation)
        half_m, radius_m = self.track_length_m / 2, self.place_radius_m
        margin = 0.1 * self.track_length_m
        tall_m = max(0.3 * self.track_length_m, 2.4 * radius_m)
        scale = height_px / tall_m
        width_px = round(scale * 2 * (half_m + margin))
        canvas = Canvas(width_px, height_px, (width_px / 2, height_px / 2), scale)
        line = 0.006 * self.track_length_m
        for side in (-1.0, 1.0):
            canvas.disc((side * self.place_m, 0.0), radius_m, GOAL if side == cue else RAIL)
            if side == cue:
                canvas.disc((side * self.place_m, 0.0), radius_m - line, GOAL_FILL)
        canvas.stroke([(-half_m, 0.0), (half_m, 0.0)], line, INK)
        for end in (-half_m, half_m):
            canvas.stroke([(end, -4 * line), (end, 4 * line)], line, INK)
        wide, high = 0.05 * self.track_length_m, 0.03 * self.track_length_m
        canvas.box((position - wide, -high), (position + wide, high), line, BODY)
        if command:
            canvas.stroke([(position, 2 * high), (position + 2 * wide * command, 2 * high)], line, ACCENT)
            canvas.disc((position + 2 * wide * command, 2 * high), line, ACCENT)
        return canvas.picture()

    def draw_paths(self, axes: Axes, paths: Sequence[np.ndarray]) -> None:
        """The cart's position towards the cue's side over time in each episode."""
        towards_m = [path[:, 0] * path[0, 2] for path in paths]
        arrived = [bool(abs(positions[-1] - self.place_m) <= self.place_radius_m) for positions in towards_m]
        edges_m = (self.place_m - self.place_radius_m, self.place_m + self.place_radius_m)
        draw_over_time(axes, self, towards_m, arrived, limits=edges_m, success="end at their place")
        most_m = 0.55 * self.track_length_m
        axes.set(ylabel="position on the cue's side (m)", ylim=(-most_m, most_m))
