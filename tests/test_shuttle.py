"""The shuttle, against scipy's solution of its equation, and returns with and without its cue."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.information import goal_information
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import Constant, HeuristicPolicy, Uniform, heuristic_policy, roll_out
from animat.robots import Shuttle, ShuttleState
from animat.robots.drawing import BODY, GOAL_FILL, draw_robot
from animat.robots.grid import grid_for
from animat.wrappers import GoalSwitch
from test_swing_up import scanned


def path(robot: Shuttle, start: tuple[float, float, float], u) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(states, rewards, terminated) after each of the commands, in float64."""
    with jax.enable_x64(True):
        state = ShuttleState(*(jnp.float64(value) for value in start))
        return jax.tree.map(np.asarray, scanned(robot, state, jnp.asarray(u, jnp.float64)))


def test_it_starts_at_rest_in_the_middle_and_either_cue_is_as_likely() -> None:
    robot, keys = Shuttle(), jax.random.split(jax.random.key(1), 2000)
    start = jax.vmap(lambda key: robot.observe(robot.reset(key)))
    seen = np.array(start(keys))
    with jax.enable_x64(True):
        np.testing.assert_array_equal(start(keys), seen)
    assert not seen[:, :2].any() and set(seen[:, 2]) == {-1.0, 1.0}
    assert abs(seen[:, 2].mean()) < 4 / math.sqrt(2000)


def test_a_way_is_the_solution_of_its_equation() -> None:
    u = np.random.default_rng(1).uniform(-0.6, 0.6, 30)
    states, _, terminated = path(Shuttle(), (0.1, -0.2, 1.0), u)
    state = np.array([0.1, -0.2])
    for command, found in zip(u, states, strict=True):

        def rates(t: float, y: np.ndarray, command: float = command) -> list[float]:
            return [y[1], (0.5 * command - y[1]) / 0.2]

        state = solve_ivp(rates, (0, 0.1), state, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(found[:2], state, atol=1e-9)
    assert np.abs(states[:, 0]).max() < 0.5 and not terminated.any()


def test_it_stops_at_the_end_of_its_track() -> None:
    states, _, _ = path(Shuttle(), (0.0, 0.0, 1.0), np.ones(40))
    assert states[-1].tolist() == [0.5, 0.0, 1.0]
    back, _, _ = path(Shuttle(), (0.5, 0.0, 1.0), [-1.0])
    assert back[0, 0] == pytest.approx(0.5 - 0.5 * (0.1 - 0.2 * (1 - math.exp(-0.5))))


@pytest.mark.parametrize("cue", [-1.0, 1.0])
def test_what_is_right_at_one_place_is_wrong_at_the_other(cue: float) -> None:
    positions = np.array([-0.5, -0.41, -0.39, -0.3, -0.21, -0.19, 0, 0.19, 0.21, 0.3, 0.39, 0.41, 0.5])
    rewards = [path(Shuttle(), (x, 0.0, cue), [0.0])[1][0] for x in positions]
    inside = (np.abs(np.abs(positions) - 0.3) < 0.1) * np.sign(positions)
    np.testing.assert_array_equal(rewards, cue * inside)


@pytest.mark.oracle
def test_the_heuristic_stays_at_its_place_and_no_constant_command_gains() -> None:
    environment = WithoutNeurons(Shuttle(), None)
    by_rule = roll_out(environment, None, HeuristicPolicy(), episodes=200, seed=1).returns
    # The way to the place's edge takes five to eight iterations of its 120.
    assert 112 <= by_rule.min() <= by_rule.max() <= 116
    at_random = roll_out(environment, None, Uniform(), episodes=2000, seed=1).returns[0]
    assert abs(at_random.mean()) < 4 * at_random.std() / math.sqrt(2000)
    two_ways = WithoutNeurons(Shuttle(), (-1.0, 1.0))
    always = roll_out(two_ways, None, Constant(jnp.array([1])), episodes=2000, seed=1).returns[0]
    assert abs(always.mean()) < 4 * always.std() / math.sqrt(2000)


def test_another_cue_turns_it_round() -> None:
    robot = Shuttle()
    state, other = (ShuttleState(*map(jnp.float32, each)) for each in ((0.2, 0.1, 1.0), (0.0, 0.0, -1.0)))
    turned = robot.with_goal_of(state, other)
    assert [float(value) for value in turned] == pytest.approx([0.2, 0.1, -1.0])
    assert float(robot.heuristic(robot.observe(turned))) == -1.0


def test_a_goal_that_is_switched_is_another_one() -> None:
    switch = GoalSwitch(WithoutNeurons(Shuttle(), None), at=3)
    for seed in range(20):
        state = switch.reset(jax.random.key(seed))
        assert float(state.info["other_goal"].cue) == -float(state.robot.cue)


@pytest.mark.oracle
def test_of_two_goals_there_is_a_bit_to_know() -> None:
    environment = WithoutNeurons(Shuttle(), (-1.0, -0.5, 0.0, 0.5, 1.0))
    found = goal_information(environment, None, heuristic_policy(environment, None), draws=2)
    assert found.most == 1.0
    assert found.bits.value == pytest.approx(1.0, abs=0.05)


def test_places_have_to_be_apart_and_on_the_track() -> None:
    with pytest.raises(InvalidArgument, match=r"place_radius_m: expected less than 0.3, so that the places do not"):
        Shuttle(place_radius_m=0.3)
    with pytest.raises(InvalidArgument, match=r"place_m: expected at most 0.5, where the track ends, got 0.6"):
        Shuttle(place_m=0.6)


def test_a_state_is_where_its_coordinates_are() -> None:
    grid = grid_for(Shuttle())
    state = ShuttleState(*map(jnp.float32, (0.2, -0.4, 1.0)))
    np.testing.assert_allclose(grid.to_state(grid.to_coordinates(state)), state, rtol=1e-6)


@pytest.mark.oracle
def test_the_optimum_is_that_of_the_quickest_way() -> None:
    """Full speed until it is there: 120 less the iterations before the first that ends within the place."""
    environment = WithoutNeurons(Shuttle(), (-1.0, 0.0, 1.0))
    states, _, _ = path(Shuttle(), (0.0, 0.0, 1.0), np.ones(20))
    on_the_way = int(np.argmax(states[:, 0] >= 0.2))
    found = best_return(environment, None, resolution=1.0, episodes=100)
    assert abs(found.monte_carlo - (120 - on_the_way)) <= 0.5
    assert abs(found.value - (120 - on_the_way)) <= 1.5


def test_the_cart_is_drawn_where_it_is_and_its_place_is_filled() -> None:
    for position, cue in ((0.2, 1.0), (-0.4, -1.0), (0.0, 1.0)):
        picture = draw_robot(Shuttle(), np.array([position, 0.0, cue]), command=0.5)
        height, width, _ = picture.shape
        scale = height / 0.3
        body = np.argwhere(np.all(picture == BODY, axis=-1))[:, 1]
        assert body.mean() - width / 2 == pytest.approx(scale * position, abs=2)
        filled = np.argwhere(np.all(picture == GOAL_FILL, axis=-1))[:, 1]
        assert np.sign(filled.mean() - width / 2) == cue
