"""The contract that every registered robot keeps."""

from __future__ import annotations

import dataclasses
import json
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.robots import (
    ROBOTS,
    Cartpole,
    Navigation,
    Robot,
    SwingUp,
    TwoLinkArm,
    Wheels,
    robot_from_dict,
    robot_named,
    robot_to_dict,
)

VARIANTS = [
    *(robot_named(name) for name in ROBOTS),
    *(
        pytest.param(kind.as_printed(), marks=pytest.mark.oracle)
        for kind in ROBOTS.values()
        if hasattr(kind, "as_printed")
    ),
]


@pytest.fixture(params=VARIANTS, ids=lambda robot: f"{robot.name}-{robot.episode_limit}")
def robot(request: pytest.FixtureRequest) -> Robot:
    return request.param


def commands_of(robot: Robot, u):
    """Commands for every readout: for several readouts, alternately u and -u."""
    u = jnp.asarray(u, jnp.float32)
    return u if robot.n_commands == 1 else jnp.stack([u, -u] * robot.n_commands, -1)[..., : robot.n_commands]


def play(robot: Robot, policy: str, episodes: int, iterations: int, seed: int = 0):
    """Observations, rewards and endings of many episodes, (iterations, episodes, ...), continuing after an ending."""
    rng = np.random.default_rng(seed)
    shape = (iterations, episodes) if robot.n_commands == 1 else (iterations, episodes, robot.n_commands)
    u = {
        "random": rng.uniform(-1.0, 1.0, shape),
        "thrown": rng.choice((-1.0, 1.0), shape),
        "right": np.ones(shape),
        "left": -np.ones(shape),
    }[policy]
    uniforms = rng.random((iterations, episodes, robot.noise_size), np.float32)
    return jax.tree.map(np.asarray, _play(robot, jax.random.key(seed), uniforms, u.astype(np.float32)))


# One program for all policies of a robot.
@partial(jax.jit, static_argnums=0)
def _play(robot: Robot, key, uniforms, u):
    def iterate(state, inputs):
        state, reward, terminated = jax.vmap(robot.advance)(inputs[0], state, inputs[1])
        return state, (jax.vmap(robot.observe)(state), reward, terminated)

    start = jax.vmap(robot.reset)(jax.random.split(key, u.shape[1]))
    return jax.lax.scan(iterate, start, (uniforms, u))[1]


def test_a_state_keeps_its_form_so_that_it_can_be_scanned(robot: Robot) -> None:
    state = robot.reset(jax.random.key(0))
    assert all(leaf.shape == () and leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(state))
    after, reward, terminated = robot.step(jax.random.key(1), state, commands_of(robot, 0.3))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(after)] == [((), jnp.float32)] * len(state)
    assert (reward.shape, reward.dtype) == ((), jnp.float32)
    assert (terminated.shape, terminated.dtype) == ((), jnp.bool_)
    # So does the state of an environment, whole.
    environment = WithoutNeurons(robot, None)
    of_environment = jax.eval_shape(environment.reset, jax.random.key(0))
    of_step = jax.eval_shape(environment.step, jax.random.key(0), of_environment, commands_of(robot, 0.3), None)
    assert of_step == of_environment
    # Also in a program of the user's that computes in 64 bits.
    with jax.enable_x64(True):
        assert robot.reset(jax.random.key(0)) == state
        assert jax.eval_shape(robot.reset, jax.random.key(0)) == jax.eval_shape(lambda: state)
        in_64_bits = jax.eval_shape(robot.step, jax.random.key(1), state, commands_of(robot, 0.3))
    assert in_64_bits == jax.eval_shape(lambda: (after, reward, terminated))


def test_observations_are_the_quantities_in_order(robot: Robot) -> None:
    observation = robot.observe(robot.reset(jax.random.key(0)))
    assert observation.shape == (len(robot.observation_spec),)
    assert observation.dtype == jnp.float32
    assert len({quantity.name for quantity in robot.observation_spec}) == len(robot.observation_spec)
    for quantity in robot.observation_spec:
        assert quantity.scale > 0 and np.isfinite(quantity.scale) and quantity.unit
        assert quantity.low <= 0 <= quantity.high and np.isfinite([quantity.low, quantity.high]).all()


def test_a_step_is_advance_with_uniforms_of_the_key(robot: Robot) -> None:
    key, state = jax.random.key(5), robot.reset(jax.random.key(0))
    by_step = robot.step(key, state, commands_of(robot, -0.5))
    by_advance = robot.advance(jax.random.uniform(key, (robot.noise_size,)), state, commands_of(robot, -0.5))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), by_step, by_advance))
    again = robot.step(key, state, commands_of(robot, -0.5))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), by_step, again))


def test_a_jitted_step_draws_no_random_numbers_in_advance(robot: Robot) -> None:
    state = robot.reset(jax.random.key(0))
    traced = str(jax.make_jaxpr(robot.advance)(jnp.zeros(robot.noise_size), state, commands_of(robot, 0)))
    assert "random" not in traced and "threefry" not in traced


@pytest.mark.oracle
def test_a_batch_steps_as_each_alone(robot: Robot) -> None:
    u = commands_of(robot, jnp.linspace(-1, 1, 7))
    keys = jax.random.split(jax.random.key(3), 7)
    states = jax.jit(jax.vmap(robot.reset))(keys)
    together = jax.jit(jax.vmap(robot.step))(keys, states, u)
    step = jax.jit(robot.step)
    for i in range(7):
        alone = step(keys[i], jax.tree.map(lambda leaf, i=i: leaf[i], states), u[i])
        np.testing.assert_allclose(
            [leaf[i] for leaf in jax.tree.leaves(together)], jax.tree.leaves(alone), rtol=1e-6, atol=1e-7
        )


@pytest.mark.parametrize("policy", ["random", "thrown", "right", "left"])
def test_no_observation_of_an_episode_passes_the_bounds(robot: Robot, policy: str) -> None:
    observations, rewards, terminated = play(robot, policy, episodes=200, iterations=robot.episode_limit)
    ended_before = np.cumsum(terminated, axis=0) - terminated > 0
    in_episodes = observations[~ended_before]
    low, high = np.array([(q.low, q.high) for q in robot.observation_spec], np.float32).T
    assert np.all(in_episodes >= low) and np.all(in_episodes <= high)
    assert np.all(np.isfinite(in_episodes)) and np.all(np.isfinite(rewards[~ended_before]))


@pytest.mark.oracle
def test_the_episode_limit_is_never_a_termination(robot: Robot) -> None:
    """The same robot with a limit of one iteration steps as before: the program that counts applies the limit."""
    short = dataclasses.replace(robot, episode_limit=1)
    for policy in ("random", "right"):
        for a, b in zip(play(robot, policy, 20, 50), play(short, policy, 20, 50), strict=True):
            np.testing.assert_array_equal(a, b)


def test_robots_are_data(robot: Robot) -> None:
    data = json.loads(json.dumps(robot_to_dict(robot)))
    back = robot_from_dict(data)
    assert back == robot and hash(back) == hash(robot) and pickle.loads(pickle.dumps(robot)) == robot
    assert robot_named(robot.name, **data["parameters"]) == robot
    longer = robot_named(robot.name, **(data["parameters"] | {"episode_limit": robot.episode_limit + 1}))
    assert longer != robot
    assert set(data["parameters"]) == {field.name for field in dataclasses.fields(robot)}


def test_whole_numbers_from_json_are_the_same_robot() -> None:
    assert robot_named("navigation", arena_width_m=1, episode_limit=100.0) == Navigation()
    assert isinstance(robot_named("navigation", episode_limit=50.0).episode_limit, int)


def test_parameters_may_be_static_under_jit(robot: Robot) -> None:
    reset = jax.jit(lambda robot, key: robot.reset(key), static_argnums=0)
    assert reset(robot, jax.random.key(0)) == robot.reset(jax.random.key(0))


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        (
            "unicycle",
            {},
            "robot: expected one of arm, cartpole, detour, navigation, shuttle, swing-up, wheels, got 'unicycle'",
        ),
        (3, {}, "robot: expected one of"),
        ("cartpole", {"mass": 1.0}, "cartpole: expected parameters among gravity_m_per_s2, .*, got 'mass'"),
        ("cartpole", {"pole_mass_kg": 0.0}, "cartpole: pole_mass_kg: expected at least 1e-09, got 0"),
        ("cartpole", {"step_s": float("nan")}, "cartpole: step_s: expected a finite number"),
        ("cartpole", {"force_n": "1"}, "cartpole: force_n: expected a number, got '1'"),
        ("cartpole", {"episode_limit": 0}, "cartpole: episode_limit: expected at least 1"),
        ("cartpole", {"episode_limit": 1.5}, "cartpole: episode_limit: expected a whole number"),
        ("cartpole", {"episode_limit": True}, "cartpole: episode_limit: expected a whole number"),
        ("cartpole", {"force_n": None}, "cartpole: force_n: expected a number, got None"),
        ("navigation", {"turn_rad": 4.0}, "navigation: turn_rad: expected at most 3.14159"),
        ("navigation", {"goal_x_m": 1.2}, "navigation: goal_x_m: expected at most 1, got 1.2"),
        ("wheels", {"step_s": 1.0}, "wheels: step_s: expected at most 0.269 at this speed, got 1"),
    ],
)
def test_bad_parameters_are_refused_with_what_was_expected(name, parameters, message) -> None:
    with pytest.raises(InvalidArgument, match=message):
        robot_named(name, **parameters)


@pytest.mark.parametrize("data", [{}, {"name": "cartpole"}, {"name": "cartpole", "parameters": 3}, None, "cartpole"])
def test_data_of_another_form_are_refused(data: object) -> None:
    with pytest.raises(InvalidArgument, match="robot: expected"):
        robot_from_dict(data)  # type: ignore[arg-type]


@pytest.mark.oracle
@pytest.mark.parametrize(
    "robot",
    [
        Cartpole(episode_limit=12),
        Navigation(episode_limit=40),
        Cartpole(reward_upright=-1, episode_limit=12),
        SwingUp(episode_limit=40, upright_rad=2.8),
        TwoLinkArm(episode_limit=40),
        Wheels(episode_limit=40),
        Wheels(episode_limit=40, reward_bump=1.0, reward_goal=-3.0),
    ],
)
def test_no_return_is_outside_of_its_range(robot: Robot) -> None:
    low, high = robot.return_range
    seeds = np.arange(60)
    keys = jax.vmap(jax.random.key)(seeds)
    state, total, going = jax.vmap(robot.reset)(keys), np.zeros(60), np.ones(60, bool)
    step = jax.jit(jax.vmap(lambda key, n, state, u: robot.step(jax.random.fold_in(key, n), state, u), (0, None, 0, 0)))
    for iteration in range(min(robot.episode_limit, 40)):
        u = commands_of(robot, np.where(seeds % 3 == 0, 1.0, np.sin(seeds * iteration)))
        state, reward, terminated = step(keys, iteration, state, u)
        total += np.where(going, reward, 0.0)
        going &= ~np.asarray(terminated)
    assert np.all((low - 1e-4 <= total) & (total <= high + 1e-4))
