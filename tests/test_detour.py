"""Detour, against straight paths walked in small steps and drives straight to the goal, with the body of `wheels`."""

from __future__ import annotations

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import Actor, HeuristicPolicy, Uniform, roll_out
from animat.robots import Detour, Wheels, WheelsState, robot_from_dict, robot_to_dict
from animat.robots.surroundings import Surroundings

ROBOT = Detour()


def goals_of(robot: Wheels | Detour, n: int = 4000) -> np.ndarray:
    """The distinct goals that are drawn, in lattice steps from the start."""
    states = jax.jit(jax.vmap(robot.reset))(jax.random.split(jax.random.key(0), n))
    return np.unique(np.round((np.stack([states.goal_x_m, states.goal_y_m], axis=1) - 0.5) / 0.014), axis=0)


def is_blocked(robot: Detour, goals: np.ndarray) -> np.ndarray:
    """Whether a body moved to a goal in steps of 2 mm touches anything."""
    around = Surroundings(robot.walls, robot.obstacles)
    along = np.arange(0, 1, 0.002 / 0.8)[:, None]
    return np.asarray((around.clearance_m(*(0.5 + along * 0.014 * of for of in goals.T)) < 0.035).any(axis=0))


def test_goals_are_all_the_places_of_wheels_that_cannot_be_driven_straight_to() -> None:
    anywhere = goals_of(Wheels(walls=ROBOT.walls, obstacles=ROBOT.obstacles), 30_000)
    drawn = set(map(tuple, goals_of(ROBOT, 30_000).tolist()))
    assert drawn <= set(map(tuple, anywhere.tolist()))
    some = np.random.default_rng(1).permutation(anywhere)[:400]
    assert [tuple(each) in drawn for each in some.tolist()] == is_blocked(ROBOT, some).tolist()
    assert 0.3 * len(anywhere) < len(drawn) < 0.8 * len(anywhere)


def test_driving_straight_to_the_goal_bumps_and_never_arrives() -> None:
    @jax.jit
    @jax.vmap
    def drive(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        start = ROBOT.reset(key)
        start = start._replace(heading_rad=jnp.arctan2(start.goal_y_m - start.y_m, start.goal_x_m - start.x_m))

        def iterate(state: WheelsState, _: None) -> tuple[WheelsState, tuple[jax.Array, jax.Array]]:
            state, reward, arrived = ROBOT.advance(jnp.zeros(0), state, jnp.ones(2))
            return state, (reward, arrived)

        _, (rewards, arrived) = jax.lax.scan(iterate, start, None, length=40)
        return rewards[-1], arrived.any()

    last, arrived = drive(jax.random.split(jax.random.key(1), 500))
    # All but those that come within the goal's radius of a goal close by a post, or slip past within an iteration.
    assert np.mean(np.asarray(last) == -2) > 0.95 and np.mean(np.asarray(arrived)) < 0.05


@pytest.mark.oracle
def test_goals_in_oblique_surroundings_are_where_a_body_touches_something_at_one_of_many_places_on_the_way() -> None:
    walls = (*ROBOT.walls[:4], (0.1, 0.15, 0.6, 0.35), (0.3, 0.7, 0.3, 0.7), (0.9, 0.3, 0.7, 0.55))
    robot = Detour(walls=walls, obstacles=((0.8, 0.8, 0.1),), start_x_m=0.45)
    places, start, along = Wheels(**vars(robot))._goals_m, (0.45, 0.5), np.linspace(0, 1, 2001)[:, None]
    ways = (start[axis] + along * (places[:, axis] - start[axis]) for axis in (0, 1))
    near = Surroundings(robot.walls, robot.obstacles).clearance_m(*ways).min(axis=0)
    drawn = set(map(tuple, robot._goals_m.tolist()))
    is_clear = np.abs(near - 0.035) > 1e-4
    assert [tuple(place) in drawn for place in places[is_clear].tolist()] == (near[is_clear] < 0.035).tolist()
    assert 0.2 * len(places) < len(drawn) < 0.8 * len(places) and is_clear.mean() > 0.99


def test_its_body_is_that_of_wheels() -> None:
    wheels = Wheels(walls=ROBOT.walls, obstacles=ROBOT.obstacles)
    state = WheelsState(*map(jnp.float32, (0.45, 0.6, 1.0, 0.5, 0.9)))
    assert ROBOT.observation_spec == wheels.observation_spec
    np.testing.assert_array_equal(*(jax.jit(each.observe)(state) for each in (ROBOT, wheels)))
    steps = [jax.jit(each.advance)(jnp.zeros(0), state, jnp.array([0.9, 0.4])) for each in (ROBOT, wheels)]
    for mine, theirs in zip(*map(jax.tree.leaves, steps), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_the_heuristic_goes_along_what_is_on_the_goals_side_and_else_to_the_goal() -> None:
    def turn(bearing: float, **sensors: float) -> float:
        seen = np.zeros(10, np.float32)
        for sensor, value in sensors.items():
            seen[int(sensor[1:])] = value
        seen[8:] = 0.3, bearing
        left, right = ROBOT.heuristic(seen)
        return float(left - right)

    assert turn(1.0) > 0 > turn(-1.0) and turn(0.0) == 0
    # Straight at a wall that is more on the right: to the left, though the goal is ahead; and the other way round.
    assert turn(0.0, s0=0.6, s7=0.5) < 0 < turn(0.0, s0=0.5, s7=0.6)
    # Along a wall on the right, at 0.065 m from the body: straight on, though the goal is behind the wall.
    assert turn(math.pi / 2, s2=0.35) == pytest.approx(0, abs=1e-6)
    # Not where the goal is on the free side.
    assert turn(-math.pi / 2, s2=0.35) < -0.5


def test_surroundings_that_block_no_way_are_refused() -> None:
    with pytest.raises(InvalidArgument, match="walls, obstacles: expected some that block the straight path"):
        Detour(walls=Detour().walls[:4], obstacles=())
    with pytest.raises(InvalidArgument, match="start_x_m, start_y_m: expected a place within the walls"):
        Detour(start_x_m=3.0)


def test_it_converts_to_data() -> None:
    robot = Detour(obstacles=((0.3, 0.5, 0.05),))
    assert robot_from_dict(json.loads(json.dumps(robot_to_dict(robot)))) == robot


@pytest.mark.oracle
def test_the_heuristic_finds_the_way_round_and_that_of_wheels_often_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def ran(actor: Actor, robot: Detour = ROBOT) -> tuple[float, float]:
        ran = roll_out(WithoutNeurons(robot, None), None, actor, episodes=400, seed=1)
        return float(ran.terminated.mean()), float(ran.returns.mean())

    by_rule, at_random = ran(HeuristicPolicy()), ran(Uniform())
    assert by_rule[0] > 0.97 and by_rule[1] > 28
    assert at_random[0] < 0.02 and at_random[1] < -80
    monkeypatch.setattr(Detour, "heuristic", Wheels.heuristic)
    # Of other parameters, so that it is compiled anew.
    of_wheels = ran(HeuristicPolicy(), Detour(reward_goal=50.001))
    assert of_wheels[0] < 0.8 and of_wheels[1] < 5
