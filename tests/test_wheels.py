"""Wheels, against closed-form arcs, rolling in small steps, rays marched along, and a flood of the arena."""

from __future__ import annotations

import json
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import HeuristicPolicy, Uniform, roll_out
from animat.robots import Wheels, WheelsState, robot_from_dict, robot_to_dict
from animat.robots.drawing import ACCENT, BODY, GOAL_FILL, INK, draw_robot
from animat.robots.surroundings import Surroundings, places_within_reach

NO_NOISE = jnp.zeros(0)
FAR = ((-50.0, -50.0, 50.0, -50.0), (50.0, 50.0, -50.0, 50.0))
ROOM = Wheels(
    walls=((-1.0, -1.0, 1.0, -1.0), (1.0, -1.0, 1.0, 1.0), (1.0, 1.0, -1.0, 1.0), (-1.0, 1.0, -1.0, -1.0)),
    obstacles=(),
    start_x_m=0.0,
    start_y_m=0.0,
)
ANGLES_DEG = (17, 46, 90, 151, -151, -90, -46, -17)


def path(robot: Wheels, start, u, goal=(0.9, 0.9)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(states, rewards, terminated) after each pair of commands, in float64."""
    with jax.enable_x64(True):
        state = WheelsState(*(jnp.float64(value) for value in (*start, *goal)))
        return jax.tree.map(np.asarray, scanned(robot, state, jnp.asarray(u, jnp.float64)))


@partial(jax.jit, static_argnums=0)
def scanned(robot: Wheels, state: WheelsState, u):
    def iterate(state, u):
        state, reward, terminated = robot.advance(NO_NOISE, state, u)
        return state, (jnp.stack(state), reward, terminated)

    return jax.lax.scan(iterate, state, u)[1]


def observed(robot: Wheels, x: float, y: float, heading: float, goal=(0.9, 0.9)) -> np.ndarray:
    return np.asarray(observe(robot, WheelsState(*np.array([x, y, heading, *goal], np.float32))))


observe = jax.jit(Wheels.observe, static_argnums=0)


def test_equal_wheels_drive_straight_and_opposite_ones_turn_on_the_spot() -> None:
    states, _, _ = path(ROOM, (0, 0, 0.3), np.ones((10, 2)))
    ahead = 0.026 * np.arange(1, 11)
    np.testing.assert_allclose(states[:, 0] + 1j * states[:, 1], ahead * np.exp(0.3j), atol=1e-12)
    np.testing.assert_allclose(states[:, 2], 0.3, atol=1e-12)
    states, _, _ = path(ROOM, (0.1, 0.2, 0.0), np.tile([0.5, -0.5], (30, 1)))
    np.testing.assert_allclose(states[:, :2], [[0.1, 0.2]] * 30, atol=1e-12)
    turned = 0.026 / 0.053 * np.arange(1, 31)
    np.testing.assert_allclose(np.exp(1j * states[:, 2]), np.exp(1j * turned), atol=1e-12)
    assert np.all((states[:, 2] > -math.pi) & (states[:, 2] <= math.pi))


@pytest.mark.parametrize("u", [(1.0, 0.6), (0.2, 1.0), (1.0, 0.0), (-0.4, -0.9)])
def test_wheels_at_two_speeds_drive_a_circle(u: tuple[float, float]) -> None:
    """Its radius is axle/2 (left + right) / (left - right), about a centre to the right of the robot."""
    states, _, _ = path(ROOM, (0.1, -0.1, 0.5), np.tile(u, (25, 1)))
    radius = 0.053 / 2 * (u[0] + u[1]) / (u[0] - u[1])
    turned = 0.026 * (u[0] - u[1]) / 0.053 * np.arange(1, 26)
    centre = 0.1 - 0.1j + radius * 1j * np.exp(0.5j)
    np.testing.assert_allclose(
        states[:, 0] + 1j * states[:, 1], centre - radius * 1j * np.exp(1j * (0.5 + turned)), atol=1e-12
    )


def test_a_drive_is_that_of_wheels_that_roll_in_small_steps() -> None:
    u = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    states, _, _ = path(ROOM, (0, 0, 1.0), u)
    x, y, heading = 0.0, 0.0, 1.0
    for (left, right), state in zip(0.13 * u, states, strict=True):
        for _ in range(2000):
            heading += 0.5e-4 * (left - right) / 0.053
            x, y = x + 1e-4 * (left + right) / 2 * math.cos(heading), y + 1e-4 * (left + right) / 2 * math.sin(heading)
            heading += 0.5e-4 * (left - right) / 0.053
        np.testing.assert_allclose(state[:2], [x, y], atol=1e-7)


def marched(robot: Wheels, x: float, y: float, angle: float) -> float:
    """A sensor's reading, by following its ray in steps of 0.05 mm until something is crossed or entered."""
    step = 5e-5
    t = np.arange(0, robot.body_radius_m + robot.sensor_range_m + step, step)
    points = np.stack([x + t * math.cos(angle), y + t * math.sin(angle)], axis=1)
    hit = np.zeros(len(t), bool)
    for cx, cy, radius in robot.obstacles:
        hit |= np.hypot(points[:, 0] - cx, points[:, 1] - cy) <= radius
    for x1, y1, x2, y2 in robot.walls:
        a, way = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        side = np.sign((points[:, 0] - x1) * way[1] - (points[:, 1] - y1) * way[0])
        along = (points - a) @ way / (way @ way)
        crossed = (side[1:] != side[:-1]) & (along[1:] >= 0) & (along[1:] <= 1)
        hit[1:] |= crossed
    first = t[hit.argmax()] if hit.any() else math.inf
    return 1 - min(max((first - robot.body_radius_m) / robot.sensor_range_m, 0), 1)


def test_sensors_show_what_marching_along_their_rays_meets() -> None:
    robot = Wheels(walls=(*Wheels().walls, (0.1, 0.45, 0.3, 0.55)), sensor_range_m=0.2)
    around, rng, seen = Surroundings(robot.walls, robot.obstacles), np.random.default_rng(1), 0
    while seen < 60:
        x, y, heading = *rng.uniform(0.04, 0.96, 2), rng.uniform(-math.pi, math.pi)
        if around.clearance_m(np.array(x), np.array(y)) < 0.035:
            continue
        seen += 1
        expected = [marched(robot, x, y, heading + math.radians(angle)) for angle in ANGLES_DEG]
        np.testing.assert_allclose(observed(robot, x, y, heading)[:8], expected, atol=2e-3)


def test_a_wall_ahead_a_wall_behind_and_nothing() -> None:
    """0.06 m from the body's edge straight to the right: the sensor at 90 degrees of a robot that looks up."""
    sensors = observed(ROOM, 1 - 0.035 - 0.06, 0.0, -math.pi / 2)[:8]
    assert sensors[2] == pytest.approx(0.4, abs=1e-5)
    np.testing.assert_array_equal(sensors[3:], 0)
    assert not observed(ROOM, 0, 0, 0.4)[:8].any()
    # In a corner, with the ray right into it.
    assert observed(ROOM, 0.93, 0.93, math.pi / 4 - math.radians(17))[0] == pytest.approx(
        1 - (0.07 * math.sqrt(2) - 0.035) / 0.1, abs=1e-4
    )


def test_distance_and_bearing_of_the_goal() -> None:
    assert observed(ROOM, 0.1, 0.2, 0.0, (0.4, 0.6))[8:] == pytest.approx([0.5, math.atan2(0.4, 0.3)], abs=1e-6)
    # y points down: what is below is to the right of a robot that looks to the right.
    assert observed(ROOM, 0, 0, 0, (0.0, 0.5))[9] == pytest.approx(math.pi / 2, abs=1e-6)
    assert observed(ROOM, 0, 0, 3.0, (0.5, -0.1))[9] == pytest.approx(
        -3.0 - math.atan2(0.1, 0.5) + 2 * math.pi, abs=1e-6
    )


def test_clearance_is_the_distance_of_many_points_of_the_walls() -> None:
    around = Surroundings(((0.0, 0.0, 0.5, 0.2), (0.3, 0.7, 0.3, 0.7)), ((0.8, 0.8, 0.1),))
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.2, 1.2, (2, 200))
    along = np.linspace(0, 1, 5001)
    rim = np.exp(2j * math.pi * along)
    points = np.concatenate([0.5 * along + 0.2j * along, [0.3 + 0.7j], 0.8 + 0.8j + 0.1 * rim])
    expected = np.abs((x + 1j * y)[:, None] - points).min(axis=1)
    expected[np.hypot(x - 0.8, y - 0.8) < 0.1] *= -1
    np.testing.assert_allclose(around.clearance_m(x, y), expected, atol=1e-4)
    np.testing.assert_allclose(around.clearance_m(jnp.asarray(x), jnp.asarray(y)), expected, atol=1e-4)


def test_a_bump_stops_it_but_lets_it_turn_away() -> None:
    states, rewards, terminated = path(ROOM, (0.95, 0.0, 0.0), [(1, 1), (1, 0.5), (1, -1), (1, -1), (1, -1), (1, 1)])
    assert rewards[:2].tolist() == [-2, -2] and not terminated.any()
    np.testing.assert_allclose(states[:5, :2], [[0.95, 0.0]] * 5, atol=1e-12)
    assert states[1, 2] == pytest.approx(0.5 * 0.026 / 0.053)
    assert rewards[-1] > -1 and states[-1, 0] < 0.93


def test_it_never_comes_nearer_to_anything_than_its_body_is_wide() -> None:
    robot = Wheels(walls=(*Wheels().walls, (0.1, 0.45, 0.3, 0.55)))
    around = Surroundings(robot.walls, robot.obstacles)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        # It mostly drives on, now and then another way.
        u = np.clip(np.repeat(rng.uniform(-0.2, 1, (40, 2)), 20, axis=0), -1, 1)
        states, rewards, _ = path(robot, (0.5, 0.5, 1.0), u, (5.0, 5.0))
        assert around.clearance_m(states[:, 0], states[:, 1]).min() >= 0.035 - 1e-9
        assert (rewards == -2).any()


def test_the_reward_is_the_goal_or_the_cost_of_the_distance() -> None:
    for away_m, reward, reached in ((0.03, 50, True), (0.05 - 1e-9, 50, True), (0.051, 0.05 / 0.051 - 1, False),
                                    (0.5, -0.9, False)):  # fmt: skip
        _, rewards, terminated = path(ROOM, (0, 0, 0), [(0, 0)], (away_m, 0.0))
        assert (rewards[0], terminated[0]) == (pytest.approx(reward), reached)


def test_goals_are_drawn_from_all_places_that_can_be_reached_and_from_no_other() -> None:
    """A wall shuts off the right part of the room; a flood fill finds every place in the left part."""
    robot = Wheels(walls=(*Wheels().walls, (0.6, 0.0, 0.6, 1.0)))
    states = jax.jit(jax.vmap(robot.reset))(jax.random.split(jax.random.key(0), 5000))
    around = Surroundings(robot.walls, robot.obstacles)
    goals = np.stack([states.goal_x_m, states.goal_y_m], axis=1).astype(np.float64)
    assert goals[:, 0].max() < 0.56 and goals[:, 0].min() < 0.08
    assert around.clearance_m(goals[:, 0], goals[:, 1]).min() >= 1.5 * 0.035 - 1e-6
    assert np.hypot(*(goals - 0.5).T).min() > 0.1

    flooded, waiting = {(0, 0)}, [(0, 0)]
    while waiting:
        i, j = waiting.pop()
        for at in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if at not in flooded and around.clearance_m(*(0.5 + 0.014 * np.array(at, float).reshape(2, 1))) >= 0.0525:
                flooded.add(at)
                waiting.append(at)
    expected = {at for at in flooded if math.hypot(*at) * 0.014 > 0.1}
    drawn = {tuple(at) for at in np.round((goals - 0.5) / 0.014).astype(int).tolist()}
    assert drawn <= expected and len(drawn) > 0.8 * len(expected)
    assert np.abs(np.mean(np.exp(1j * np.asarray(states.heading_rad)))) < 0.05
    assert len(places_within_reach(around, (0.5, 0.5), 0.0525, 0.014)) == len(flooded)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"start_x_m": 0.3, "start_y_m": 0.3}, "start_x_m, start_y_m: expected a place within the walls"),
        ({"start_x_m": 3.0}, "start_x_m, start_y_m: expected a place within the walls"),
        ({"obstacles": (), "walls": ()}, "start_x_m, start_y_m: expected a place within the walls"),
        ({"walls": FAR}, r"in at most 196 m\^2"),
        ({"walls": ((0.0, 0.0, 1e200, 0.0),)}, r"in at most 196 m\^2"),
        ({"obstacles": ((0.0, 0.0, 1.0), (-1e308, 1e308, 1.0))}, r"in at most 196 m\^2"),
        ({"walls": Wheels().walls[:3]}, "walls: expected walls all around the robot, got a gap"),
        ({"walls": (*Wheels().walls[:3], (0.0, 1.0, 0.0, 0.1))}, "walls: expected walls all around the robot"),
        ({"step_s": 0.3}, "step_s: expected at most 0.269 at this speed, got 0.3"),
        ({"walls": ((0.0, 0.0, 1.0),)}, "walls: expected to be given, got nothing|walls: expected at least 4"),
        ({"obstacles": ((0.0, 0.0, -1.0),)}, "obstacles: expected at least 1e-09, got -1"),
        ({"obstacles": 3.0}, "obstacles: expected a list, got 3.0"),
    ],
)
def test_surroundings_that_make_no_sense_are_refused(parameters: dict, words: str) -> None:
    with pytest.raises(InvalidArgument, match=words):
        Wheels(**parameters)


def test_a_gap_too_narrow_for_the_robot_is_none() -> None:
    assert Wheels(walls=(*Wheels().walls[:3], (0.0, 1.0, 0.0, 0.01)))


def test_surroundings_are_data() -> None:
    robot = Wheels(walls=(*Wheels().walls, (0.1, 0.45, 0.3, 0.55)), obstacles=((0.7, 0.7, 0.1),))
    again = robot_from_dict(json.loads(json.dumps(robot_to_dict(robot))))
    assert again == robot and hash(again) == hash(robot)


@pytest.mark.oracle
def test_the_heuristic_finds_the_goal_between_the_obstacles() -> None:
    environment = WithoutNeurons(Wheels(), None)
    by_rule = roll_out(environment, None, HeuristicPolicy(), episodes=200, seed=1).returns
    at_random = roll_out(environment, None, Uniform(), episodes=200, seed=1).returns
    assert by_rule.mean() > 30 and at_random.mean() < -60
    assert np.mean(by_rule > 0) > 0.97


def test_what_it_senses_is_drawn_around_it() -> None:
    robot = Wheels()
    sensors = [0.0] * 8
    sensors[5] = 0.5
    picture = draw_robot(robot, np.array([*sensors, 0.1, math.pi / 2]), command=np.zeros(2))

    def place(colour: tuple[int, int, int]) -> np.ndarray:
        return (np.argwhere(np.all(picture == colour, axis=-1))[:, ::-1].mean(axis=0) + 0.5 - 180) * 1.4 * 0.135 / 180

    np.testing.assert_allclose(place(BODY), [0, 0], atol=0.01)
    # A bearing of a quarter turn is to the right; the left sensor meets something half its range away.
    np.testing.assert_allclose(place(GOAL_FILL), [0.1, 0], atol=0.012)
    np.testing.assert_allclose(place(INK), [-0.085, 0], atol=0.003)
    assert place(ACCENT)[0] < -0.02
