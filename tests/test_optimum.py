"""The optimal return against closed forms, exhaustive searches, and the environments themselves."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.coding.mapping import Linear, Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument, Mismatch
from animat.evaluation.commands import Commands, commands_of, nodes_for
from animat.evaluation.optimum import Optimum, best_return, best_returns, bracket_findings
from animat.evaluation.rollouts import Constant, Uniform, roll_out
from animat.evaluation.sweeping import bellman_backup, cubic, look_ahead
from animat.neurons.simulator import EmpiricalSimulator
from animat.neurons.synthetic import synthetic_simulator
from animat.report.results import StudyOptimum
from animat.robots.base import Quantity, Robot
from animat.robots.cartpole import Cartpole
from animat.robots.grid import Axis, Grid, grid_for
from animat.robots.navigation import Navigation, NavigationState
from animat.wrappers import ReversedMapping, ShuffledDelivery, YokedDelivery

SIMULATOR = synthetic_simulator()


def coins(*heads: int) -> EmpiricalSimulator:
    """Neurons that pass the only threshold in a given number of ten responses, for each condition."""
    values = np.array([[0.0] * (10 - n) + [1.0] * n for n in heads])
    return EmpiricalSimulator(
        jnp.asarray(values, jnp.float32), jnp.full(len(heads), 10), jnp.linspace(0, 1, 11, dtype=jnp.float32)
    )


class StairState(NamedTuple):
    step: Any


@dataclass(frozen=True)
class Stairs(Robot[StairState]):
    """Up or down one of four steps from the middle; 1 at the top, 0 at the bottom, both the end."""

    episode_limit: int = 200
    noise_size: ClassVar[int] = 0
    name: ClassVar[str] = "stairs"
    paper_iterations: ClassVar[int] = 0

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("step", "1", 1.0),)

    def reset(self, key: Any) -> StairState:
        return StairState(jnp.float32(2))

    def advance(self, uniforms: Any, state: StairState, u: Any) -> tuple[StairState, Any, Any]:
        step = state.step + jnp.where(u > 0, 1.0, -1.0)
        return StairState(step), jnp.where(step >= 4, 1.0, 0.0), (step >= 4) | (step <= 0)

    def observe(self, state: StairState) -> Any:
        return jnp.stack(state)


STEPS = Grid(Axis("step", "1", 0.0, 4.0, 5), (), tuple, lambda coordinates: StairState(*coordinates))


def test_gamblers_ruin() -> None:
    """With the better coin (0.6), the top comes first with probability 1 / (1 + (q / p)^2)."""
    found = best_return(Animat(Stairs(), Thresholds(1), 2), coins(3, 6), grid=STEPS)
    truth = 1 / (1 + (0.4 / 0.6) ** 2)
    assert found.value == pytest.approx(truth, abs=1e-5)
    assert found.grid_error == pytest.approx(0, abs=1e-6)
    assert abs(found.monte_carlo - truth) < 4 * found.standard_error
    assert abs(found.without_clock - truth) < 4 * found.without_clock_standard_error
    json.dumps(found.to_dict())
    assert f"{found.value:.1f}" in found.to_text()
    assert not found.findings()


def test_the_best_of_many_conditions_is_found() -> None:
    """As many as an array has electrodes; only the last is the better coin."""
    environment = Animat(Stairs(), Thresholds(1), 300)
    found = best_return(environment, coins(*[3] * 299, 6), grid=STEPS, episodes=1000)
    truth = 1 / (1 + (0.4 / 0.6) ** 2)
    assert found.value == pytest.approx(truth, abs=1e-5)
    assert abs(found.monte_carlo - truth) < 4 * found.standard_error


@pytest.mark.parametrize(("limit", "truth"), [(1, 0.0), (2, 0.36), (3, 0.36), (4, 0.36 + 2 * 0.24 * 0.36)])
def test_short_horizons_by_hand(limit: int, truth: float) -> None:
    """Two up, or one down on the way: p p, then (p q + q p) p p more."""
    better = Animat(Stairs(limit), Thresholds(1), 2), coins(3, 6)
    assert best_return(*better, grid=STEPS, episodes=0).value == pytest.approx(truth, abs=1e-5)
    # Beside cases of other values, with fewer actions and outcomes, each has its own.
    head = Animat(Stairs(limit), Thresholds(1), 1), coins(10)
    found = best_returns([head, better, head], grid=STEPS, episodes=0)
    assert [each.value for each in found] == pytest.approx([float(limit > 1), truth, float(limit > 1)], abs=1e-5)


@dataclass(frozen=True)
class Lottery(Stairs):
    """Two iterations whose rewards are cubic in the robot's own noise."""

    episode_limit: int = 2
    noise_size: ClassVar[int] = 1
    name: ClassVar[str] = "lottery"

    def advance(self, uniforms: Any, state: StairState, u: Any) -> tuple[StairState, Any, Any]:
        return state, u + uniforms[0] ** 3, jnp.bool_(False)


def test_noise_of_the_robot_is_averaged_over() -> None:
    """The mean of a cubed uniform is 1/4; the best command is 1."""
    found = best_return(WithoutNeurons(Lottery(), None), None, grid=STEPS)
    assert found.value == pytest.approx(2 * (1 + 1 / 4), abs=1e-5)
    assert abs(found.monte_carlo - found.value) < 4 * found.standard_error
    # What can only lose loses as much beside what has more to choose from.
    losing, either = ((Animat(Lottery(), Thresholds(1), len(heads)), coins(*heads)) for heads in ((0,), (0, 10)))
    values = [each.value for each in best_returns([losing, either], grid=STEPS, episodes=0)]
    assert values == pytest.approx([2 * (-1 + 1 / 4), 2 * (1 + 1 / 4)], abs=1e-5)


@dataclass(frozen=True)
class FromEitherSide(Stairs):
    """Starts on the step below or above the middle, as likely."""

    name: ClassVar[str] = "from-either-side"

    def reset(self, key: Any) -> StairState:
        return StairState(jnp.where(jax.random.uniform(key) < 0.5, 1.0, 3.0))


@pytest.mark.oracle
def test_random_starts_are_averaged_over() -> None:
    """With a fair coin the top comes first with probability 1/4 from below the middle, 3/4 from above it."""
    environment = Animat(FromEitherSide(), Thresholds(1), 2)
    values = [best_return(environment, coins(5, 5), grid=STEPS, episodes=0, seed=seed).value for seed in range(5)]
    assert values == pytest.approx([0.5] * 5, abs=0.006)


def expectimax(environment: Animat[Any], simulator: Any) -> float:
    """Exhaustive search: every command at every iteration, solved backwards by the best action."""
    robot = environment.robot
    commands = commands_of(environment, simulator)
    noise = jnp.full(robot.noise_size, 0.5)
    step = jax.jit(jax.vmap(lambda state, u: robot.advance(noise, state, u), (0, None)))
    state = jax.tree.map(lambda x: jnp.asarray(x)[None], robot.reset(jax.random.key(0)))
    levels = commands.levels[0]
    rewards, ends = [], []
    for _ in range(robot.episode_limit):
        after = [step(state, jnp.float32(u)) for u in levels]
        rewards.append(np.stack([np.asarray(r, float) for _, r, _ in after], -1))
        ends.append(np.stack([np.asarray(e) for _, _, e in after], -1))
        state = jax.tree.map(lambda *xs: jnp.stack(xs, -1).ravel(), *[s for s, _, _ in after])
    worth = np.zeros(len(jax.tree.leaves(state)[0]))
    for reward, end in zip(reversed(rewards), reversed(ends), strict=True):
        of_levels = reward + np.where(end, 0.0, worth.reshape(reward.shape))
        worth = (of_levels @ commands.probabilities.T).max(-1)
    return float(worth[0])


@pytest.mark.oracle
def test_navigation_against_exhaustive_search() -> None:
    """Nine iterations with two commands, from a start near the goal, which some paths reach."""
    robot = Navigation(episode_limit=9, goal_x_m=0.2, goal_y_m=0.12, goal_radius_m=0.06)
    environment = Animat(robot, Thresholds(1), 5)
    truth = expectimax(environment, SIMULATOR)
    found = best_return(environment, SIMULATOR, resolution=2.0)
    assert found.value == pytest.approx(truth, abs=3 * found.grid_error + 0.2)
    assert abs(found.monte_carlo - truth) < 4 * found.standard_error + 0.1


@pytest.mark.oracle
def test_navigation_with_ten_levels_against_exhaustive_search() -> None:
    environment = Animat(Navigation(episode_limit=4), Thresholds(9), 5)
    found = best_return(environment, SIMULATOR, resolution=0.5, episodes=0)
    assert found.value == pytest.approx(expectimax(environment, SIMULATOR), abs=0.003)


@pytest.mark.oracle
def test_cartpole_against_exhaustive_search() -> None:
    """Twelve pushes, too strong and without noise: many sequences fall."""
    robot = Cartpole(force_n=4.0, force_noise=0.0, episode_limit=12)
    environment = Animat(robot, Thresholds(1), 5)
    truth = expectimax(environment, SIMULATOR)
    assert truth < 0
    found = best_return(environment, SIMULATOR)
    assert found.value == pytest.approx(truth, abs=3 * found.grid_error + 0.5)


@pytest.mark.oracle
@pytest.mark.parametrize(("robot", "resolution"), [(Cartpole(), 0.75), (Navigation(), 0.5)])
def test_where_nothing_can_be_chosen_the_optimum_is_the_mean_return(robot: Robot[Any], resolution: float) -> None:
    """With the delivered condition drawn at random all policies are equivalent; their mean return is measured."""
    environment = ShuffledDelivery(Animat(robot, Thresholds(1), 5))
    found = best_return(environment, SIMULATOR, resolution=resolution, episodes=0)
    returns = roll_out(environment, SIMULATOR, Uniform(), episodes=8000, seed=5).returns
    error = float(returns.std() / math.sqrt(returns.size))
    assert abs(found.value - returns.mean()) < 4 * error + found.grid_error


@pytest.mark.oracle
def test_a_pole_is_balanced_without_neurons() -> None:
    found = best_return(WithoutNeurons(Cartpole(), (-1.0, 1.0)), None, resolution=0.6, episodes=100)
    assert found.value == pytest.approx(120, abs=0.01)
    assert found.monte_carlo == 120


@pytest.mark.oracle
def test_more_separated_conditions_allow_more() -> None:
    robot = Navigation()
    means = [[42.0 + spread * (i - 2) for i in range(5)] for spread in (0.0, 3.0, 6.0, 9.0)]
    cases = [(Animat(robot, Thresholds(1), 5), synthetic_simulator(m)) for m in means]
    found = best_returns(cases, resolution=0.5, episodes=0)
    values = [optimum.value for optimum in found]
    assert values == sorted(values)
    assert values[-1] - values[0] > 20
    one = best_return(*cases[2], resolution=0.5, episodes=0)
    assert one.value == pytest.approx(values[2], abs=0.01)


@pytest.mark.oracle
@pytest.mark.parametrize("robot", [Cartpole(), Navigation()])
@pytest.mark.parametrize("mapping", [Thresholds(1), Thresholds(9), Linear()])
def test_the_controller_reaches_the_value(robot: Robot[Any], mapping: Any) -> None:
    environment = Animat(robot, mapping, 5)
    found = best_return(environment, SIMULATOR)
    assert not found.findings()
    assert found.without_clock < found.value + 4 * found.without_clock_standard_error
    for action in range(5):
        constant = roll_out(environment, SIMULATOR, Constant(jnp.array([action])), episodes=1000, seed=2).returns
        assert constant.mean() - 4 * constant.std() / math.sqrt(1000) < found.value


def test_without_running_the_controller_only_the_value_is_known() -> None:
    environment = Animat(Stairs(), Thresholds(1), 2)
    run, alone = (best_return(environment, coins(3, 6), grid=STEPS, episodes=episodes) for episodes in (20, 0))
    assert (alone.value, alone.grid_error, alone.nodes) == (run.value, run.grid_error, run.nodes)
    assert alone.episodes == 0
    assert alone.to_dict()["monte_carlo"] is None
    assert "run" not in alone.to_text()
    assert not alone.findings()


def test_a_value_that_its_controller_does_not_reach_is_reported() -> None:
    """A difference of 3 standard errors plus the grid's error is chance; a larger one a bracket or a coarse grid."""
    assert not bracket_findings(100.0, 0.5, 98.1, 0.5)
    assert not bracket_findings(23.904, 0.001, 23.902, 0.0)  # deterministic: the two look the same when printed
    # What is achieved without knowing the time left is achieved.
    optimum = Optimum(100.0, 0.5, 90.0, 0.5, 99.0, 0.5, 100, 1000)
    assert not optimum.findings() and replace(optimum, without_clock=97.0).findings()[0].value == 3.0
    assert not replace(optimum, monte_carlo=99.0, without_clock=90.0).findings()
    assert replace(optimum, monte_carlo=math.nan).achieved == (99.0, 0.5) == optimum.achieved
    row = StudyOptimum("cartpole", "linear", "first", 0.0, 100.0, None, None, 0.5, 90.0, 0.5, 99.0, 0.5, 1000, None)
    assert row.findings() == () and replace(row, without_clock=97.0).findings() == (
        replace(optimum, without_clock=97.0).findings()
    )
    assert replace(row, without_clock=None).findings()[0].value == 10.0
    (above,) = bracket_findings(100.0, 0.5, 97.9, 0.5)
    assert "between the two" in above.message and above.value == pytest.approx(2.1)
    (below,) = bracket_findings(100.0, 0.5, 102.1, 0.5)
    assert "too coarse" in below.message
    for achieved, is_surpassed in ((97.0, False), (99.0, False), (101.9, False), (102.1, True)):
        assert replace(optimum, without_clock=achieved).is_surpassed == is_surpassed
        assert replace(row, without_clock=achieved).is_surpassed == is_surpassed


@pytest.mark.oracle
def test_a_too_coarse_grid_is_reported() -> None:
    """Nine places for an arena of which the goal is a tenth."""
    grid = grid_for(Navigation()).scaled(0.12)
    found = best_return(WithoutNeurons(Navigation(), None), None, grid=grid, episodes=200)
    (finding,) = found.findings()
    assert finding.name == "optimum"


def test_the_grid_error_includes_headings() -> None:
    """A resolution keeps the headings that turns lead to; the comparison grid does not."""
    grid = grid_for(Navigation()).scaled(0.3)
    assert grid.scaled(0.75).rows[1].nodes == 100
    assert grid.scaled(0.75, periodic=True).rows[1].nodes == 75


@pytest.mark.long
def test_the_cartpoles_grid_is_fine_enough() -> None:
    """Three refinements of 9 thresholds, the hardest: the default is within 1 of the finest."""
    case = (Animat(Cartpole(), Thresholds(9), 5), SIMULATOR)
    default, finest = (best_return(*case, resolution=r, episodes=2).value for r in (1.0, 1.4))
    assert default == pytest.approx(finest, abs=1.0)


def test_probabilities_of_commands_are_those_of_the_distribution() -> None:
    commands = commands_of(Animat(Navigation(), Thresholds(9), 5), SIMULATOR)
    edges, percentiles = np.asarray(SIMULATOR.edges_hz), np.asarray(SIMULATOR.percentiles)
    for row, cumulative in zip(commands.probabilities, np.asarray(SIMULATOR.cumulative), strict=True):
        below = np.interp(percentiles[1:10], edges, cumulative)
        np.testing.assert_allclose(row, np.diff(np.pad(below, 1, constant_values=(0, 1))), atol=2e-6)
    np.testing.assert_allclose(commands.levels[0], Thresholds(9).levels)


def test_a_response_on_the_threshold_is_above_it() -> None:
    """Measured values, five of ten on the median itself."""
    values = jnp.asarray([[0.0] * 5 + [0.5] * 5, [0.0] * 10, [1.0] * 10], jnp.float32)
    simulator = EmpiricalSimulator(values, jnp.full(3, 10), jnp.linspace(0, 1, 11, dtype=jnp.float32))
    commands = commands_of(Animat(Navigation(), Thresholds(1), 3), simulator)
    np.testing.assert_allclose(commands.probabilities, [[0.5, 0.5], [1.0, 0.0], [0.0, 1.0]], atol=1e-6)


@pytest.mark.oracle
def test_continuous_commands_have_the_mean_and_spread_of_samples() -> None:
    environment = Animat(Navigation(), Linear(), 5)
    commands = commands_of(environment, SIMULATOR)
    for condition in range(5):
        x = jax.vmap(SIMULATOR.sample, (0, None))(jax.random.split(jax.random.key(1), 40_000), jnp.int32(condition))
        u = np.asarray(Linear().command(x, SIMULATOR.percentiles))
        nodes = np.linspace(-1, 1, 7)
        for smooth in (True, False):
            weights = commands.onto(nodes, smooth=smooth)[condition]
            assert weights.sum() == pytest.approx(1)
            assert weights @ nodes == pytest.approx(u.mean(), abs=0.01)
        assert commands.onto(nodes, smooth=True)[condition] @ nodes**3 == pytest.approx((u**3).mean(), abs=0.01)


def test_cubic_weights_keep_cubic_polynomials() -> None:
    nodes = np.arange(4.0)
    for place in (0.0, 0.3, 1.5, 2.0, 2.9):
        weights = np.array(cubic(np.float32(place)))
        for power in range(4):
            assert weights @ nodes**power == pytest.approx(place**power, abs=1e-4)


TO_CUBIC = np.linalg.inv(np.vander(np.arange(4.0), increasing=True))
"""From the powers of a place to the weights of the four nodes of a cubic polynomial."""


@pytest.mark.parametrize("left", [0, 7])
def test_a_step_back_and_a_look_ahead_are_weighted_means_of_cubic_polynomials(left: int) -> None:
    """Three axes of 5, 6 and 7 nodes, four layers, four landings, five outcomes and three actions, all at random."""
    rng = np.random.default_rng(left)
    values = rng.normal(size=(30, 4, 7)).astype(np.float32)
    rows = rng.choice([0, 1, 2, 6, 7, 8], (4, 30)).astype(np.int32)
    nodes = rng.integers(-2, 4, (4, 30, 7), np.int32)
    # All nodes of a row may end.
    nodes[1, 4], nodes[2, 5:8] = -1, -2
    row_places, places, rewards = (
        rng.uniform(1, 2, shape).astype(np.float32) for shape in ((4, 30, 2), nodes.shape, nodes.shape)
    )
    four = np.arange(4)
    offsets = (6 * four[:, None] + four).ravel().astype(np.int32)
    # The first landing leads to all layers, the second to two with another between them, the third to the last two, one
    # of them by an outcome without weight, and the fourth to none.
    landing = [[0, 1, 2, 0, 1], [1, 0, 2, 2, 1], [0, 1, 2, 1, 0], [1, 2, 0, 0, 1]]
    then = [[0, 1, 2, 3, 3], [3, 1, 2, 3, 1], [2, 1, 2, 3, 0], [1, 2, 3, 0, 3]]
    pairs = np.stack([landing, then], axis=-1).astype(np.int32)
    weights = rng.dirichlet(np.ones(5), (4, 3)).astype(np.float32)
    weights[1, :, 3] = 0

    of_axes = [(each[..., None].astype(float) ** four) @ TO_CUBIC for each in (row_places, places)]
    around = values[(rows[..., None] + offsets)[:, :, None, :, None], :, np.maximum(nodes, 0)[..., None, None] + four]
    cubes = around.reshape(4, 30, 7, 4, 4, 4, 4)
    reached = np.einsum("kra,krb,krnc,krnabcl->krnl", of_axes[0][:, :, 0], of_axes[0][:, :, 1], of_axes[1], cubes)
    reached[nodes < 0] = 0
    reached[nodes == -2] = places[nodes == -2][:, None] if left else 0
    gained = (rewards[..., None] + reached)[pairs[..., 0], :, :, pairs[..., 1]]
    worth = np.einsum("lao,lorn->rlna", weights, gained)
    wanted = worth.max(axis=-1)

    landings, best, ends = (rows, row_places, nodes, places, rewards), np.empty_like(values), (0.5, 2.0)
    led_to, bounds = (offsets, pairs, weights), map(np.float32, ends)
    bellman_backup(values.reshape(-1), *landings, *led_to, left, *bounds, best.reshape(-1))
    assert wanted.min() < ends[0] and wanted.max() > ends[1]
    np.testing.assert_allclose(best, np.clip(wanted, *ends), atol=1e-5)
    chosen = np.zeros(30, np.int32)
    for layer, node in np.ndindex(4, 7):
        there = rows.copy(), row_places.copy(), *(np.ascontiguousarray(each[..., node]) for each in landings[2:])
        # As arrays of JAX are.
        for each in there:
            each.setflags(write=False)
        of_layer = np.full(30, layer, np.int32), pairs, weights
        look_ahead(values, *there, offsets, *of_layer, left, chosen)
        np.testing.assert_array_equal(chosen, worth[:, layer, node].argmax(axis=-1))


@pytest.mark.parametrize("robot", [Cartpole(), Navigation()])
def test_nodes_of_a_grid_are_found_where_they_are(robot: Robot[Any]) -> None:
    grid = grid_for(robot)
    rows = jnp.asarray(np.random.default_rng(0).integers(0, grid.n_rows, 200))
    nodes = jnp.asarray(np.random.default_rng(1).integers(0, grid.along.stored, 200))
    _, _, positions, node, place = jax.vmap(grid.locate)(jax.vmap(grid.state_at)(rows, nodes))
    np.testing.assert_allclose(node + place, nodes, atol=1e-3)
    indices = np.stack(np.unravel_index(np.asarray(rows), [axis.stored for axis in grid.rows]), -1)
    for axis, index, position in zip(grid.rows, indices.T, np.asarray(positions).T, strict=True):
        if axis.periodic:
            index, position = (index - 1) % axis.nodes, (position - 1) % axis.nodes
        np.testing.assert_allclose(position, index, atol=1e-3)


def test_refusals_say_what_to_do() -> None:
    environment = Animat(Navigation(), Thresholds(1), 5)
    with pytest.raises(InvalidArgument, match="cases"):
        best_returns([])
    with pytest.raises(Mismatch, match="the same robot in all"):
        best_returns([(environment, SIMULATOR), (Animat(Cartpole(), Thresholds(1), 5), SIMULATOR)])
    for changed in (YokedDelivery(environment), ReversedMapping(Navigation(), Thresholds(1), 5)):
        with pytest.raises(InvalidArgument, match=f"got {type(changed).__name__}, whose optimal return is not known"):
            best_return(ShuffledDelivery(changed), SIMULATOR)
    with pytest.raises(InvalidArgument, match="simulator"):
        best_return(environment, None)
    with pytest.raises(InvalidArgument, match="has no method `value_grid`"):
        best_return(Animat(Stairs(), Thresholds(1), 2), coins(3, 6))
    with pytest.raises(InvalidArgument, match="angle_limit_rad"):
        grid_for(Cartpole.as_printed())
    with pytest.raises(InvalidArgument, match="resolution"):
        best_return(environment, SIMULATOR, resolution=0.0)
    with pytest.raises(InvalidArgument, match="episodes"):
        best_return(environment, SIMULATOR, episodes=1)
    # Two bytes for each of five steps and each iteration left.
    with pytest.raises(InvalidArgument, match=r"resolution: .* fit into 16 GiB, got 1, which takes 18\.6 GiB"):
        best_return(Animat(Stairs(2 * 10**9), Thresholds(1), 2), coins(3, 6), grid=STEPS)
    with pytest.raises(InvalidArgument, match="axis x"):
        Axis("x", "m", 0.0, 1.0, 3)
    grid = grid_for(Navigation()).scaled(0.3)
    turned = replace(
        grid,
        along=grid.rows[1],
        rows=(grid.along, grid.rows[0]),
        to_coordinates=lambda s: (s.heading_rad, s.x_m, s.y_m),
        to_state=lambda c: NavigationState(c[1], c[2], c[0]),
    )
    with pytest.raises(InvalidArgument, match="first coordinate"):
        best_return(environment, SIMULATOR, grid=turned)


def test_the_mean_of_any_function_comes_from_the_fewest_commands() -> None:
    rare = Commands(np.arange(2), np.array([[-1.0, 0.4], [0.4, 0.9]]), np.array([[0.5, 0.5], [1.0, 0.0]]))
    # A command that never occurs needs no node, and one that differs by rounding is the same.
    again = Commands(np.arange(1), np.array([[0.4 + 1e-9, 1.0]]), np.array([[0.5, 0.5]]))
    nodes, are_smooth = nodes_for([rare, again], None)
    np.testing.assert_allclose(nodes, [-1.0, 0.4, 1.0])
    assert not are_smooth
    assert len(nodes_for([rare, again], 3)[0]) == 3 and not nodes_for([rare, again], 3)[1]
    many = Commands(np.arange(1), np.linspace(-0.5, 1.0, 40)[None], np.full((1, 40), 1 / 40))
    nodes, are_smooth = nodes_for([many], 12)
    assert are_smooth and len(nodes) == 12 and (nodes[0], nodes[-1]) == pytest.approx((-0.5, 1.0))
    for each in (np.sin, np.exp, lambda u: u**5):
        mean = (many.onto(nodes, smooth=True) @ each(nodes)).item()
        assert mean == pytest.approx(float(np.mean(each(many.levels))), abs=1e-6)


@pytest.mark.parametrize("n_conditions", [3, 8])
@pytest.mark.parametrize("put_around", [lambda animat: animat, ShuffledDelivery])
def test_a_simulator_of_other_conditions_has_no_optimum(n_conditions: int, put_around: Any) -> None:
    environment = put_around(Animat(Navigation(), Thresholds(9), n_conditions))
    with pytest.raises(InvalidArgument, match=f"n_conditions: expected 5, those of the simulator, got {n_conditions}"):
        best_return(environment, synthetic_simulator(), resolution=0.3, episodes=0)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_that_draws_like_another_is_refused(seed: int) -> None:
    with pytest.raises(InvalidArgument, match="seed: expected a whole number from 0 to 4294967295"):
        best_return(Animat(Cartpole(), Linear(), 5), synthetic_simulator(), seed=seed, resolution=0.2, episodes=2)
