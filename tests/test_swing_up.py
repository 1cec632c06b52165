"""Swing-up, against scipy's solution of its equation, Gymnasium's pendulum, its energy, and the optimal return."""

from __future__ import annotations

import math
from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import HeuristicPolicy, Uniform, heuristic_policy, roll_out
from animat.robots import SwingUp, SwingUpState
from animat.robots.drawing import ACCENT, BODY, draw_robot
from animat.robots.grid import Grid, grid_for

NO_NOISE = jnp.zeros(0)


def path(robot: SwingUp, start: tuple[float, float], u) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(states, rewards, terminated) after each of the commands, in float64."""
    with jax.enable_x64(True):
        state = SwingUpState(*(jnp.float64(value) for value in start))
        return jax.tree.map(np.asarray, scanned(robot, state, jnp.asarray(u, jnp.float64)))


@partial(jax.jit, static_argnums=0)
def scanned(robot, state, u):
    """States, rewards and ends of iterations with these commands, of a robot without noise."""

    def iterate(state, u):
        state, reward, terminated = robot.advance(NO_NOISE, state, u)
        return state, (jnp.stack(state), reward, terminated)

    return jax.lax.scan(iterate, state, u)[1]


def solved(start: tuple[float, float], u, step_s: float) -> np.ndarray:
    """The states after each of the commands by a'' = 15 sin a + 6 u, by scipy's method of eighth order."""
    states, state = [], np.array(start)
    for command in u:

        def rates(t: float, y: np.ndarray, command: float = command) -> list[float]:
            return [y[1], 15 * math.sin(y[0]) + 6 * command]

        state = solve_ivp(rates, (0, step_s), state, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
        states.append(state)
    return np.array(states)


def test_it_starts_hanging_at_rest() -> None:
    observation = SwingUp().observe(SwingUp().reset(jax.random.key(3)))
    np.testing.assert_allclose(observation, [-1, 0, 0], atol=1e-6)


def test_a_swing_is_the_solution_of_its_equation() -> None:
    """Two seconds of random commands, without reaching the speed limit, where another equation applies."""
    u = np.random.default_rng(1).uniform(-1, 1, 40)
    states, _, _ = path(SwingUp(), (2.5, 1.0), u)
    expected = solved((2.5, 1.0), u, 0.05)
    assert np.abs(expected[:, 1]).max() < 7.5
    np.testing.assert_allclose(np.exp(1j * states[:, 0]), np.exp(1j * expected[:, 0]), atol=1e-4)
    np.testing.assert_allclose(states[:, 1], expected[:, 1], atol=5e-4)
    assert np.all(np.abs(states[:, 0]) <= math.pi)


def test_other_masses_and_lengths_move_as_a_rod_does() -> None:
    """m l^2 / 3 a'' = m g l / 2 sin a + torque u, with the numbers written out."""
    robot = SwingUp(mass_kg=0.3, length_m=0.4, gravity_m_per_s2=9.81, torque_n_m=0.2, step_s=1e-4)
    states, _, _ = path(robot, (0.7, 0.2), [-0.5])
    expected = (0.3 * 9.81 * 0.4 / 2 * math.sin(0.7) - 0.5 * 0.2) / (0.3 * 0.4**2 / 3)
    assert (states[0, 1] - 0.2) / 1e-4 == pytest.approx(expected, rel=1e-4)


def test_gymnasiums_pendulum_accelerates_alike() -> None:
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(2)
    for _ in range(20):
        angle, velocity, u = rng.uniform(-3, 3), rng.uniform(-6, 6), rng.uniform(-1, 1)
        env.state = np.array([angle, velocity])
        env.step(np.array([2 * u]))
        theirs = (env.state[1] - velocity) / env.dt
        states, _, _ = path(SwingUp(step_s=1e-5), (angle, velocity), [u])
        assert (states[0, 1] - velocity) / 1e-5 == pytest.approx(theirs, abs=2e-3)


def test_without_a_torque_the_energy_is_kept() -> None:
    """Ten seconds of free swinging: w^2 / 2 + 15 cos a stays what it was."""
    for start in ((2.0, 0.0), (0.3, -1.0), (3.0, 5.0)):
        states, _, _ = path(SwingUp(), start, np.zeros(200))
        energy = states[:, 1] ** 2 / 2 + 15 * np.cos(states[:, 0])
        np.testing.assert_allclose(energy, start[1] ** 2 / 2 + 15 * math.cos(start[0]), atol=0.05)


def test_left_and_right_are_mirror_images() -> None:
    u = np.random.default_rng(3).uniform(-1, 1, 100)
    right, reward, _ = path(SwingUp(), (1.0, 0.5), u)
    left, reward_left, _ = path(SwingUp(), (-1.0, -0.5), -u)
    np.testing.assert_allclose(left, -right, atol=1e-9)
    np.testing.assert_array_equal(reward, reward_left)


def test_the_motor_cannot_lift_the_rod_and_holds_it_where_it_should() -> None:
    """A constant torque of 6 against 15 sin a: it rests 23.6 degrees from hanging, and swings to under twice that."""
    states, rewards, _ = path(SwingUp(), (math.pi, 0.0), np.ones(200))
    off = math.pi - np.abs(states[:, 0])
    assert 0.7 < off.max() < 0.9 and not rewards.any()
    held, _, _ = path(SwingUp(), (math.pi - math.asin(0.4), 0.0), -np.ones(40))
    np.testing.assert_allclose(held[:, 0], math.pi - math.asin(0.4), atol=1e-9)


def test_it_is_rewarded_within_thirty_degrees_and_never_ends() -> None:
    limit = math.radians(30)
    robot = SwingUp(gravity_m_per_s2=0.0)
    for angle, reward in ((0.0, 1), (limit - 1e-6, 1), (limit + 1e-6, 0), (-limit + 1e-6, 1), (-limit - 1e-6, 0)):
        _, rewards, terminated = path(robot, (angle, 0.0), np.zeros(3))
        assert rewards.tolist() == [reward] * 3 and not terminated.any()


def test_it_never_turns_faster_than_its_limit() -> None:
    states, _, _ = path(SwingUp(torque_n_m=50), (math.pi, 0.0), np.ones(100))
    assert states[:, 1].max() == 8.0
    np.testing.assert_allclose(np.linalg.norm([np.cos(states[:, 0]), np.sin(states[:, 0])], axis=0), 1)


def test_a_motor_that_needs_no_swing_is_reported_and_too_long_a_step_refused() -> None:
    assert SwingUp().caveats() == () and SwingUp(torque_n_m=4.9).caveats() == ()
    (message,) = SwingUp(torque_n_m=5.0).caveats()
    assert message.startswith("swing-up: with torque_n_m = 5 the motor lifts the pendulum directly (from 5 N m on)")
    with pytest.raises(InvalidArgument, match="step_s: expected a step of less than a turn, got"):
        SwingUp(step_s=0.6)


def test_the_heuristic_swings_it_up_and_keeps_it_there() -> None:
    environment = WithoutNeurons(SwingUp(), None)
    by_rule = roll_out(environment, None, HeuristicPolicy(), episodes=2, seed=1).returns
    at_random = roll_out(environment, None, Uniform(), episodes=200, seed=1).returns
    assert by_rule.min() > 135 and at_random.mean() < 5


@pytest.mark.parametrize("start", [(0.3, 0.0), (-0.2, 0.5), (0.0, -1.0)])
def test_the_heuristic_catches_a_falling_rod(start: tuple[float, float]) -> None:
    robot, state = SwingUp(), SwingUpState(*map(jnp.float32, start))
    step = jax.jit(lambda state: robot.advance(NO_NOISE, state, robot.heuristic(robot.observe(state))))
    for _ in range(60):
        state, reward, _ = step(state)
        assert reward == 1
    assert abs(state.angle_rad) < 0.02


def test_a_state_is_where_its_coordinates_are() -> None:
    grid = grid_for(SwingUp())
    assert isinstance(grid, Grid)
    for angle, velocity in ((3.0, -7.9), (-3.1, 0.3), (0.0, 8.0)):
        coordinates = grid.to_coordinates(SwingUpState(jnp.float32(angle), jnp.float32(velocity)))
        np.testing.assert_allclose(grid.to_state(coordinates), [angle, velocity], rtol=1e-6)


@pytest.mark.oracle
def test_the_optimum_is_at_least_the_heuristic_and_is_achieved() -> None:
    environment = WithoutNeurons(SwingUp(), (-1.0, 1.0))
    found = best_return(environment, None, resolution=0.5, episodes=2)
    by_rule = roll_out(environment, None, heuristic_policy(environment, None), episodes=2, seed=1).returns.mean()
    assert found.value + found.grid_error > by_rule > 120
    assert found.monte_carlo >= by_rule
    assert abs(found.monte_carlo - found.value) < 5


def test_the_rod_is_drawn_where_it_is() -> None:
    robot = SwingUp()
    for angle in (0.0, 1.0, -2.0):
        picture = draw_robot(robot, np.array([math.cos(angle), math.sin(angle), 0.0]), command=0.0)
        at = np.argwhere(np.all(picture == BODY, axis=-1))[:, ::-1].mean(axis=0) - 180
        np.testing.assert_allclose(np.arctan2(at[0], -at[1]), angle, atol=0.02)
    turning = draw_robot(robot, np.array([1.0, 0.0, 0.0]), command=1.0)
    assert np.argwhere(np.all(turning == ACCENT, axis=-1))[:, 1].mean() > 190
