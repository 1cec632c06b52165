"""Where one iteration leads from the nodes of a grid or from any states, and the neurons' next history."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int32

from animat.errors import InvalidArgument
from animat.evaluation.commands import Commands
from animat.robots.base import Robot
from animat.robots.grid import Grid

ENDED, ENDS_NEXT = -1, -2
_NODES_AT_ONCE = 1 << 18


class Landings(NamedTuple):
    """Where one iteration leads, for each of a few commands and draws of the robot's noise.

    Attributes:
        rows: first of the rows around the next state; the same for all nodes of a row (`Motion.from_grid`).
        row_places: distances from that row in steps.
        nodes: first of the nodes along the row; `ENDED` where the task ended, `ENDS_NEXT` where the next one ends it.
        places: distances from that node in steps; for `ENDS_NEXT` the reward of the next iteration.
    """

    rows: Int32[np.ndarray, "landings rows"]
    row_places: Float32[np.ndarray, "landings rows axes"]
    nodes: Int32[np.ndarray, "landings rows nodes"]
    places: Float32[np.ndarray, "landings rows nodes"]
    rewards: Float32[np.ndarray, "landings rows nodes"]

    def bounds(self) -> Iterator[tuple[float, float]]:
        """The lowest and the highest possible value, with 1, 2, 3, ... iterations left."""
        ended = self.nodes == ENDED
        last = np.concatenate([self.rewards[ended], self.places[self.nodes == ENDS_NEXT]])
        going = self.rewards[~ended]
        lowest = highest = 0.0
        while True:
            lowest = min(float(last.min(initial=np.inf)), float(going.min(initial=np.inf)) + lowest)
            highest = max(float(last.max(initial=-np.inf)), float(going.max(initial=-np.inf)) + highest)
            yield lowest, highest


class Motion:
    """One iteration of a robot as landings on a grid, compiled once; one for each command and, within, noise draw."""

    def __init__(
        self,
        robot: Robot[Any],
        grid: Grid,
        commands: Float[np.ndarray, " commands"],
        uniforms: Float[np.ndarray, "draws noise"],
    ) -> None:
        self._grid = grid
        self._u = jnp.repeat(jnp.asarray(commands, jnp.float32), len(uniforms))
        self._noise = jnp.tile(jnp.asarray(uniforms, jnp.float32), (len(commands), 1))

        def land(state: Any, u: Array, noise: Float[Array, " noise"]) -> tuple[Array, ...]:
            after, reward, terminated = robot.advance(noise, state, u)
            row, row_places, positions, node, place = grid.locate(after)
            if grid.end_is_known:
                _, last_reward, ends = robot.advance(jnp.full(robot.noise_size, 0.5), after, jnp.float32(0))
                node, place = jnp.where(ends, ENDS_NEXT, node), jnp.where(ends, last_reward, place)
            node = jnp.where(terminated, ENDED, node)
            return row, row_places, node, place, jnp.asarray(reward, jnp.float32), positions

        def from_states(states: Any) -> tuple[Array, ...]:
            return jax.vmap(jax.vmap(land, (0, None, None)), (None, 0, 0))(states, self._u, self._noise)

        def from_rows(rows: Int32[Array, " rows"]) -> tuple[Array, ...]:
            along = jnp.arange(grid.along.stored)
            states = jax.vmap(jax.vmap(grid.state_at, (None, 0)), (0, None))(rows, along)
            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
            landed = (x.reshape(len(self._u), len(rows), len(along), *x.shape[2:]) for x in from_states(flat))
            row, row_places, node, place, reward, positions = landed
            middle = len(along) // 2
            apart = jnp.abs(positions - positions[:, :, middle : middle + 1])
            # Positions do not matter once the task has ended.
            apart = jnp.max(jnp.where((node >= 0)[..., None], apart, 0.0), initial=0.0)
            return row[:, :, middle], row_places[:, :, middle], node, place, reward, apart

        self._from_states = jax.jit(from_states)
        self._from_rows = jax.jit(from_rows)

    def from_states(self, states: Any) -> Landings:
        """Landings from states (the robot's own tuple, each array with an axis of states): rows of one node each."""
        row, row_places, *along = (np.asarray(x) for x in self._from_states(states)[:-1])
        return Landings(row, row_places, *(x[:, :, None] for x in along))

    def from_grid(self) -> Landings:
        """Landings from every node of the grid; InvalidArgument if its first coordinate influences the others."""
        grid, n = self._grid, len(self._u)
        at_once = max(1, min(grid.n_rows, _NODES_AT_ONCE // (grid.along.stored * n)))
        rows, nodes = (n, grid.n_rows), (n, grid.n_rows, grid.along.stored)
        kinds = (rows, np.int32), ((*rows, len(grid.rows)), np.float32), (nodes, np.int32), (nodes, np.float32)
        landings = Landings(*(np.empty(shape, kind) for shape, kind in (*kinds, kinds[-1])))
        for start in range(0, grid.n_rows, at_once):
            # The last block starts earlier instead of being shorter, so that only one shape is compiled.
            start = min(start, grid.n_rows - at_once)
            *parts, apart = self._from_rows(jnp.arange(start, start + at_once, dtype=jnp.int32))
            # Rounding may separate the nodes of a row by the last bits, but not more.
            if apart > 0.01:
                name = grid.along.name
                raise InvalidArgument(f"grid: expected a first coordinate that does not change the others, got {name}")
            for whole, part in zip(landings, parts, strict=True):
                whole[:, start : start + at_once] = part
        return landings


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Pairs of a landing of the robot and a layer of values, and their weights in the mean of each layer's actions."""

    pairs: Int32[np.ndarray, "outcomes 2"]
    weights: Float32[np.ndarray, "layers actions outcomes"]

    @classmethod
    def of(
        cls, after: Sequence[Sequence[Commands]], nodes: Float64[np.ndarray, " nodes"], *, smooth: bool, n_draws: int
    ) -> Outcomes:
        """The outcomes of one case: its `commands_after` on `nodes` (`Commands.onto`), each with the noise draws."""
        spread = np.array([[commands.onto(nodes, smooth=smooth) for commands in row] for row in after])
        weights = np.moveaxis(np.repeat(spread / n_draws, n_draws, axis=-1), 1, 2).astype(np.float32)
        then, landings = np.nonzero(np.any(weights != 0, axis=(0, 1)))
        # The same memory layout for all shapes: numba compiles a loop again for each layout.
        of_pairs = np.ascontiguousarray(weights[:, :, then, landings])
        return cls(np.stack([landings, then], axis=1).astype(np.int32), of_pairs)


def side_by_side(
    cases: Sequence[Outcomes],
) -> tuple[Int32[np.ndarray, "layers outcomes 2"], Float32[np.ndarray, "layers actions outcomes"]]:
    """Pairs and weights of several cases, their layers concatenated.

    A case with fewer actions is padded with its last one, one with fewer outcomes with weights of 0.
    """
    most_actions, most_outcomes = (max(case.weights.shape[axis] for case in cases) for axis in (1, 2))
    pairs, weights, first = [], [], 0
    for case in cases:
        layers, actions, outcomes = case.weights.shape
        room = (0, most_outcomes - outcomes)
        shifted = np.pad(case.pairs + np.array([0, first], np.int32), (room, (0, 0)))
        pairs.append(np.repeat(shifted[None], layers, axis=0))
        more = np.pad(case.weights, ((0, 0), (0, most_actions - actions), (0, 0)), mode="edge")
        weights.append(np.pad(more, ((0, 0), (0, 0), room)))
        first += layers
    return np.concatenate(pairs), np.concatenate(weights)
