"""A robot with a goal: rewards, ends and outcomes of episodes counted by hand; and the goal's text."""

from __future__ import annotations

import math
import pickle
import re
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.environment import Environment, WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.optimum import _Programme, _Tables, best_return
from animat.evaluation.rollouts import Constant, roll_out
from animat.goals.goal import Ball, Goal, Objective, Range, read_goal
from animat.goals.robot import RobotWithGoal, body_and_goal, robot_of, with_goal, without_goal
from animat.goals.tally import Outcome, cells_of, satisfaction_line
from animat.progress import Silent
from animat.robots import Cartpole, GymnasiumRobot, Navigation, Quantity, Robot, Shuttle, SwingUp, robot_named
from animat.robots.base import lacking
from animat.robots.checking import check_robot
from animat.robots.grid import grid_for, why_no_grid
from animat.training.sac import shaped
from animat.training.settings import SAC
from animat.wrappers import Wrapper
from test_loop_starts import Anywhere


class At(NamedTuple):
    x_m: jax.Array


@dataclass(frozen=True)
class Slider(Robot[At]):
    """Moves to the commanded place: x is the command, with a scale of 2 m."""

    episode_limit: int = 4
    start_m: float = 0.0
    name = "slider"

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("x", "m", 2.0),)

    def reset(self, key: Any) -> At:
        return At(jnp.float32(self.start_m))

    def advance(self, uniforms: Any, state: At, u: Any) -> Any:
        return At(jnp.float32(u)), jnp.float32(7.0), jnp.bool_(True)

    def observe(self, state: At) -> Any:
        return jnp.stack([state.x_m])


def along(goal: str, xs: list[float], limit: int = 4) -> tuple[list[float], list[bool], Any]:
    """Rewards, ends and outcome of an episode through these places, until it ends."""
    robot = with_goal(Slider(limit), goal)
    state, rewards, ends = robot.reset(jax.random.key(0)), [], []
    for x in xs:
        state, reward, ended = robot.advance(jnp.zeros(0), state, jnp.float32(x))
        rewards.append(float(reward))
        ends.append(bool(ended))
        if ended:
            break
    # The log of a closed loop gives the same outcome.
    by_log = robot.outcome_of(np.array([[robot.robot.start_m], *([x] for x in xs[: len(rewards)])], np.float32))
    for of_state, of_log in zip(robot.outcome(state), by_log, strict=True):
        np.testing.assert_array_equal(of_state, of_log)
    return rewards, ends, robot.outcome(state)


@pytest.mark.parametrize(
    ("goal", "xs", "rewards", "ends", "succeeded", "satisfaction", "margin"),
    [
        # Margins are in scales of 2 m.
        ("avoid x above 0.5 m", [0.1, 0.2, 0.5, 0.4], [1, 1, 1, 1], False, True, [100], 0.0),
        ("avoid x above 0.5 m", [0.1, 0.2, 0.7], [1, 1, -100], True, False, [50], -0.1),
        ("reach x above 0.5 m", [0.1, 0.2, 0.3, 0.1], [-1, -1, -1, -1], False, False, [90], -0.1),
        ("reach x above 0.5 m", [0.1, 0.9], [-1, 50], True, True, [100], 0.2),
        ("drive x in 20..60 cm", [0.1, 0.2, 0.4, 0.7], [0, 1, 1, 0], False, False, [50], -0.05),
        ("drive x in 0.2..0.6 m", [0.1, 0.2, 0.7, 0.4], [0, 1, 0, 1], False, True, [50], 0.1),
        # The start is outside: with the first two iterations that is three in a row.
        ("drive x in 0.2..0.6 m within 2", [0.1, 0.1], [0, -100], True, False, [0], -0.05),
        ("drive x in 0.2..0.6 m within 2", [0.1, 0.4, 0.1, 0.1], [0, 1, 0, 0], False, False, [25], -0.05),
        ("drive x in -0.6..0.6 m within 2", [0.7, 0.8, 0.9], [0, 0, -100], True, False, [0], -0.15),
        ("maximize x above 0.2 m", [0.2, 0.4, -0.2, 0.6], [0.5, 0.55, 0.4, 0.6], False, True, [50], 0.2),
        ("minimize x below 0.2 m", [0.2, 0.4, -0.2, 0.6], [0.5, 0.45, 0.6, 0.4], False, False, [25], -0.2),
        ("avoid x outside -0.5..0.5 m", [0.5, -0.5, -0.7], [1, 1, -100], True, False, [50], -0.1),
        ("avoid x around 1 radius 0.5 m", [0.2, 0.4, 0.5], [1, 1, -100], True, False, [50], 0.0),
        # Only the ratios of weights matter: 3 to 1 is 1.5 to 0.5 on average 1.
        ("avoid x above 0.5 m weight 6; drive x above 0 m weight 2", [0.1, -0.1, 0.7], [1, 0.75, -150], True, False,
         [50, 50], -0.1),
        # Where there is anything to reach, all else costs, and failing costs as much more as all iterations may.
        ("reach x above 0.5 m; avoid x below -0.5 m", [0.1, 0.2, -0.7], [-0.5, -0.5, -104], True, False, [85, 50],
         -0.15),
        ("reach x above 0.5 m weight 3; avoid x below -0.5 m", [-0.7], [-54], True, False, [40, 0], -0.6),
        ("reach x above 0.5 m; drive x above 0 m", [0.1, -0.2, 0.9], [-0.5, -1, 50], True, True, [100, 200 / 3], 0.2),
        ("reach x above 0.5 m weight 3; reach x below -0.5 m", [-0.7], [25], True, True, [40, 100], 0.1),
        ("reach x above 0.5 m; avoid x above 0.5 m", [0.7], [-104], True, False, [100, 0], -0.1),
        # What only pays on the way does not decide, not even where the episode fails.
        ("reach x above 0.5 m; avoid x below -0.5 m; drive x in 0.4..0.5 m", [0.45, -0.55], [-1 / 3, -104], True, False,
         [97.5, 25, 25], -0.025),
        ("reach x above 0.5 m; avoid x below -0.5 m; drive x in 0.4..0.5 m within 9", [0.45, -0.55], None, True, False,
         None, -0.025),
        ("reach x above 0.5 m; drive x in -0.1..0.1 m within 3", [0.9], None, True, True, None, 0.2),
        # It may fail in the iteration in which it reaches; and beside an open edge it is not inside.
        ("reach x above 0.5 m; drive x in -0.1..0.1 m within 1", [0.2, 0.9], None, True, False, None, -0.4),
        ("minimize x below 0.0 m", [0.2, 0.2, 0.2, 0.0], None, False, False, None, 0.0),
        ("drive x in 0.2..0.6 m and x above 0.5 m", [0.5, 0.55, 0.3, 0.6], [0, 1, 0, 1], False, True, [50], 0.0),
    ],
)  # fmt: skip
def test_rewards_ends_and_outcome_are_those_counted_by_hand(
    goal: str,
    xs: list[float],
    rewards: list[float] | None,
    ends: bool,
    succeeded: bool,
    satisfaction: list[float] | None,
    margin: float,
) -> None:
    got, ended, outcome = along(goal, xs)
    assert rewards is None or got == pytest.approx(rewards, abs=1e-5)
    assert ended == [False] * (len(xs) - 1) + [ends]
    assert bool(outcome.succeeded) is succeeded
    assert satisfaction is None or np.asarray(outcome.satisfaction).tolist() == pytest.approx(satisfaction, abs=1e-3)
    assert float(outcome.margin) == pytest.approx(margin, abs=1e-5)


def test_what_comes_after_the_end_is_not_counted() -> None:
    robot = with_goal(Slider(4), "reach x above 0.5 m")
    state = robot.reset(jax.random.key(0))
    for x in (0.9, -0.9, -0.9):
        state, _, _ = robot.advance(jnp.zeros(0), state, jnp.float32(x))
    assert bool(robot.succeeded(state)) and int(state.tally.iterations) == 1
    assert float(robot.outcome(state).margin) == pytest.approx(0.2)


OBJECTIVES = st.sampled_from(
    ["avoid x above 0.6 m", "avoid x outside -0.8..0.8 m weight 3", "reach x below -0.5 m", "drive x in -0.4..0.4 m",
     "drive x below 0.3 m within 3", "minimize x below 0 m", "maximize x above 0.1 m weight 0.5"]
)  # fmt: skip
GOALS = st.lists(OBJECTIVES, min_size=1, max_size=4, unique=True).map("; ".join)
PATHS = st.lists(st.integers(-10, 10).map(lambda i: i / 10 + 0.031), min_size=6, max_size=6)


@pytest.mark.oracle
@settings(max_examples=30, deadline=None)
@given(GOALS, PATHS, st.sampled_from([0.5, 0.99, 1.0]))
def test_shaping_adds_up_to_the_start_whatever_is_done_and_outcome_and_margin_agree(
    goal: str, xs: list[float], discount: float
) -> None:
    robot = with_goal(Slider(6, 0.2), goal)
    learner = SAC(discount=discount)
    state, total = robot.reset(jax.random.key(0)), 0.0
    start, rewards = float(robot.potential(state)), 0.0
    for i, x in enumerate(xs):
        before = state
        state, reward, terminated = robot.advance(jnp.zeros(0), state, jnp.float32(x))
        # An episode that is cut off ends for the learner, too.
        ended = terminated | (i + 1 == robot.episode_limit)
        of_one = [jax.tree.map(lambda leaf: leaf[None], part) for part in (before, state, reward, ended)]
        total += discount**i * float(shaped(robot, learner, *of_one)[0] - reward)
        rewards += float(reward)
        if terminated:
            break
    assert total == pytest.approx(-start, abs=1e-4)
    outcome = robot.outcome(state)
    assert bool(outcome.succeeded) == (float(outcome.margin) > 0)
    assert all(0 <= percent <= 100.001 for percent in outcome.satisfaction)
    low, high = robot.return_range
    assert low - 1e-3 <= rewards <= high + 1e-3


def test_the_range_of_returns_goes_from_failing_at_the_end_to_reaching_at_once() -> None:
    both = with_goal(Slider(6, 0.2), "reach x in 0.5..0.6 m weight 3; avoid x in -0.6..-0.5 m")
    # Each of six iterations costs 1, and failing 100 and another 6, with weights of 1.5 and 0.5; reaching gives 50.
    assert both.return_range == pytest.approx((-(6 + 100 * 0.5 + 6), 50 * 1.5))
    assert with_goal(Slider(6, 0.2), "reach x in 0.5..0.6 m").return_range == (-6, 50)


def test_what_episodes_came_to_in_a_table() -> None:
    outcome = Outcome(jnp.array([True, False]), jnp.array([[100.0, 40.0], [50.0, 0.0]]), jnp.array([0.5, -0.2]))
    assert cells_of(outcome.means()) == ["50 %", "48 %", "+0.15"]
    assert cells_of({}) == ["", "", ""]
    assert satisfaction_line(["reach a", "avoid b"], outcome.means()) == "satisfied: reach a: 75 %; avoid b: 20 %"


class Walk(NamedTuple):
    at: jax.Array


@dataclass(frozen=True)
class Walker(Robot[Walk]):
    """Eleven places in a row; a command moves one to the left or right, and fails with a probability of 30 %."""

    episode_limit: int = 30
    name = "walker"
    noise_size = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("at", "1", 5.0),)

    def reset(self, key: Any) -> Walk:
        return Walk(jnp.float32(5.0))

    def advance(self, uniforms: Any, state: Walk, u: Any) -> Any:
        at = jnp.clip(state.at + jnp.sign(u) * jnp.where(uniforms[0] < 0.3, 0.0, 1.0), 0.0, 10.0)
        return Walk(at), jnp.float32(0.0), jnp.bool_(False)

    def observe(self, state: Walk) -> Any:
        return jnp.stack([state.at])


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("goal", "away"),
    [
        ("reach at above 8.5; avoid at below 1.5", lambda at: 8.5 - at),
        ("drive at in 5.5..7.5; avoid at above 8.5", lambda at: np.maximum(5.5 - at, at - 7.5)),
        ("maximize at above 3; drive at above 6", lambda at: 6 - at),
    ],
)
def test_shaping_changes_values_by_the_potential_and_no_best_action(goal: str, away: Any) -> None:
    robot, learner, limit = with_goal(Walker(), goal), SAC(discount=0.95), 30
    places, commands = np.arange(11), (-1.0, 0.0, 1.0)
    states = jax.vmap(lambda at: robot.started(Walk(at)))(jnp.asarray(places, jnp.float32))

    advance, uniforms = jax.jit(jax.vmap(robot.advance)), jnp.ones((11, 1))
    moved = [
        (c, share, *advance(chance * uniforms, states, jnp.full(11, u)))
        for c, u in enumerate(commands)
        for chance, share in ((0.0, 0.3), (1.0, 0.7))
    ]

    def q_values(is_shaped: bool) -> np.ndarray:
        """By dynamic programming, with the time left in the state as the critics see it."""
        values, found = np.zeros(11), []
        # Only the last iteration ends an episode in every state.
        rewards = {}
        for is_last in (False, True):
            for i, (_, _, after, reward, terminated) in enumerate(moved):
                ended = terminated | is_last
                rewards[i, is_last] = shaped(robot, learner, states, after, reward, ended) if is_shaped else reward
        for left in range(1, limit + 1):
            q = np.zeros((len(commands), 11))
            for i, (c, share, after, _, terminated) in enumerate(moved):
                went_on = np.where(terminated | (left == 1), 0.0, values[np.asarray(after.robot.at, int)])
                q[c] += share * (np.asarray(rewards[i, left == 1]) + learner.discount * went_on)
            values = q.max(axis=0)
            found.append(q)
        return np.array(found)

    plain, with_shaping = q_values(False), q_values(True)
    potential = np.asarray(jax.vmap(robot.potential)(states))
    np.testing.assert_allclose(with_shaping, plain - potential, atol=1e-4)
    # One of two objectives has it: 3 / 2 for each scale of 5 that the robot is away, up to the first.
    np.testing.assert_allclose(potential, -1.5 * np.clip(away(places) / 5, 0, 1), atol=1e-6)
    assert np.ptp(potential) > 1
    # What is best, or as good, stays so.
    best = plain >= plain.max(axis=1, keepdims=True) - 1e-4
    assert np.array_equal(best, with_shaping >= with_shaping.max(axis=1, keepdims=True) - 3e-4)
    assert not best.all(axis=1).all()


def test_a_robot_without_a_potential_learns_from_its_rewards() -> None:
    reward = jnp.ones(3)
    assert shaped(Cartpole(), SAC(), None, None, reward, jnp.zeros(3, bool)) is reward


CARTPOLE = "avoid pole_angle outside -12..12 deg; avoid cart_position outside -0.5..0.5 m"
NAVIGATION = "reach x, y around 0.7, 0.7 radius 0.1 m"


@pytest.mark.oracle
def test_the_cartpole_as_a_goal_has_its_own_rewards_and_ends() -> None:
    own, robot = Cartpole(), with_goal("cartpole", CARTPOLE)
    assert robot.return_range == own.return_range
    rng = np.random.default_rng(1)
    n = 2000
    low, high = np.array([-0.52, -2, -0.22, -3]), np.array([0.52, 2, 0.22, 3])
    states = jax.vmap(robot.reset)(jax.random.split(jax.random.key(0), n))
    states = states._replace(robot=type(states.robot)(*jnp.asarray(rng.uniform(low, high, (n, 4)).T, jnp.float32)))
    uniforms, u = rng.random((n, 1), np.float32), rng.uniform(-1, 1, n).astype(np.float32)
    ours = jax.vmap(robot.advance)(uniforms, states, u)
    theirs = jax.vmap(own.advance)(uniforms, states.robot, u)
    for mine, other in zip((ours[0].robot, *ours[1:]), theirs, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert 0.05 < np.mean(ours[2]) < 0.95


@dataclass(frozen=True)
class OwnReward(Wrapper[Any]):
    """The reward of the robot's own task, for a controller that pursues the goal."""

    def advance(self, uniforms: Any, state: Any, action: Any, simulator: Any) -> Any:
        after = self.inside.advance(uniforms, state, action, simulator)
        own = without_goal(self.robot)
        _, reward, _ = own.advance(uniforms[: own.noise_size], state.robot.robot, after.info["command"])
        return after._replace(reward=reward)


def best_controller(environment: Environment[Any], resolution: float, episodes: int) -> np.ndarray:
    """Returns, by the environment's rewards, of the controller that is best by the robot's rewards."""
    robot = environment.robot
    grid = grid_for(robot).scaled(resolution)
    programme = _Programme(grid, [(environment, None)])
    tables = _Tables(grid, programme.n_layers, robot.episode_limit)
    programme.run(tables, 1, Silent())
    return programme.play(tables, 0, episodes, 5, clock=True)


@pytest.mark.oracle
@pytest.mark.parametrize(("name", "goal", "resolution"), [("cartpole", CARTPOLE, 0.4), ("navigation", NAVIGATION, 0.5)])
@pytest.mark.parametrize("commands", [(-1.0, 1.0), (-0.6, -0.2, 0.4)])
def test_the_best_policy_of_a_published_task_as_a_goal_is_as_good_at_the_task(
    name: str, goal: str, resolution: float, commands: tuple[float, ...]
) -> None:
    own = robot_named(name)
    of_task = best_controller(WithoutNeurons(own, commands), resolution, 200)
    of_goal = best_controller(OwnReward(WithoutNeurons(with_goal(own, goal), commands)), resolution, 200)
    error = np.hypot(of_task.std(), of_goal.std()) / np.sqrt(200)
    # Of a return from random actions to the best: 200 for the cartpole, 100 for navigation.
    assert abs(of_task.mean() - of_goal.mean()) <= 0.5 + 3 * error


def test_a_goal_with_within_has_no_grid_and_says_so() -> None:
    robot = with_goal("cartpole", "drive pole_angle in -5..5 deg within 3")
    assert "within" in (why_no_grid(robot) or "") and "value_grid" not in lacking(robot)
    with pytest.raises(InvalidArgument, match="within"):
        best_return(WithoutNeurons(robot, (-1.0, 1.0)), None, episodes=0)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("goal", "beyond"),
    [
        (CARTPOLE, ""),
        ("avoid pole_angle outside -10..10 deg; avoid cart_position outside -0.4..0.4 m", ""),
        ("avoid pole_angle outside -12..12 deg", ""),
        # What is but a little beyond makes no difference.
        ("avoid pole_angle outside -0.21..0.21 rad; avoid cart_position outside -0.505..0.505 m", ""),
        ("avoid pole_angle outside -13..13 deg", "pole_angle beyond -0.209 to 0.209 rad"),
        (f"{CARTPOLE}; drive cart_position in 0.1..0.3 m", ""),
        (
            "avoid pole_angle outside -12..12 deg; drive cart_position above 0.55 m",
            "cart_position beyond -0.5 to 0.5 m",
        ),
        ("drive cart_position above 0.55 m", "cart_position beyond -0.5 to 0.5 m"),
        ("drive pole_angle in -12..12 deg", "pole_angle beyond -0.209 to 0.209 rad"),
        ("avoid pole_angle outside -90..90 deg", "pole_angle beyond -0.209 to 0.209 rad"),
        ("avoid cart_position outside -0.5..0.5 m", "pole_angle beyond -0.209 to 0.209 rad"),
    ],
)
def test_there_is_no_optimum_where_episodes_go_on_beyond_the_grid(goal: str, beyond: str) -> None:
    robot = with_goal("cartpole", goal)
    assert (why_no_grid(robot) or "").endswith(beyond) and bool(why_no_grid(robot)) == bool(beyond)
    if beyond:
        with pytest.raises(InvalidArgument, match=re.escape(beyond)):
            best_return(WithoutNeurons(robot, (-1.0, 1.0)), None, episodes=0)


@pytest.mark.parametrize(
    ("name", "goal"), [("navigation", "drive x above 0.6 m"), ("shuttle", "drive cart_position above 0.4 m")]
)
def test_where_a_body_stays_within_the_grid_any_goal_has_an_optimum(name: str, goal: str) -> None:
    assert why_no_grid(with_goal(name, goal)) is None


@pytest.mark.oracle
def test_an_end_that_a_command_decides_is_not_known_from_the_state() -> None:
    grid = grid_for(with_goal("cartpole", CARTPOLE))
    assert grid.end_is_known and grid.smooth_commands == grid_for(Cartpole()).smooth_commands
    for goal in ("avoid cart_velocity outside -0.3..0.3 m/s", "reach cart_velocity above 0.3 m/s"):
        by_speed = grid_for(with_goal("cartpole", goal))
        assert not by_speed.end_is_known and by_speed.smooth_commands is None


def test_a_goal_keeps_the_robots_other_abilities() -> None:
    robot = with_goal(SwingUp(), "drive angle_cosine above 0.9")
    assert not lacking(robot)
    assert robot.heuristic(np.array([1.0, 0.0, 0.0])) == SwingUp().heuristic(np.array([1.0, 0.0, 0.0]))
    slider = with_goal(Slider(), "reach x above 0.5 m")
    assert lacking(slider).keys() == lacking(Slider()).keys() and not hasattr(slider, "start_m")
    check_robot(slider)
    assert slider == with_goal(Slider(), "reach x above 50 cm") or slider.goal != read_goal("reach x above 50 cm")
    assert hash(robot) == hash(pickle.loads(pickle.dumps(robot))) and pickle.loads(pickle.dumps(robot)) == robot
    assert replace(robot, robot=SwingUp(mass_kg=2.0)).robot.mass_kg == 2.0


def test_its_own_goal_can_be_switched_where_the_body_s_can() -> None:
    robot, plain = with_goal(Shuttle(), "reach cart_position above 0.2 m"), Shuttle()
    state, other = robot.reset(jax.random.key(1)), robot.reset(jax.random.key(2))._replace()
    other = other._replace(robot=other.robot._replace(cue=-state.robot.cue))
    switched = robot.with_goal_of(state, other)
    assert float(switched.robot.cue) == -float(state.robot.cue)
    assert switched.robot == plain.with_goal_of(state.robot, other.robot)
    assert not hasattr(with_goal(Cartpole(), "avoid pole_angle above 12 deg"), "with_goal_of")


def test_rollouts_report_the_outcome_of_each_episode() -> None:
    robot = with_goal(Slider(4), "drive x above 0 m; avoid x below -0.5 m")
    actors = Constant(jnp.array([0, 1, 2]))
    ran = roll_out(WithoutNeurons(robot, (-0.9, -0.2, 0.4)), None, actors, episodes=2, seed=1)
    assert ran.outcome is not None
    assert ran.outcome.succeeded.tolist() == [[False] * 2, [False] * 2, [True] * 2]
    np.testing.assert_allclose(ran.outcome.margin[:, 0], [-0.45, -0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(ran.outcome.satisfaction[:, 0], [[0, 0], [0, 100], [100, 100]], atol=1e-4)
    assert (
        roll_out(WithoutNeurons(Cartpole(), (0.0,)), None, Constant(jnp.array([0])), episodes=1, seed=1).outcome is None
    )


def test_a_start_in_a_region_that_ends_episodes_is_reported() -> None:
    assert "start in" in with_goal(Navigation(), "reach x, y around 0.7, 0.7 radius 10 cm").caveats()[-1]
    assert with_goal(Navigation(), NAVIGATION).caveats() == ()
    # Where starts are drawn, x uniformly from 0 to 1 m.
    (half,) = with_goal(Anywhere(), "avoid x below 0.5 m").caveats()
    share = re.fullmatch(r"goal: (\d+) % of the episodes of anywhere start in the region: avoid x below 0\.5 m", half)
    assert share is not None and abs(int(share[1]) - 50) < 10
    assert with_goal(Anywhere(), "avoid x below 0.03 m").caveats() == ()


def test_a_goal_is_stored_as_text_with_the_robot() -> None:
    robot = with_goal(Navigation(stride_m=0.03), NAVIGATION + "; avoid heading in 100..120 deg weight 0.1")
    data = body_and_goal(robot)
    assert data["goal"] == str(robot.goal) and data["robot"]["name"] == "navigation"
    assert robot_of(data) == robot
    assert body_and_goal(Navigation()).keys() == {"robot"} and robot_of(body_and_goal(Navigation())) == Navigation()
    with pytest.raises(InvalidArgument, match="goal: expected a goal, such as"):
        robot_of({**data, "goal": 3})


NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)
NAMES = st.sampled_from(["x", "pole_angle", "goal_x2"])
UNITS = st.sampled_from(["", "m", "rad/s", "deg"])


@st.composite
def parts(draw: Any) -> Range | Ball:
    name, unit = draw(NAMES), draw(UNITS)
    if draw(st.booleans()):
        names = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
        return Ball(tuple(names), tuple(draw(NUMBERS) for _ in names), draw(st.floats(1e-9, 1e9)), unit)
    low, high = sorted((draw(NUMBERS), draw(NUMBERS)))
    if low == high:
        return Range(name, low, None, unit)
    return draw(st.sampled_from([Range(name, low, high, unit, True), Range(name, low, high, unit), Range(name, None, high, unit)]))  # fmt: skip  # noqa: E501


@pytest.mark.oracle
@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["avoid", "reach", "drive"]), st.lists(parts(), min_size=1, max_size=3),
                          st.floats(1e-3, 1e3), st.none() | st.integers(1, 99)), min_size=1, max_size=4))  # fmt: skip
def test_text_and_goal_are_the_same(drawn: Any) -> None:
    goal = Goal(tuple(
        Objective(kind, tuple(region), weight, within if kind == "drive" else None)
        for kind, region, weight, within in drawn
    ))  # fmt: skip
    assert read_goal(str(goal)) == goal
    assert read_goal(str(goal).replace("; ", " \n\n ")) == goal


def test_units_are_those_of_the_robot() -> None:
    (each,) = with_goal(Cartpole(), "drive pole_angle in -6..12 deg weight 2").goal.objectives
    inside = with_goal(Cartpole(), "drive pole_angle in -6..12 deg")._objectives[0].region[0]
    assert isinstance(inside, Range) and inside.unit == "rad" and inside.high == pytest.approx(math.radians(12))
    assert each.weight == 2
    cm = with_goal(Navigation(), "reach x, y around 70, 70 radius 10 cm")._objectives[0].region[0]
    assert isinstance(cm, Ball) and (*cm.centre, cm.radius) == pytest.approx((0.7, 0.7, 0.1))


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("", "expected an objective, such as"),
        (" ; \n", "expected an objective, such as"),
        ("avoid", r"'avoid': expected a region: QUANTITY in\|outside LOW..HIGH UNIT; .*; got ''"),
        ("avod pole_angle above 1 rad", "did you mean avoid"),
        ("avoid pole_angel above 1 rad", "did you mean pole_angle"),
        (
            "avoid pole_angle over 1 rad",
            "QUANTITY above.below NUMBER UNIT; .*got 'pole_angle over 1 rad'",
        ),
        ("avoid pole_angle abov 1 rad", r"got 'pole_angle abov 1 rad'; did you mean above\?"),
        ("reach x, y arond 3, 3 radius 1 m", r"did you mean around\?"),
        ("drive pole_angle in -1..1 deg within", "then within NUMBER, weight NUMBER; got .* deg within'$"),
        ("avoid pole_angle above 1", "expected rad or deg, got no unit"),
        ("avoid pole_angle above 1 m", "expected rad or deg, got m"),
        ("avoid cart_velocity above 1 deg/s", "expected m/s or cm/s or mm/s, got deg/s"),
        ("avoid cart_velocity above 1 cm", "expected m/s or cm/s or mm/s, got cm"),
        ("avoid pole_angle in 2..1 rad", "the lower end first"),
        (
            "avoid pole_angle in 1 2 rad",
            r"QUANTITY in\|outside LOW\.\.HIGH UNIT; .*got 'pole_angle in 1 2 rad'",
        ),
        ("avoid pole_angle in 1.. rad", r"LOW\.\.HIGH UNIT.*got 'pole_angle in 1 \.\. rad'"),
        ("avoid pole_angle above nan rad", "above.below NUMBER UNIT.*got 'pole_angle above nan rad'"),
        ("avoid pole_angle above 1e999 rad", "finite"),
        ("reach pole_angle above 1 rad and pole_angle below 0 rad", "an empty region"),
        ("drive pole_angle outside 0..1 deg and pole_angle in 0.2..0.5 deg", "an empty region"),
        ("drive pole_angle outside 0..1 deg and pole_angle in 0..1 deg", "an empty region"),
        ("avoid pole_angle above 1 rad weight 1e308", "weight: expected at most"),
        ("reach pole_angle, cart_position around 0, 0 radius 1 m", "expected a quantity in rad"),
        ("reach cart_position, cart_position around 0 radius 1 m", "a centre of 2 numbers"),
        ("reach cart_position, cart_position around 0, 1 radius 1 m", "cart_position: expected each quantity once"),
        ("reach cart_position around 0 radius -1 m", "radius: expected more than 0"),
        ("drive pole_angle in -1..1 deg within 0", "within: expected at least 1"),
        ("drive pole_angle in -1..1 deg within 2.5", "within: expected a whole number"),
        ("avoid pole_angle above 1 rad within 3", "within: expected it for drive only"),
        ("drive pole_angle in -1..1 deg weight -1", "weight: expected at least 1e-06"),
        (
            "drive pole_angle in -1..1 deg weight 1 weight 2",
            "expected within and weight at most once, .*got 'weight 2'",
        ),
        ("maximize pole_angle below 3 rad", "maximize: expected one quantity above a threshold"),
        ("minimize x, y around 3, 3 radius 1 m", "minimize: expected one quantity below a threshold"),
        ("avoid pole_angle above 1 rad x", "several joined by and, .*; got 'pole_angle above 1 rad x'"),
        ("drive x in 1..2 within 3 and x above 1", "within and weight at most once, .*got 'within 3 and x above 1'"),
        ("; ".join(["avoid pole_angle above 1 rad"] * 51), "at most 50"),
        # Not -5 to 0.5.
        ("avoid pole_angle outside -5...5 deg", "expected a region: .*got 'pole_angle outside -5 ... 5 deg'"),
    ],
)
def test_an_invalid_goal_is_reported_in_one_line(goal: str, message: str) -> None:
    with pytest.raises(InvalidArgument, match=message) as error:
        with_goal(Cartpole(), goal)
    assert str(error.value).startswith("goal") and "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "unit"), [("pole angle", "rad"), ("rate", "1/s"), ("x", "°C"), ("in", "m")])
def test_a_goal_whose_text_could_not_be_read_back_from_a_file_is_refused(name: str, unit: str) -> None:
    @dataclass(frozen=True)
    class Odd(Slider):
        @property
        def observation_spec(self) -> tuple[Quantity, ...]:
            return (Quantity(name, unit, 1.0),)

    goal = Goal((Objective("drive", (Range(name, -1.0, 1.0, unit),)),))
    with pytest.raises(InvalidArgument, match="goal: expected quantities and units that can be read back from its"):
        with_goal(Odd(), goal)


def test_bodies_that_are_stepped_on_the_host_are_refused() -> None:
    body = GymnasiumRobot.named("Pendulum-v1")
    with pytest.raises(InvalidArgument, match="goal: expected a robot that is stepped in JAX, got gymnasium:Pendulum"):
        with_goal(body, "drive x above 0.9")
    robot = with_goal(Cartpole(), CARTPOLE)
    with pytest.raises(InvalidArgument, match="without a goal"):
        with_goal(robot, CARTPOLE)
    with pytest.raises(InvalidArgument, match="expected a Goal"):
        RobotWithGoal(Cartpole(), CARTPOLE)  # type: ignore[arg-type]
