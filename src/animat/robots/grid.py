"""Grids over a robot's states, on which dynamic programming computes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int32

from animat.errors import InvalidArgument, first_line, shown
from animat.lazy import Array, jnp
from animat.robots.base import Robot, capability

_FINEST = 8192.0
TAPS = 4
"""Nodes along an axis used to interpolate a value: cubic polynomials."""


@dataclass(frozen=True)
class Axis:
    """Evenly spaced values of one coordinate.

    Attributes:
        low, high: its ends; a state beyond them has the value of the end.
        nodes: number of values, at least 4, including both ends (for a periodic axis, only the lower one).
        periodic: whether `high` is the same as `low`.
    """

    name: str
    unit: str
    low: float
    high: float
    nodes: int
    periodic: bool = False

    def __post_init__(self) -> None:
        if not (self.nodes >= TAPS and math.isfinite(self.high - self.low) and self.high > self.low):
            got = f"{self.low:g} to {self.high:g} with {self.nodes}"
            raise InvalidArgument(f"axis {self.name}: expected rising ends and at least {TAPS} nodes, got {got}")

    @property
    def step(self) -> float:
        """The distance between neighbouring nodes."""
        return (self.high - self.low) / (self.nodes if self.periodic else self.nodes - 1)

    @property
    def stored(self) -> int:
        """Number of stored nodes: a periodic axis is extended by one before its start and two after its end."""
        return self.nodes + 3 if self.periodic else self.nodes

    def values(self, index: Array) -> Array:
        """The coordinates of stored nodes."""
        steps = index - (1 if self.periodic else 0)
        return jnp.asarray(jnp.float32(self.low) + steps * jnp.float32(self.step))

    def locate(self, value: Array) -> tuple[Array, Array]:
        """The first of the four stored nodes around a value, and the value's distance from it in steps."""
        place = (value - jnp.float32(self.low)) / jnp.float32(self.step)
        # A robot often lands exactly on a node; the last bits must not decide on which side.
        place = jnp.round(place * _FINEST) / _FINEST
        place = jnp.mod(place, self.nodes) + 1 if self.periodic else jnp.clip(place, 0, self.nodes - 1)
        first = jnp.clip(jnp.floor(place) - 1, 0, self.stored - TAPS)
        return first.astype(jnp.int32), (place - first).astype(jnp.float32)


@dataclass(frozen=True)
class Grid:
    """Nodes over a robot's states, in coordinates that suit its motion.

    The first coordinate must not affect how the others move, such as the position of a cart on its track; the others
    span the *rows*. Nodes are stored row by row.

    Attributes:
        along: the first coordinate.
        rows: the other coordinates, possibly none.
        to_coordinates: converts a robot's state to its coordinates, `along` first.
        to_state: the inverse.
        smooth_commands: number of commands through which a polynomial describes well enough where an iteration leads;
            None: a command can decide whether an episode ends, and every level is computed separately.
        end_is_known: whether a state alone decides if the next iteration ends the task; states beyond the ends of
            the axes are then never treated as those just inside.
        noise_in_command: the robot's noise as the largest uniform change of the command either way; None: another form.
        unsuited: why no optimal return can be computed on it; empty: one can.
    """

    along: Axis
    rows: tuple[Axis, ...]
    to_coordinates: Callable[[Any], tuple[Array, ...]]
    to_state: Callable[[tuple[Array, ...]], Any]
    smooth_commands: int | None = None
    end_is_known: bool = False
    noise_in_command: float | None = None
    unsuited: str = ""

    @property
    def n_rows(self) -> int:
        """Number of stored rows."""
        return math.prod(axis.stored for axis in self.rows)

    @property
    def size(self) -> int:
        """Total number of stored nodes."""
        return self.n_rows * self.along.stored

    @property
    def row_offsets(self) -> Int32[np.ndarray, " taps"]:
        """The 4^axes rows around a state, counted from the first of them."""
        offsets = np.zeros(1, np.int32)
        for stride in self._strides():
            offsets = (offsets[:, None] + np.arange(TAPS, dtype=np.int32) * np.int32(stride)).ravel()
        return offsets

    def scaled(self, factor: float, *, periodic: bool = False) -> Grid:
        """The same grid with `factor` times as many steps along each axis.

        An axis with a middle node keeps one, as the start is often there. Periodic axes, whose nodes match the turns
        that a robot makes, are scaled only if `periodic`.
        """

        def scaled_axis(axis: Axis) -> Axis:
            if axis.periodic:
                return replace(axis, nodes=max(TAPS, round(factor * axis.nodes))) if periodic else axis
            half = max(2, round(factor * (axis.nodes - 1) / 2))
            nodes = 2 * half + 1 if axis.nodes % 2 else max(TAPS, round(factor * (axis.nodes - 1)) + 1)
            return replace(axis, nodes=nodes)

        return replace(self, along=scaled_axis(self.along), rows=tuple(map(scaled_axis, self.rows)))

    def locate(self, state: Any) -> tuple[Array, Array, Array, Array, Array]:
        """A state's place between the nodes.

        The first of the 4^axes rows around it, and the distances from it in steps; the places among all stored nodes of
        each of these axes; the first of the four nodes around it along a row, and the distance from it.
        """
        along, *others = self.to_coordinates(state)
        row = jnp.int32(0)
        places, positions = [], []
        for axis, stride, value in zip(self.rows, self._strides(), others, strict=True):
            first, place = axis.locate(value)
            row += first * stride
            places.append(place)
            positions.append(first + place)
        row_places, at = (jnp.stack(each) if each else jnp.zeros(0, jnp.float32) for each in (places, positions))
        return row, row_places, at, *self.along.locate(along)

    def state_at(self, row: Array, node: Array) -> Any:
        """The robot's state at a node of a row."""
        indices = jnp.unravel_index(row, tuple(axis.stored for axis in self.rows)) if self.rows else ()
        others = (axis.values(i) for axis, i in zip(self.rows, indices, strict=True))
        return self.to_state((self.along.values(node), *others))

    def _strides(self) -> tuple[int, ...]:
        stored = [axis.stored for axis in self.rows]
        return tuple(math.prod(stored[i + 1 :]) for i in range(len(stored)))


def grid_for(robot: Robot[Any]) -> Grid:
    """The robot's own `value_grid`; InvalidArgument if it has none (for its parameters), or for several commands."""
    if robot.n_commands > 1:
        raise InvalidArgument(f"{robot.name}: expected one command for an optimal return, got {robot.n_commands}")
    make = capability(robot, "value_grid")
    try:
        grid = make()
    except InvalidArgument:
        raise
    except Exception as error:
        # Anything may go wrong in a user's robot.
        raise InvalidArgument(f"{robot.name}.value_grid: expected a Grid, got {first_line(error)}") from error
    if not isinstance(grid, Grid):
        raise InvalidArgument(f"{robot.name}.value_grid: expected a Grid, got {shown(grid)}")
    return grid


def grid_of_optimum(robot: Robot[Any]) -> Grid:
    """`grid_for` an optimal return; InvalidArgument also for a grid that is unsuited."""
    grid = grid_for(robot)
    if grid.unsuited:
        raise InvalidArgument(grid.unsuited)
    return grid


def why_no_grid(robot: Robot[Any]) -> str | None:
    """Why there is no grid for an optimal return of this robot; None if there is one."""
    try:
        grid_of_optimum(robot)
    except InvalidArgument as error:
        return str(error)
    return None
