"""The arm, against scipy's solution of Lagrange's equations made from its energy, and against that energy."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import HeuristicPolicy, Uniform, roll_out
from animat.robots import ArmState, TwoLinkArm
from animat.robots.drawing import BODY, GOAL_FILL, draw_robot

NO_NOISE = jnp.zeros(0)
LINKS = {"upper_length_m": 0.25, "lower_length_m": 0.18, "upper_mass_kg": 0.12, "lower_mass_kg": 0.07}


def path(robot: TwoLinkArm, start, u, target=(0.1, -0.2)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(states, rewards, terminated) after each pair of commands, in float64."""
    with jax.enable_x64(True):
        state = ArmState(*(jnp.float64(value) for value in (*start, *target)))
        return jax.tree.map(np.asarray, scanned(robot, state, jnp.asarray(u, jnp.float64)))


@partial(jax.jit, static_argnums=0)
def scanned(robot: TwoLinkArm, state: ArmState, u):
    def iterate(state, u):
        state, reward, terminated = robot.advance(NO_NOISE, state, u)
        return state, (jnp.stack(state), reward, terminated)

    return jax.lax.scan(iterate, state, u)[1]


def points_of_mass(robot: TwoLinkArm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where 2 x 3 points of the links are (Gauss's, exact for a rod's energy), and what each weighs."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    along, weights = (nodes + 1) / 2, weights / 2
    upper = np.stack([np.cos(q[0]), np.sin(q[0])])
    lower = np.stack([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])])
    places = [robot.upper_length_m * a * upper for a in along]
    places += [robot.upper_length_m * upper + robot.lower_length_m * a * lower for a in along]
    return np.array(places), np.concatenate([robot.upper_mass_kg * weights, robot.lower_mass_kg * weights])


def mass_matrix(robot: TwoLinkArm, q: np.ndarray) -> np.ndarray:
    """Of the kinetic energy of those points, which needs no formula for rods: sum m J^T J, J by small differences."""
    step = 1e-6
    masses = points_of_mass(robot, q)[1]
    moved = [
        (points_of_mass(robot, q + step * way)[0] - points_of_mass(robot, q - step * way)[0]) / (2 * step)
        for way in np.eye(2)
    ]
    return np.array([[np.sum(masses * np.sum(a * b, axis=1)) for b in moved] for a in moved])


def accelerations(robot: TwoLinkArm, q: np.ndarray, w: np.ndarray, torques: np.ndarray) -> np.ndarray:
    """Lagrange: M q'' + M' q' - d/dq (q'^T M q' / 2) = torques - damping q'."""
    step = 1e-4
    slopes = [
        (mass_matrix(robot, q + step * way) - mass_matrix(robot, q - step * way)) / (2 * step) for way in np.eye(2)
    ]
    changing = sum(slope * speed for slope, speed in zip(slopes, w, strict=True)) @ w
    pull = np.array([w @ slope @ w / 2 for slope in slopes])
    return np.linalg.solve(mass_matrix(robot, q), torques - robot.damping_n_m_s * w - changing + pull)


def energy(robot: TwoLinkArm, states: np.ndarray) -> np.ndarray:
    return np.array([s[2:4] @ mass_matrix(robot, s[:2]) @ s[2:4] / 2 for s in states])


@pytest.mark.parametrize(
    "robot", [pytest.param(TwoLinkArm(), marks=pytest.mark.oracle), TwoLinkArm(**LINKS, damping_n_m_s=0.001)]
)
def test_a_movement_is_the_solution_of_lagranges_equations(robot: TwoLinkArm) -> None:
    start, commands = np.array([0.4, 1.2, 1.5, -2.0]), [(1.0, -0.6), (-0.3, 0.9), (0.5, 1.0), (-1.0, -1.0)]
    states, _, _ = path(robot, start, commands)
    expected = start
    for command, state in zip(commands, states, strict=True):
        torques = robot.torque_n_m * np.array(command)

        def rates(t: float, y: np.ndarray, torques: np.ndarray = torques) -> np.ndarray:
            return np.concatenate([y[2:], accelerations(robot, y[:2], y[2:], torques)])

        expected = solve_ivp(rates, (0, robot.step_s), expected, rtol=1e-7, atol=1e-8).y[:, -1]
        np.testing.assert_allclose(state[:4], expected, atol=5e-4)


def test_without_damping_and_torques_the_energy_is_kept() -> None:
    robot = TwoLinkArm(damping_n_m_s=0.0)
    states, _, _ = path(robot, (0.0, 1.5, 2.0, -3.0), np.zeros((100, 2)))
    kept = energy(robot, states)
    np.testing.assert_allclose(kept, kept[0], rtol=1e-3)
    assert np.ptp(states[:, 1]) > 1


def test_torques_do_the_work_that_the_energy_gains() -> None:
    """Without damping: energy gained = torque times angle, with constant torques."""
    robot = TwoLinkArm(damping_n_m_s=0.0)
    states, _, _ = path(robot, (0.2, 1.0, 0.0, 0.0), np.tile([0.7, -0.4], (20, 1)))
    work = 0.01 * (0.7 * (states[:, 0] - 0.2) - 0.4 * (states[:, 1] - 1.0))
    np.testing.assert_allclose(energy(robot, states), work, rtol=2e-3, atol=1e-7)


def test_damping_takes_energy_until_it_rests() -> None:
    states, _, _ = path(TwoLinkArm(), (0.0, 1.0, 2.0, 1.0), np.zeros((100, 2)))
    kept = energy(TwoLinkArm(), states)
    assert np.all(np.diff(kept) < 0) and kept[-1] < 1e-2 * kept[0]


def test_targets_are_drawn_evenly_over_what_the_tip_reaches() -> None:
    robot = TwoLinkArm()
    states = jax.jit(jax.vmap(robot.reset))(jax.random.split(jax.random.key(0), 4000))
    distance, around = np.hypot(states.target_x_m, states.target_y_m), np.arctan2(states.target_y_m, states.target_x_m)
    assert distance.min() >= 0.12 and distance.max() <= 0.38
    # Even over an area: the square of the distance is even, and so is the direction.
    assert np.mean(distance**2) == pytest.approx((0.12**2 + 0.38**2) / 2, rel=0.03)
    assert abs(np.mean(np.exp(1j * around))) < 0.06
    uneven = TwoLinkArm(upper_length_m=0.3, lower_length_m=0.1)
    distance = [np.hypot(*uneven.reset(jax.random.key(seed))[4:]) for seed in range(50)]
    assert min(distance) >= 0.2
    np.testing.assert_allclose(states[1], math.pi / 2)
    assert not np.any(states.shoulder_rad) and not np.any(states.shoulder_rad_per_s)


def test_the_reward_is_by_how_far_the_tip_is_and_no_episode_ends() -> None:
    robot = TwoLinkArm()
    q1, q2 = 0.5, -0.8
    tip = 0.2 * np.exp(1j * q1) + 0.2 * np.exp(1j * (q1 + q2))
    for away_m, expected in ((0.0, 0.0), (0.0199, 0.0), (0.04, -0.5), (0.2, -0.9)):
        target = tip + away_m * np.exp(2j)
        _, rewards, terminated = path(robot, (q1, q2, 0, 0), np.zeros((2, 2)), (target.real, target.imag))
        np.testing.assert_allclose(rewards, expected, atol=1e-6)
        assert not terminated.any()
        state = ArmState(*map(jnp.float32, (q1, q2, 0, 0, target.real, target.imag)))
        np.testing.assert_allclose(robot.observe(state)[8:], [(target - tip).real, (target - tip).imag], atol=1e-6)


@pytest.mark.oracle
def test_no_joint_passes_the_bound_of_its_speed() -> None:
    """Full torques that go with the movement, or against it in turns, at which speeds are largest."""
    for robot in (TwoLinkArm(), TwoLinkArm(damping_n_m_s=0.0), TwoLinkArm(torque_n_m=0.1), TwoLinkArm(**LINKS)):
        bound = robot.observation_spec[4].high
        for signs in ((1, 1), (1, -1)):
            states, _, _ = path(robot, (0, math.pi / 2, 0, 0), np.tile(signs, (100, 1)))
            assert np.abs(states[:, 2:4]).max() < bound


def test_links_that_reach_nothing_and_too_long_steps_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="lower_length_m: expected links similar enough to reach a target"):
        TwoLinkArm(upper_length_m=1.0, lower_length_m=0.01)
    with pytest.raises(InvalidArgument, match=r"step_s: expected at most .* for links so light and joints so damped"):
        TwoLinkArm(damping_n_m_s=0.1)
    # Each of these reached infinite speeds within an episode.
    for strong in ({"torque_n_m": 1.0}, {"torque_n_m": 0.2, "damping_n_m_s": 0.0}):
        with pytest.raises(InvalidArgument, match=r"step_s: expected at most 0\.0.* for motors so strong, got 0\.05"):
            TwoLinkArm(**strong)
    # The longest step that the message names is accepted.
    assert TwoLinkArm(torque_n_m=1.0, step_s=0.02).step_s == 0.02


@pytest.mark.oracle
def test_the_heuristic_brings_the_tip_to_the_target() -> None:
    environment = WithoutNeurons(TwoLinkArm(), None)
    by_rule = roll_out(environment, None, HeuristicPolicy(), episodes=100, seed=1).returns
    at_random = roll_out(environment, None, Uniform(), episodes=100, seed=1).returns
    assert by_rule.mean() > -40 and at_random.mean() < -80
    robot, state = TwoLinkArm(), TwoLinkArm().reset(jax.random.key(5))
    step = jax.jit(lambda state: robot.advance(NO_NOISE, state, robot.heuristic(robot.observe(state))))
    for _ in range(robot.episode_limit):
        state, reward, _ = step(state)
    assert reward == 0


def test_the_links_and_the_target_are_drawn_where_they_are() -> None:
    robot = TwoLinkArm()
    state = ArmState(*map(jnp.float32, (0.3, 0.9, 0, 0, -0.2, 0.1)))
    picture = draw_robot(robot, np.asarray(robot.observe(state)))
    px_per_m = 180 / 0.44

    def places_m(colour: tuple[int, int, int]) -> np.ndarray:
        return (np.argwhere(np.all(picture == colour, axis=-1))[:, ::-1] + 0.5 - 180) / px_per_m

    np.testing.assert_allclose(places_m(GOAL_FILL).mean(axis=0), [-0.2, 0.1], atol=0.004)
    tip = 0.2 * np.exp(0.3j) + 0.2 * np.exp(1.2j)
    assert np.hypot(*(places_m(BODY) - [tip.real, tip.imag]).T).min() < 0.012
