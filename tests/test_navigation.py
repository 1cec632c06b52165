"""Navigation, against closed forms: straight runs, circles, walls, the goal and its reward."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.robots import Navigation, NavigationState

NO_NOISE = jnp.zeros(0)


def at(x_m: float, y_m: float, heading_rad: float) -> NavigationState:
    return NavigationState(jnp.float32(x_m), jnp.float32(y_m), jnp.float32(heading_rad))


def path(robot: Navigation, start: NavigationState, u) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(states, rewards, terminated) after each of the commands `u`."""
    return jax.tree.map(np.asarray, scanned(robot, start, jnp.asarray(u, jnp.float32)))


@partial(jax.jit, static_argnums=0)
def scanned(robot: Navigation, start: NavigationState, u):
    def iterate(state, u):
        state, reward, terminated = robot.advance(NO_NOISE, state, u)
        return state, (robot.observe(state), reward, terminated)

    return jax.lax.scan(iterate, start, u)[1]


def test_it_starts_in_the_top_left_corner_facing_right() -> None:
    np.testing.assert_array_equal(Navigation().observe(Navigation().reset(jax.random.key(0))), [0, 0, 0])


def test_a_straight_path_covers_a_stride_an_iteration() -> None:
    states, _, _ = path(Navigation(), at(0, 0, 0), np.zeros(40))
    np.testing.assert_allclose(states[:, 0], 0.025 * np.arange(1, 41), atol=1e-6)
    np.testing.assert_array_equal(states[:, 1:], 0)


@pytest.mark.parametrize("u", [1.0, -1.0])
def test_twenty_full_turns_close_a_circle(u: float) -> None:
    """u = 1 turns pi/10, so 20 strides make a regular 20-gon with sides of 0.025 m: back at the start."""
    states, _, _ = path(Navigation(), at(0.5, 0.5, 0.3), np.full(40, u))
    np.testing.assert_allclose(states[19], [0.5, 0.5, 0.3], atol=2e-6)
    np.testing.assert_allclose(states[39], [0.5, 0.5, 0.3], atol=4e-6)
    # The n-th corner of the polygon, by the sum of a geometric series of complex strides.
    turn = np.exp(1j * u * math.pi / 10)
    n = np.arange(1, 41)
    corners = 0.5 + 0.5j + 0.025 * np.exp(0.3j) * turn * (turn**n - 1) / (turn - 1)
    np.testing.assert_allclose(states[:, 0] + 1j * states[:, 1], corners, atol=4e-6)
    headings = np.angle(np.exp(1j * (0.3 + u * math.pi / 10 * n)))
    np.testing.assert_allclose(np.exp(1j * states[:, 2]), np.exp(1j * headings), atol=4e-6)


def test_it_turns_before_it_moves_and_positive_commands_turn_downwards() -> None:
    states, _, _ = path(Navigation(), at(0.5, 0.5, 0), [1.0])
    expected = [0.5 + 0.025 * math.cos(math.pi / 10), 0.5 + 0.025 * math.sin(math.pi / 10), math.pi / 10]
    np.testing.assert_allclose(states[0], expected, atol=1e-6)


# The largest float32 below pi: inside (-pi, pi] on both sides.
below_pi = float(np.nextafter(np.float32(math.pi), np.float32(0)))
headings_rad = st.floats(-below_pi, below_pi, width=32, allow_subnormal=False)
commands = st.floats(-1, 1, width=32, allow_subnormal=False)
places_m = st.floats(0, 1, width=32, allow_subnormal=False)


@settings(deadline=None)  # the first example compiles
@given(headings_rad, commands)
def test_the_heading_stays_within_half_a_circle_and_is_the_same_direction(heading: float, u: float) -> None:
    (state,), _, _ = path(Navigation(), at(0.5, 0.5, heading), [u])
    assert -np.float32(math.pi) < state[2] <= np.float32(math.pi)
    direction = np.exp(1j * (heading + u * math.pi / 10))
    np.testing.assert_allclose(np.exp(1j * float(state[2])), direction, atol=1e-6)


def test_half_a_circle_is_plus_pi() -> None:
    """The interval is (-pi, pi]: facing left is +pi, from whichever side it is reached."""
    robot = Navigation(turn_rad=math.pi)
    assert path(robot, at(0.5, 0.5, 0), [1.0])[0][0, 2] == np.float32(math.pi)
    assert path(robot, at(0.5, 0.5, 0), [-1.0])[0][0, 2] == np.float32(math.pi)


@pytest.mark.parametrize(
    ("start", "corner_or_wall"),
    [
        (at(0.99, 0.4, 0.0), (1.0, 0.4)),
        (at(0.01, 0.4, math.pi), (0.0, 0.4)),
        (at(0.3, 0.99, math.pi / 2), (0.3, 1.0)),
        (at(0.3, 0.01, -math.pi / 2), (0.3, 0.0)),
        (at(0.99, 0.005, -math.pi / 4), (1.0, 0.0)),
    ],
)
def test_walls_stop_the_robot_and_let_it_slide(start: NavigationState, corner_or_wall: tuple[float, float]) -> None:
    states, _, terminated = path(Navigation(), start, np.zeros(3))
    np.testing.assert_allclose(states[-1, :2], corner_or_wall, atol=1e-6)
    assert states[-1, 2] == start.heading_rad
    assert not terminated.any()
    sliding, _, _ = path(Navigation(), at(0.2, 0.0, -0.5), np.zeros(4))
    np.testing.assert_allclose(sliding[:, 0], 0.2 + 0.025 * math.cos(0.5) * np.arange(1, 5), atol=1e-6)
    np.testing.assert_array_equal(sliding[:, 1], 0)


@settings(deadline=None)  # the first example compiles
@given(places_m, places_m, headings_rad, commands)
def test_the_reward_is_the_goal_or_the_cost_of_the_distance(x: float, y: float, heading: float, u: float) -> None:
    robot = Navigation()
    states, rewards, terminated = path(robot, at(x, y, heading), [u])
    d = math.hypot(float(states[0, 0]) - 0.7, float(states[0, 1]) - 0.7)
    if abs(d - 0.1) < 1e-6:
        return
    assert bool(terminated[0]) is (d <= 0.1)
    assert rewards[0] == pytest.approx(50.0 if d <= 0.1 else 0.1 / d - 1, abs=1e-5)
    assert 0 <= states[0, 0] <= 1 and 0 <= states[0, 1] <= 1


def test_the_edge_and_the_middle_of_the_goal_are_the_goal() -> None:
    """Exactly representable numbers, so that d == R to the bit."""
    robot = Navigation(goal_x_m=0.5, goal_y_m=0.5, goal_radius_m=0.125, stride_m=0.125)
    for x, reward, reached in [(0.125, -0.5, False), (0.25, 50.0, True), (0.375, 50.0, True)]:
        _, rewards, terminated = path(robot, at(x, 0.5, 0), [0.0])
        assert (float(rewards[0]), bool(terminated[0])) == (reward, reached)


def test_a_straight_run_reaches_the_goal_in_the_fewest_iterations_and_no_sooner() -> None:
    robot = Navigation()
    assert robot.fewest_iterations_to_goal == math.ceil((0.7 * math.sqrt(2) - 0.1) / 0.025) == 36
    _, rewards, terminated = path(robot, at(0, 0, math.pi / 4), np.zeros(36))
    assert np.flatnonzero(terminated).tolist() == [35]
    assert rewards[-1] == 50
    exactly_four = Navigation(goal_x_m=0.2, goal_y_m=0.0, goal_radius_m=0.1)
    assert exactly_four.fewest_iterations_to_goal == 4


def test_from_the_start_it_can_be_steered_to_the_goal() -> None:
    """Turning at once and running straight takes one iteration more than the straight run; the return is positive."""
    states, rewards, terminated = path(Navigation(), at(0, 0, 0), [1.0, 1.0, 0.5] + [0.0] * 35)
    first = int(np.flatnonzero(terminated)[0])
    assert first + 1 <= 38
    assert states[first, 2] == pytest.approx(math.pi / 4, abs=1e-6)
    assert 20 < rewards[: first + 1].sum() < 26


def test_twenty_iterations_as_printed_cannot_reach_the_goal_and_it_says_so() -> None:
    printed = Navigation.as_printed()
    assert printed.episode_limit == 20 and not printed.goal_reachable
    (message,) = printed.caveats()
    assert message.startswith("navigation: the goal cannot be reached: 20 iterations of 0.025 m cover 0.5 m")
    assert Navigation().goal_reachable and Navigation().caveats() == ()
    # Whatever is done, by any of 2,000 random ways of steering.
    for seed in range(20):
        u = np.random.default_rng(seed).uniform(-1, 1, 20) + np.linspace(0, 0.5, 20)
        assert not path(printed, at(0, 0, 0), np.clip(u, -1, 1))[2].any()
