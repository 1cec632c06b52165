"""Grids over a robot's states, and where an iteration leads on them: what dynamic programming computes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int32

from animat.errors import InvalidArgument
from animat.robots.base import Robot
from animat.robots.cartpole import Cartpole, CartpoleState
from animat.robots.navigation import Navigation, NavigationState

_FINEST = 8192.0

TAPS = 4
"""Nodes along an axis that an interpolated value is taken from: cubic polynomials."""


@dataclass(frozen=True)
class Axis:
    """Evenly spaced values of one coordinate.

    Attributes:
        name, unit: what it is, and what it is measured in.
        low, high: its ends; what lies beyond them has the value of the end.
        nodes: how many values, at least 4, both ends among them (of a periodic axis, only the lower one).
        periodic: whether `high` is `low` again.

    Raises:
        InvalidArgument: for ends that do not rise, or fewer nodes than four.
    """

    name: str
    unit: str
    low: float
    high: float
    nodes: int
    periodic: bool = False

    def __post_init__(self) -> None:
        if not (self.nodes >= TAPS and math.isfinite(self.high - self.low) and self.high > self.low):
            raise InvalidArgument(
                f"axis {self.name}: expected rising ends and at least {TAPS} nodes, got {self.low:g} to "
                f"{self.high:g} with {self.nodes}"
            )

    @property
    def step(self) -> float:
        """The distance between neighbouring nodes."""
        return (self.high - self.low) / (self.nodes if self.periodic else self.nodes - 1)

    @property
    def stored(self) -> int:
        """How many nodes are stored: a periodic axis goes on by one before its start and two after its end."""
        return self.nodes + 3 if self.periodic else self.nodes

    def values(self, index: Array) -> Array:
        """The coordinate of stored nodes."""
        steps = index - (1 if self.periodic else 0)
        return jnp.asarray(jnp.float32(self.low) + steps * jnp.float32(self.step))

    def locate(self, value: Array) -> tuple[Array, Array]:
        """The first of the four stored nodes around a value, and the value's distance from it in steps."""
        place = (value - jnp.float32(self.low)) / jnp.float32(self.step)
        # A robot often lands on a node exactly; the last bits must not decide on which side of it.
        place = jnp.round(place * _FINEST) / _FINEST
        place = jnp.mod(place, self.nodes) + 1 if self.periodic else jnp.clip(place, 0, self.nodes - 1)
        first = jnp.clip(jnp.floor(place) - 1, 0, self.stored - TAPS)
        return first.astype(jnp.int32), (place - first).astype(jnp.float32)


class Located(NamedTuple):
    """Where a state lies between the nodes of a grid.

    Attributes:
        row: first of the 4^axes rows around it.
        row_places: distances from it in steps, shape (axes,).
        positions: places among all of an axis's stored nodes, in steps, shape (axes,).
        node: first of the four nodes around it along a row.
        place: distance from it in steps.
    """

    row: Array
    row_places: Array
    positions: Array
    node: Array
    place: Array


@dataclass(frozen=True)
class Grid:
    """Nodes over a robot's states, in coordinates that suit its motion.

    The first coordinate is one that has no part in how the others move, such as the place of a cart on its track; the
    others are its *rows*. Nodes are stored row by row.

    Attributes:
        along: the first coordinate.
        rows: the other coordinates; there may be none.
        to_coordinates: from a robot's state to its coordinates, `along` first.
        to_state: back.
        smooth_commands: how many commands tell where an iteration leads well enough for a polynomial through them;
            None: a command can decide whether an episode ends, and every level is computed by itself.
        end_is_known: whether a state alone decides if the next iteration ends the task; what lies beyond the ends of
            the axes is then never taken for what lies just inside.
        noise_in_command: the largest change of the command that the robot's noise amounts to, either way, evenly
            distributed; None: its noise is another.
    """

    along: Axis
    rows: tuple[Axis, ...]
    to_coordinates: Callable[[Any], tuple[Array, ...]]
    to_state: Callable[[tuple[Array, ...]], Any]
    smooth_commands: int | None = None
    end_is_known: bool = False
    noise_in_command: float | None = None

    @property
    def n_rows(self) -> int:
        """Stored rows."""
        return math.prod(axis.stored for axis in self.rows)

    @property
    def size(self) -> int:
        """Stored nodes in all."""
        return self.n_rows * self.along.stored

    @property
    def row_offsets(self) -> Int32[np.ndarray, " taps"]:
        """Where the 4^axes rows around a state lie, counted from the first of them."""
        offsets = np.zeros(1, np.int32)
        for stride in self._strides():
            offsets = (offsets[:, None] + np.arange(TAPS, dtype=np.int32) * np.int32(stride)).ravel()
        return offsets

    def scaled(self, factor: float, *, periodic: bool = False) -> Grid:
        """The same grid with `factor` times as many steps along each axis.

        An axis with a middle node keeps one, as the start is often there.

        Args:
            factor: positive.
            periodic: also along periodic axes, which are left as they are else: their nodes are matched to the turns
                that a robot makes.
        """

        def of(axis: Axis) -> Axis:
            if axis.periodic:
                return replace(axis, nodes=max(TAPS, round(factor * axis.nodes))) if periodic else axis
            half = max(2, round(factor * (axis.nodes - 1) / 2))
            nodes = 2 * half + 1 if axis.nodes % 2 else max(TAPS, round(factor * (axis.nodes - 1)) + 1)
            return replace(axis, nodes=nodes)

        return replace(self, along=of(self.along), rows=tuple(of(axis) for axis in self.rows))

    def locate(self, state: Any) -> Located:
        """Where a state lies between the nodes."""
        along, *others = self.to_coordinates(state)
        row = jnp.int32(0)
        places, positions = [], []
        for axis, stride, value in zip(self.rows, self._strides(), others, strict=True):
            first, place = axis.locate(value)
            row += first * stride
            places.append(place)
            positions.append(first + place)
        nothing = jnp.zeros(0, jnp.float32)
        return Located(
            row,
            jnp.stack(places) if places else nothing,
            jnp.stack(positions) if positions else nothing,
            *self.along.locate(along),
        )

    def state_at(self, row: Array, node: Array) -> Any:
        """The robot's state at a node of a row."""
        indices = jnp.unravel_index(row, tuple(axis.stored for axis in self.rows)) if self.rows else ()
        others = (axis.values(i) for axis, i in zip(self.rows, indices, strict=True))
        return self.to_state((self.along.values(node), *others))

    def _strides(self) -> tuple[int, ...]:
        stored = [axis.stored for axis in self.rows]
        return tuple(math.prod(stored[i + 1 :]) for i in range(len(stored)))


def grid_for(robot: Robot[Any]) -> Grid:
    """The grid that was measured to suit a robot of ours (see docs/evaluation.md).

    *Cartpole.* Position and angle are those after the next iteration, which are already decided: a state in which one
    of them lies beyond its limit is lost, and the ends of the axes are where that begins. With l half the pole's
    length, a push changes the cart's velocity v and the pole's angular velocity w such that v + 4/3 l w stays nearly
    the same: it moves with gravity only, slowly, and takes the place of v. The angular velocities end, with 10 % more,
    where the pole cannot be caught any more: r (angle limit + F / (M g)), with r the rate at which it falls, 1/s; the
    velocities at sqrt(g angle limit track length), from which the cart can hardly be stopped on its track by leaning
    the pole.

    *Navigation.* A hundred headings: turns of u pi/10 with u a multiple of 0.2 lead from one of them to another
    exactly.

    Raises:
        InvalidArgument: for a robot without one, or a cartpole whose pole may swing far.
    """
    if isinstance(robot, Cartpole):
        return _cartpole_grid(robot)
    if isinstance(robot, Navigation):
        return Grid(
            Axis("x", "m", 0.0, robot.arena_width_m, 61),
            (
                Axis("y", "m", 0.0, robot.arena_height_m, 61),
                Axis("heading", "rad", -math.pi, math.pi, 100, periodic=True),
            ),
            tuple,
            lambda coordinates: NavigationState(*coordinates),
        )
    raise InvalidArgument(f"grid: expected one for {robot.name}, as there is none of ours; hand in a Grid")


def _cartpole_grid(robot: Cartpole) -> Grid:
    if robot.angle_limit_rad > 0.75:
        raise InvalidArgument(
            f"angle_limit_rad: expected at most 0.75 for the cartpole's own grid, got {robot.angle_limit_rad:g}; hand "
            f"in a Grid"
        )
    half_length_m = robot.pole_length_m / 2
    total_kg = robot.cart_mass_kg + robot.pole_mass_kg
    shear_m = 4 / 3 * half_length_m
    step_s = robot.step_s
    gravity = max(robot.gravity_m_per_s2, 1.0)
    rate_per_s = math.sqrt(gravity / (half_length_m * (4 / 3 - robot.pole_mass_kg / total_kg)))
    held_rad = max(robot.force_n, 0.1) / (total_kg * gravity)
    angular_velocity = 1.1 * rate_per_s * (robot.angle_limit_rad + held_rad)
    velocity = math.sqrt(gravity * robot.angle_limit_rad * robot.track_length_m)

    def to_coordinates(state: CartpoleState) -> tuple[Array, ...]:
        x, v, a, w = state
        return x + step_s * v, v + shear_m * w, a + step_s * w, w

    def to_state(coordinates: tuple[Array, ...]) -> CartpoleState:
        x, z, a, w = coordinates
        v = z - shear_m * w
        return CartpoleState(x - step_s * v, v, a - step_s * w, w)

    half_track_m = robot.track_length_m / 2
    return Grid(
        Axis("next cart_position", "m", -half_track_m, half_track_m, 17),
        (
            Axis("cart_velocity + 4/3 l w", "m/s", -velocity, velocity, 17),
            Axis("next pole_angle", "rad", -robot.angle_limit_rad, robot.angle_limit_rad, 41),
            Axis("pole_angular_velocity", "rad/s", -angular_velocity, angular_velocity, 55),
        ),
        to_coordinates,
        to_state,
        smooth_commands=5,
        end_is_known=True,
        noise_in_command=robot.force_noise,
    )
