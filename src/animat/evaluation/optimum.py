"""The optimal return: the return that no controller can exceed with these neurons, this mapping and this robot."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt16

from animat.arguments import checked_arguments
from animat.environment import Animat, Environment, Neurons, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.commands import CLASSES, class_of, commands_after, memory_simulator, nodes_for
from animat.evaluation.landings import Motion, Outcomes, side_by_side
from animat.evaluation.rollouts import check_seed
from animat.evaluation.statistics import Interval, standard_error
from animat.evaluation.sweeping import bellman_backup, cubic, fill_row_weights, look_ahead
from animat.neurons.history import INITIAL_HISTORY
from animat.progress import Part, Progress, Silent
from animat.recordings.findings import Finding
from animat.robots.grid import Grid, grid_of_optimum
from animat.robots.starts import Starts
from animat.wrappers import EpisodeLimit, NeuralObservation, ShuffledDelivery

Case = tuple[Environment[Any], Neurons]
"""An environment, and the simulator in it (None without neurons)."""
COARSER = 0.75
"""Steps along each axis of the comparison grid, as a share of those of the grid in use."""
_SAME = 0.01
"""Returns that differ by less count as equal: the standard error is 0 in a deterministic environment."""
_STARTS = 2**14
"""Starts over which a value is averaged: with two goals that are worth 50 more and less, to within 0.4."""
_MOST_MIB = 16_384
_TABLES_AT_ONCE_MIB = 400


@dataclass(frozen=True)
class Optimum:
    """The optimal mean return of any controller, and how well it is known.

    Attributes:
        value: by dynamic programming, for a controller that knows the time left and, with memory, the class of the
            history (one of six: `animat.evaluation.commands.class_of`). What the grid cannot resolve raises it more
            often than it lowers it, as the best of several values is taken: the upper end of a bracket.
        grid_error: difference from the value on a grid with 3/4 of the steps along each axis.
        monte_carlo: mean return of that controller, run on the environment itself: an achievable return, the lower end
            of the bracket. NaN if it was not run, as are the next three.
        without_clock: mean return of the same controller if it always acts as if the whole episode lay ahead: what is
            achievable without knowing the time, like a policy. A better one may exist, not above `value`.
        episodes: in which both were measured; 0 if the controller was not run.
        interval: of the value, given the number of responses (`WellSampled.with_interval`); None if not computed.
        left_out: conditions with too few responses, with their number.
    """

    value: float
    grid_error: float
    monte_carlo: float
    standard_error: float
    without_clock: float
    without_clock_standard_error: float
    episodes: int
    nodes: int
    interval: Interval | None = None
    left_out: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data; None where the controller was not run."""
        return {name: None if value != value else value for name, value in asdict(self).items()}

    def to_text(self) -> str:
        """One line: the value and how well it is known."""
        text, interval = f"optimal return {self.value:.1f}", self.interval
        if interval is not None:
            text += f", {100 * interval.confidence:g} % interval {interval.low:.1f} to {interval.high:.1f}"
        text += f" (grid {self.grid_error:.1f})"
        if self.episodes:
            known = f"{self.monte_carlo:.1f} +- {self.standard_error:.1f}"
            unknown = f"{self.without_clock:.1f} +- {self.without_clock_standard_error:.1f}"
            text += f"; its controller, run: {known}, without knowing the time left {unknown}"
        if self.left_out:
            text += f"; too few responses to count: {', '.join(self.left_out)}"
        return text

    @property
    def achieved(self) -> tuple[float, float]:
        """The larger of its controller's returns, with its standard error; NaN if the controller was not run."""
        runs = (self.monte_carlo, self.standard_error), (self.without_clock, self.without_clock_standard_error)
        return max((run for run in runs if not math.isnan(run[0])), default=(math.nan, math.nan))

    @property
    def is_surpassed(self) -> bool:
        """Whether its own controller returns more, beyond chance: then the value is too low to compare returns with."""
        return any(finding.value is not None and finding.value < 0 for finding in self.findings())

    def findings(self) -> tuple[Finding, ...]:
        """A warning if the value and its controller's return differ by more than chance and the grid's error."""
        return bracket_findings(self.value, self.grid_error, *self.achieved)


def bracket_findings(value: float, grid_error: float, monte_carlo: float, error: float) -> tuple[Finding, ...]:
    """A warning if a value and its controller's return differ by more than 3 of its `error` plus the grid's error."""
    difference, of_controller = value - monte_carlo, f"its controller's return {monte_carlo:.2f} +- {error:.2f}"
    # No warning for NaN, where the controller was not run.
    if not abs(difference) > max(_SAME, 3 * error + grid_error):
        return ()
    too_coarse = (
        ", which is achievable, differ: the grid is too coarse, or with a memory simulator its "
        f"{CLASSES} history classes are; use a higher resolution"
    )
    which = " differ: the optimal return lies between the two" if difference > 0 else too_coarse
    message = f"the value {value:.2f} (grid {grid_error:.2f}) and {of_controller}{which}"
    return (Finding("optimum", "warning", message, difference),)


@checked_arguments
def best_return(environment: Environment[Any], simulator: Neurons, **options: Any) -> Optimum:
    """The optimal mean return of any controller in one environment.

    Args:
        simulator: what answers the stimuli; None without neurons.
        options: `grid`, `resolution`, `episodes`, `seed` and `progress`, as in `best_returns`, which also has the
            method and the errors.
    """
    return best_returns([(environment, simulator)], **options)[0]


@checked_arguments
def best_returns(
    cases: Sequence[Case],
    *,
    grid: Grid | None = None,
    resolution: float = 1.0,
    episodes: int = 4000,
    seed: int = 1,
    progress: Progress | None = None,
) -> tuple[Optimum, ...]:
    """The optimal mean return of any controller, for several mappings or simulators of one robot at once.

        V_0 = 0,    V_n(s) = max_a E[r + (1 - end) V_(n-1)(s') | s, a],    value = V_limit(start)

    with the expectation over the command that action a leads to (`commands_of`) and over the robot's noise. With
    memory, s also contains the class of the history (`commands_after`). V is stored at the nodes of a grid and
    interpolated by cubic polynomials along each axis, so the value is an approximation; `grid_error` shows how good.
    The controller that takes the maximising action, run on the environment, gives an achievable return: it exceeds the
    true optimum only by chance.

    Args:
        cases: environments, all of the same robot, each with its simulator (None without neurons).
        grid: over the robot's states; None: `grid_of_optimum(robot)`.
        resolution: factor for the steps of the grid along each axis; 0.6 is fast and coarse.
        episodes: of the controller; 0: it is not run, which is faster.
        seed: decides every random draw.
        progress: updated as the returns of all cases are computed.

    Raises:
        InvalidArgument: for no cases, an environment of unknown effect, a robot without a grid, or an invalid number.
        Mismatch: for cases of different robots.
    """
    if not cases:
        raise InvalidArgument("cases: expected at least one environment, got none")
    if episodes < 2 and episodes != 0:
        raise InvalidArgument(f"episodes: expected at least 2, or 0 not to run the controller, got {episodes}")
    if not (math.isfinite(resolution) and resolution > 0):
        raise InvalidArgument(f"resolution: expected a positive number, got {resolution!r}")
    check_seed(seed)
    robot = cases[0][0].robot
    for environment, _ in cases:
        if environment.robot != robot:
            raise Mismatch(f"cases: expected the same robot in all, got {robot} and {environment.robot}")
        _expect_known(environment)
    fine = (grid_of_optimum(robot) if grid is None else grid).scaled(resolution)
    coarse = fine.scaled(COARSER, periodic=True)
    progress = Silent() if progress is None else progress

    layers = max(1 if memory_simulator(*case) is None else CLASSES for case in cases)
    kept_mib = 2 * fine.size * layers * robot.episode_limit / 2**20
    if episodes and kept_mib > _MOST_MIB:
        most, took = f"{_MOST_MIB / 1024:g} GiB", f"{resolution:g}, which takes {kept_mib / 1024:.3g} GiB"
        raise InvalidArgument(f"resolution: expected tables that fit into {most}, got {took}: use a smaller one")
    at_once = max(1, int(_TABLES_AT_ONCE_MIB / kept_mib))
    optima: list[Optimum] = []
    for start in range(0, len(cases), at_once):
        batch = cases[start : start + at_once]
        part = Part(progress, start, len(batch), len(cases))
        on_coarse = _Programme(coarse, batch).run(None, seed, Part(part, 0, 1, 4))
        programme = _Programme(fine, batch)
        tables = _Tables(fine, programme.n_layers, robot.episode_limit) if episodes else None
        values = programme.run(tables, seed, Part(part, 1, 3, 4))
        for case, (value, coarser) in enumerate(zip(values.tolist(), on_coarse.tolist(), strict=True)):
            run = math.nan, math.nan, math.nan, math.nan
            if tables is not None:
                known, unknown = (programme.play(tables, case, episodes, seed, clock=clock) for clock in (True, False))
                run = float(known.mean()), standard_error(known), float(unknown.mean()), standard_error(unknown)
            optima.append(Optimum(value, abs(value - coarser), *run, episodes, fine.size))
        progress.update(len(optima), len(cases), f"optimum {optima[-1].value:.1f}")
    return tuple(optima)


def optimal_values(
    cases: Sequence[Case], grid: Grid, seed: int, progress: Progress | None = None, *, starts: Starts | None = None
) -> tuple[Float64[np.ndarray, " cases"], tuple[float, float]]:
    """Only the values, of many cases on a given grid, and the lowest and the highest possible return.

    They are means over `starts`; None: over starts that the robot draws.
    """
    programme = _Programme(grid, cases)
    return programme.run(None, seed, progress or Silent(), starts), programme.bounds


def _expect_known(environment: Environment[Any]) -> None:
    """Refuse an environment that may change what dynamic programming computes from the robot's own steps."""
    inmost = environment
    while isinstance(inmost, EpisodeLimit | NeuralObservation | ShuffledDelivery):
        inmost = inmost.inside
    kind, kinds = type(inmost), (Animat, WithoutNeurons)
    if (kind.respond, kind.advance) not in [(known.respond, known.advance) for known in kinds]:
        got = f"{kind.__name__}, whose optimal return is not known"
        raise InvalidArgument(f"environment: expected an Animat or WithoutNeurons, in wrappers of animat, got {got}")


# At module level, so that it is compiled once, with the clock and without.
@partial(jax.jit, static_argnums=(0, 1))
def _step(environment: Environment[Any], episodes: int, key: Any, state: Any, action: Any, simulator: Any) -> Any:
    uniforms = jax.random.uniform(key, (episodes, environment.noise_size), np.float32)
    return jax.vmap(environment.advance, (0, 0, 0, None))(uniforms, state, action, simulator)


class _Tables:
    """Values for every time left, for the controller to look up; in 16 bits each, as all of them are kept."""

    def __init__(self, grid: Grid, n_layers: int, n_times: int) -> None:
        self._shape = (grid.n_rows, grid.along.stored)
        self._kept: UInt16[np.ndarray, "times layers nodes"] = np.empty((n_times, n_layers, grid.size), np.uint16)
        self._low = np.empty((n_times, n_layers))
        self._step = np.empty((n_times, n_layers))

    def keep(self, remaining: int, values: Float32[np.ndarray, "rows layers nodes"]) -> None:
        for layer in range(values.shape[1]):
            of_layer = values[:, layer].ravel()
            low, high = float(of_layer.min()), float(of_layer.max())
            step = max(high - low, 1e-6) / 65535
            self._low[remaining, layer], self._step[remaining, layer] = low, step
            # Truncation after adding a half rounds, in one pass less than `np.rint`.
            self._kept[remaining, layer] = (of_layer - np.float32(low)) * np.float32(1 / step) + np.float32(0.5)

    def values(self, remaining: int, layers: slice) -> Float32[np.ndarray, "rows layers nodes"]:
        kept: Float32[np.ndarray, "layers nodes"] = self._kept[remaining, layers].astype(np.float32)
        kept *= self._step[remaining, layers, None].astype(np.float32)
        kept += self._low[remaining, layers, None].astype(np.float32)
        return np.ascontiguousarray(np.moveaxis(kept.reshape(len(kept), *self._shape), 0, 1))


class _Programme:
    """Dynamic programming on one grid, for some cases at once."""

    def __init__(self, grid: Grid, cases: Sequence[Case]) -> None:
        self._grid, self._cases = grid, cases
        self._robot = robot = cases[0][0].robot
        after = [commands_after(*case) for case in cases]
        self._actions = [of_case[0][0].actions for of_case in after]
        uniforms: Float[np.ndarray, "draws noise"] = np.full((1, robot.noise_size), 0.5)
        if (noise := grid.noise_in_command) is not None:
            after = [[[each.with_noise(noise) for each in row] for row in of_case] for of_case in after]
        elif robot.noise_size:
            # Two points for each number: exact for the mean of a cubic polynomial.
            points = (0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12))
            uniforms = np.array(list(itertools.product(points, repeat=robot.noise_size)))
        every = [commands for of_case in after for row in of_case for commands in row]
        nodes, smooth = nodes_for(every, grid.smooth_commands)
        self._outcomes = [Outcomes.of(of_case, nodes, smooth=smooth, n_draws=len(uniforms)) for of_case in after]
        ends = np.cumsum([len(of_case) for of_case in after]).tolist()
        self._layers = [slice(end - len(of_case), end) for end, of_case in zip(ends, after, strict=True)]
        self.n_layers = ends[-1]
        self._motion = Motion(robot, grid, nodes, uniforms)
        self.bounds = -math.inf, math.inf

    def run(
        self, tables: _Tables | None, seed: int, progress: Progress, starts: Starts | None = None
    ) -> Float64[np.ndarray, " cases"]:
        """Step back from the end of an episode to its start; returns the mean value there, keeps all in the tables."""
        grid = self._grid
        landings = self._motion.from_grid()
        pairs, weights = side_by_side(self._outcomes)
        values = np.zeros((grid.n_rows, self.n_layers, grid.along.stored), np.float32)
        before = np.empty_like(values)
        for remaining, (lowest, highest) in zip(range(self._robot.episode_limit), landings.bounds(), strict=False):
            self.bounds = lowest, highest
            if tables is not None:
                tables.keep(remaining, values)
            ends = np.float32(lowest), np.float32(highest)
            led_to = grid.row_offsets, pairs, weights
            bellman_backup(values.reshape(-1), *landings, *led_to, remaining, *ends, before.reshape(-1))
            values, before = before, values
            progress.update(remaining + 1, self._robot.episode_limit)
        first = np.array([INITIAL_HISTORY])
        at_first = [of_case.start + int(self._layer_at(case, first)[0]) for case, of_case in enumerate(self._layers)]
        drawn = jax.random.split(jax.random.key(seed), _STARTS)
        states = jax.vmap(self._robot.reset)(drawn if starts is None else starts.of_episodes(starts.rounds))
        return self._mean_over(values[:, at_first], states)

    def play(
        self, tables: _Tables, case: int, episodes: int, seed: int, *, clock: bool
    ) -> Float64[np.ndarray, " episodes"]:
        """Returns of the maximising controller on the environment itself."""
        (environment, simulator), limit = self._cases[case], self._robot.episode_limit
        outcomes, actions = self._outcomes[case], self._actions[case]
        pairs = np.repeat(outcomes.pairs[None], len(outcomes.weights), axis=0)

        first, others = jax.random.split(jax.random.key(seed))
        state = jax.vmap(environment.reset)(jax.random.split(first, episodes))
        returns = np.zeros(episodes)
        going = np.ones(episodes, bool)
        chosen = np.zeros(episodes, np.int32)
        for iteration, key in enumerate(jax.random.split(others, limit)):
            remaining = limit - 1 - iteration if clock else limit - 1
            rows, row_places, *along = self._motion.from_states(state.robot)
            landings = rows, row_places, *(each[:, :, 0] for each in along)
            values, layers = tables.values(remaining, self._layers[case]), self._layer_at(case, state.neurons)
            led_to = layers, pairs, outcomes.weights
            look_ahead(values, *landings, self._grid.row_offsets, *led_to, remaining, chosen)
            state = _step(environment, episodes, key, state, actions[chosen], simulator)
            returns += np.where(going, np.asarray(state.reward, np.float64), 0.0)
            going &= ~np.asarray(state.ended.terminated)
            if not going.any():
                break
        return returns

    def _layer_at(self, case: int, history: Float[Any, "episodes 2"]) -> Int32[np.ndarray, " episodes"]:
        """The layer of each episode among those of a case, by its history."""
        memory = memory_simulator(*self._cases[case])
        return np.zeros(len(history), np.int32) if memory is None else np.asarray(class_of(memory, history), np.int32)

    def _mean_over(self, values: Float32[np.ndarray, "rows cases nodes"], states: Any) -> Float64[np.ndarray, " cases"]:
        """The mean value of each case over some states, interpolated."""
        row, row_places, _, node, place = (np.asarray(x) for x in jax.vmap(self._grid.locate)(states))
        alike, counts = np.unique(np.column_stack([row, node, place, row_places]), axis=0, return_counts=True)
        weights = np.empty(len(self._grid.row_offsets), np.float32)
        total = np.zeros(values.shape[1])
        corners, distances = alike[:, :2].astype(np.int64), alike[:, 2:].astype(np.float32)
        for (row, node), places, n in zip(corners, distances, counts, strict=True):
            fill_row_weights(places[1:], weights)
            around = values[row + self._grid.row_offsets, :, node : node + 4]
            total += n * np.einsum("t,tcn,n->c", weights, around, np.array(cubic(places[0])))
        return np.asarray(total / counts.sum())
