"""The grid of a robot with a goal, on which optimal returns are computed: the robot's own, where that one suffices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from animat.errors import InvalidArgument
from animat.goals.goal import Objective, margins_of, of_kind
from animat.lazy import Array, jax, jnp
from animat.robots.base import Quantity, Robot, capability
from animat.robots.grid import Axis, Grid

_SAMPLES = 4096
_INSIDE, _BEYOND = 1e-3, 0.01
"""How far inside the ends of an axis a state is put that is beyond them, and how far beyond makes no difference, in
shares of the axis."""


def grid_with_goal(
    robot: Robot[Any],
    objectives: Sequence[Objective],
    spec: Mapping[str, Quantity],
    started: Callable[[Any], Any],
) -> Grid:
    """The robot's own grid, for its states with a goal.

    Args:
        objectives: of the goal.
        spec: the robot's quantities by name.
        started: an episode of the robot with its goal that begins with the body in a state.

    It is unsuited if episodes with the goal go on beyond its ends, where the robot's own task ends.

    Raises:
        InvalidArgument: for a goal with `within`, as the time outside is not part of the grid.
    """
    if any(objective.within is not None for objective in objectives):
        raise InvalidArgument("goal: expected none with `within` for an optimal return, got one")
    grid: Grid = capability(robot, "value_grid")()
    left = zip((grid.along, *grid.rows), _goes_on_beyond(robot, grid, objectives, spec), strict=True)
    is_decided = _is_decided(robot, grid, objectives, spec)
    return replace(
        grid,
        to_coordinates=lambda state: grid.to_coordinates(state.robot),
        to_state=lambda coordinates: started(grid.to_state(coordinates)),
        end_is_known=grid.end_is_known and is_decided,
        smooth_commands=grid.smooth_commands if is_decided else None,
        unsuited=next((_gone_beyond(robot, axis) for axis, is_left in left if is_left), ""),
    )


def _gone_beyond(robot: Robot[Any], axis: Axis) -> str:
    expected = f"one that ends episodes where the grid of {robot.name} ends, for an optimal return"
    where = f"{axis.name.removeprefix('next ')} beyond {axis.low:.3g} to {axis.high:.3g} {axis.unit}"
    return f"goal: expected {expected}, got one with which they go on, {where}"


def _random_nodes(grid: Grid, n: int) -> tuple[Array, Array]:
    """Random nodes: their rows, and their places along these."""
    row, node = jax.random.randint(jax.random.key(0), (2, n), 0, jnp.array([[grid.n_rows], [grid.along.stored]]))
    return row, node


def _goes_on_beyond(
    robot: Robot[Any], grid: Grid, objectives: Sequence[Objective], spec: Mapping[str, Quantity]
) -> Bool[np.ndarray, " axes"]:
    """Whether episodes with the goal go on beyond the ends of each axis where the task ended, and depend on how far.

    Tested on random nodes, from which an iteration leads beyond an end. Axes at whose ends the robot's own task does
    not end, such as those of velocities, are as good for the goal as they are for the task.
    """
    axes = (grid.along, *grid.rows)

    def goal_ends(state: Any) -> Array:
        _, inside = margins_of(objectives, spec, robot.observe(state))
        return jnp.any(inside & of_kind(objectives, "avoid", "reach"))

    def apart(state: Any) -> Array:
        """How far the state is from the edge of each part of each region: unlike margins, also far away."""
        values = dict(zip(spec, robot.observe(state), strict=True))
        return jnp.stack([part.margin(values, spec) for objective in objectives for part in objective.region])

    def leaves(row: Array, node: Array, u: Array) -> Array:
        uniforms = jnp.full(robot.noise_size, 0.5)
        after, _, _ = robot.advance(uniforms, grid.state_at(row, node), u)
        later, _, task_ends = robot.advance(uniforms, after, u)
        goes_on = task_ends & ~goal_ends(after) & ~goal_ends(later)
        coordinates, found = grid.to_coordinates(after), []
        for number, axis in enumerate(axes):
            width, value = axis.high - axis.low, coordinates[number]
            inside = jnp.clip(value, axis.low + _INSIDE * width, axis.high - _INSIDE * width)
            excess = jnp.abs(value - jnp.clip(value, axis.low, axis.high))
            within = grid.to_state((*coordinates[:number], inside, *coordinates[number + 1 :]))
            _, _, ends_within = robot.advance(uniforms, within, u)
            # The first coordinate does not affect how the others move, but these may affect all.
            differs = number > 0 or jnp.any(jnp.abs(apart(after) - apart(within)) > _INSIDE)
            is_left = (excess > _BEYOND * width) & (not axis.periodic)
            found.append(goes_on & ~ends_within & differs & is_left)
        return jnp.stack(found)

    each = jax.vmap(jax.vmap(leaves, (None, None, 0)), (0, 0, None))
    return np.asarray(jax.jit(each)(*_random_nodes(grid, _SAMPLES), jnp.array([-1.0, 1.0])).any(axis=(0, 1)))


def _is_decided(robot: Robot[Any], grid: Grid, objectives: Sequence[Objective], spec: Mapping[str, Quantity]) -> bool:
    """Whether the state decides if the next iteration ends the episode, for any command; tested on random nodes."""
    decide = np.array([objective.can_fail or objective.kind == "reach" for objective in objectives])

    def margins_after(row: Array, node: Array, chance: float, u: float) -> Array:
        after, _, _ = robot.advance(jnp.full(robot.noise_size, chance), grid.state_at(row, node), jnp.float32(u))
        margins, _ = margins_of(objectives, spec, robot.observe(after))
        return margins[decide]

    after = jax.vmap(margins_after, (0, 0, None, None))
    nodes = _random_nodes(grid, 256)
    return bool(jnp.allclose(after(*nodes, 0.0, -1.0), after(*nodes, 1.0, 1.0), atol=1e-5))
