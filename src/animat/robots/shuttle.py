"""Shuttle: a cart goes to one of two places on a track, the one that a cue names, and keeps off the other one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from animat.errors import InvalidArgument
from animat.lazy import Array, Axes, jax, jnp
from animat.records import Number, record
from animat.robots.base import Iterations, Quantity, Robot, Size
from animat.robots.drawing import ACCENT, BODY, GOAL, GOAL_FILL, INK, RAIL, Canvas, Picture, draw_over_time
from animat.robots.grid import TAPS, Axis, Grid
from animat.robots.registry import register_robot

BRAKE_S = 0.2
"""Of the heuristic: how far ahead of the cart it looks, in seconds of its present velocity."""


class ShuttleState(NamedTuple):
    """Where the cart is, from the middle of the track to the right, and which place it is to go to."""

    position_m: Float[Array, ""]
    velocity_m_per_s: Float[Array, ""]
    cue: Float[Array, ""]
    """1 for the place on the right, -1 for that on the left."""


@final
@register_robot
@record
class Shuttle(Robot[ShuttleState]):
    """A cart between two places; +1 an iteration that ends at the one that the cue names, -1 at the other one, else 0.

        time_constant_s v' = speed_m_per_s u - v,    x' = v

    with x the cart's position and v its velocity. An iteration is the exact solution for a constant u. A cart that
    comes to an end of the track stops there. An episode starts at rest in the middle; its cue is drawn, right as often
    as left, and it never ends by itself.

    What is right at one place is wrong at the other, and position and velocity do not tell which is which: without the
    cue, no rule has a mean return above 0.

    Attributes:
        place_m: how far both places are from the middle.
        place_radius_m: how near to a place the cart is there.
        speed_m_per_s: of the cart, in the end, at u = 1.
        time_constant_s: in which it comes up to speed.

    Raises:
        InvalidArgument: for a parameter that is not finite or has no meaning, places that overlap, or places that
            are not on the track.

    Source: the two-way shuttle box, in which an animal goes to the other side on a cue (Warner 1932,
    Journal of Genetic Psychology 41:57-90).
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
            raise InvalidArgument(
                f"place_radius_m: expected less than {self.place_m:g}, so that the places do not overlap, got "
                f"{self.place_radius_m:g}"
            )
        if self.place_m > self.track_length_m / 2:
            raise InvalidArgument(
                f"place_m: expected at most {self.track_length_m / 2:g}, where the track ends, got {self.place_m:g}"
            )

    @property
    def return_range(self) -> tuple[float, float]:
        """Of an episode that is all the time at the worse of the two places, or at the better one."""
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
        return ShuttleState(zero, zero, jnp.where(jax.random.uniform(key) < 0.5, 1.0, -1.0).astype(jnp.float32))

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: ShuttleState, u: Float[Array, ""]
    ) -> tuple[ShuttleState, Float[Array, ""], Bool[Array, ""]]:
        kept = math.exp(-self.step_s / self.time_constant_s)
        wanted = self.speed_m_per_s * u
        moved = wanted * self.step_s + (state.velocity_m_per_s - wanted) * self.time_constant_s * (1 - kept)
        half_m = self.track_length_m / 2
        free_m = state.position_m + moved
        position = jnp.clip(free_m, -half_m, half_m)
        velocity = jnp.where(position == free_m, wanted + (state.velocity_m_per_s - wanted) * kept, 0.0)
        # From the cue's place: 0 there, and twice `place_m` at the other one.
        off_m = jnp.abs(position - state.cue * self.place_m)
        off_other_m = jnp.abs(position + state.cue * self.place_m)
        other = jnp.where(off_other_m <= self.place_radius_m, self.reward_elsewhere, 0.0)
        reward = jnp.where(off_m <= self.place_radius_m, self.reward_there, other).astype(position.dtype)
        after = ShuttleState(position, velocity.astype(position.dtype), state.cue)
        return after, reward, jnp.zeros((), bool)

    def observe(self, state: ShuttleState) -> Float[Array, " observations"]:
        return jnp.stack(state)

    def with_goal_of(self, state: ShuttleState, other: ShuttleState) -> ShuttleState:
        """Where one is, with the cue of the other."""
        return state._replace(cue=other.cue)

    def heuristic(self, observation: Any) -> Any:
        """To the cue's place, the more slowly the nearer it is, with the present velocity taken into account."""
        xp = observation.__array_namespace__()
        position, velocity, cue = observation
        return xp.clip((cue * self.place_m - position - BRAKE_S * velocity) / self.place_radius_m, -1.0, 1.0)

    def value_grid(self) -> Grid:
        """Cue by position by velocity; of the cue's nodes, its two values alone are ever met.

        Every command of its own, as one may decide whether an iteration is rewarded.
        """
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

    def draw(self, observation: np.ndarray, command: float, earlier: Sequence[np.ndarray], height_px: int) -> Picture:
        """The cart on its track between the two places; the one that the cue names is filled.

        The command is an arrow under the cart (see `animat.robots.drawing`).
        """
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
        """How far the cart was on the cue's side of the middle in each episode, over time."""
        towards_m = [path[:, 0] * path[0, 2] for path in paths]
        arrived = [bool(abs(each[-1] - self.place_m) <= self.place_radius_m) for each in towards_m]
        edges_m = (self.place_m - self.place_radius_m, self.place_m + self.place_radius_m)
        told, ylabel = "end at their place", "position on the cue's side (m)"
        draw_over_time(axes, self, towards_m, arrived, limits=edges_m, told=told, ylabel=ylabel)
        axes.set_ylim(-0.55 * self.track_length_m, 0.55 * self.track_length_m)
