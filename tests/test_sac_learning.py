"""Soft Actor-Critic's loop: what is remembered, what the critics converge to, what is learned."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import PRNGKeyArray
from scipy.optimize import brentq

from animat.coding.mapping import mapping_named
from animat.environment import Animat, Environment, WithoutNeurons
from animat.neurons.simulator import NeuronSimulator
from animat.neurons.synthetic import synthetic_simulator
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation
from animat.training.networks import Network, forward
from animat.training.replay import Batch
from animat.training.sac import (
    Finished,
    Learner,
    Parameters,
    begin,
    continuous_losses,
    discrete_losses,
    draw_action,
    train_chunk,
)
from animat.training.settings import SAC
from animat.wrappers import EpisodeLimit
from sac_toys import Follower, FollowerOfTwo, Payer

SMALL = SAC(environments=2, gradient_steps=2, batch=8, replay=10, hidden=8)
DISCRETE = (-1.0, 1.0)

compiled_begin = jax.jit(begin, static_argnums=(0, 1))
compiled_chunk = jax.jit(train_chunk, static_argnums=(0, 1))


def start(environment: Environment[Any], settings: SAC, key: PRNGKeyArray | None = None) -> Learner:
    key = jax.random.key(0) if key is None else key
    learner: Learner = compiled_begin(EpisodeLimit(environment), settings, key)
    return learner


def explored(learner: Learner) -> Learner:
    """Where the policy alone is known to do better: no actions are held, and entropy is paid for."""
    known = learner.exploration._replace(episodes=jnp.ones(2), returns=jnp.array([1e9, 0.0]))
    return learner._replace(exploration=known)


def chunk(
    environment: Environment[Any],
    settings: SAC,
    learner: Learner,
    simulator: NeuronSimulator | None,
    first_round: int,
    last_round: int,
) -> tuple[Learner, Finished]:
    rounds = jnp.int32(first_round), jnp.int32(last_round)
    trained: tuple[Learner, Finished] = compiled_chunk(EpisodeLimit(environment), settings, learner, simulator, *rounds)
    return trained


def trained_for(
    environment: Environment[Any],
    settings: SAC,
    rounds: int,
    *,
    seed: int = 0,
    simulator: NeuronSimulator | None = None,
    learner: Learner | None = None,
) -> tuple[Learner, Finished]:
    learner = start(environment, settings, jax.random.key(seed)) if learner is None else learner
    return chunk(environment, settings, learner, simulator, 0, rounds)


# --- the replay -----------------------------------------------------------------------------------------------------


@pytest.mark.oracle
@pytest.mark.parametrize("rounds", [1, 4, 5, 7, 13])
def test_the_replay_holds_the_newest_rounds_each_in_its_place(rounds: int) -> None:
    limit = 3  # no divisor of the five rounds that the replay holds, so a row shows which round it is from
    environment = WithoutNeurons(Payer(pay=7.0, shows_iteration=True, episode_limit=limit), DISCRETE)
    learner, finished = trained_for(environment, SMALL, rounds, learner=explored(start(environment, SMALL)))
    expected_rows = np.full((5, 2, 7), np.nan)
    for index in range(rounds):
        counted = index % limit
        # scaled by 1/2, then the time left; the next state is the one before the reset, at the time limit too
        expected_rows[index % 5, :, :4] = counted / 2, 1 - 2 * counted / 3, (counted + 1) / 2, 1 - 2 * (counted + 1) / 3
        expected_rows[index % 5, :, 6] = counted + 1 == limit
    rows = np.asarray(learner.replay).reshape(5, 2, 7)
    written = ~np.isnan(expected_rows[:, :, 0])
    of_states = [0, 1, 2, 3, 6]
    np.testing.assert_allclose(rows[written][:, of_states], expected_rows[written][:, of_states], atol=1e-6)
    np.testing.assert_allclose(
        rows[written][:, 5], SMALL.reward_scale * 7.0 * np.array(DISCRETE)[rows[written][:, 4].astype(int)], rtol=1e-6
    )
    assert not rows[~written].any()
    assert float(finished.episodes) == 2 * (rounds // limit)


@pytest.mark.oracle
def test_terminations_are_remembered_and_episodes_start_anew() -> None:
    environment = WithoutNeurons(Payer(ends=True, shows_iteration=True), DISCRETE)
    rows = np.asarray(trained_for(environment, SMALL, 5)[0].replay)
    np.testing.assert_array_equal(rows[:, [0, 2, 6]], np.tile([0.0, 0.5, 1.0], (10, 1)))


def test_returns_are_counted_in_the_tasks_own_units() -> None:
    environment = WithoutNeurons(Payer(pay=5.0, episode_limit=4), (1.0, 1.0))
    learner, finished = trained_for(environment, SMALL, 11)
    assert (float(finished.episodes), float(finished.returns)) == (4, 4 * 4 * 5.0)
    np.testing.assert_array_equal(learner.returns, [15.0, 15.0])


@pytest.mark.oracle
def test_only_what_was_written_is_learned_from() -> None:
    settings = SAC(environments=2, gradient_steps=4, batch=64, replay=2000, hidden=8)
    environment = WithoutNeurons(Cartpole(), DISCRETE)
    learner = start(environment, settings, jax.random.key(0))
    poisoned = learner._replace(replay=jnp.full_like(learner.replay, jnp.nan))
    clean, _ = trained_for(environment, settings, 40, learner=learner)
    learner, _ = trained_for(environment, settings, 40, learner=poisoned)
    for leaf, other in zip(jax.tree.leaves(learner.trained), jax.tree.leaves(clean.trained), strict=True):
        np.testing.assert_array_equal(leaf, other)


# --- one update -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("commands", [DISCRETE, pytest.param(None, marks=pytest.mark.oracle)])
def test_one_update_is_one_step_of_adam_and_the_targets_follow(commands: tuple[float, ...] | None) -> None:
    # One transition remembered, so the batch is known: that row, over and over. One environment holds no actions, so
    # the entropy counts.
    settings = SAC(environments=1, gradient_steps=1, batch=4, replay=10, hidden=8, tau=0.25, learning_rate=0.01)
    environment = WithoutNeurons(Cartpole(), commands)
    before = start(environment, settings, jax.random.key(3))
    after, _ = trained_for(environment, settings, 1, learner=before)
    n = len(environment.observation_spec) + 1
    rows = jnp.tile(after.replay[:1], (4, 1))
    action = rows[:, 2 * n] if commands is not None else rows[:, 2 * n : 2 * n + 1]
    batch = Batch(rows[:, :n], rows[:, n : 2 * n], action, rows[:, 2 * n + 1], rows[:, 2 * n + 2])

    def loss(trained: Parameters) -> jax.Array:
        if commands is not None:
            return sum(discrete_losses(trained, before.targets, batch, settings, 1.0), jnp.float32(0))
        # The noise of the update is drawn inside; the critics' output at the start hardly depends on it.
        return sum(
            continuous_losses(trained, before.targets, batch, jnp.full((2, 4, 1), 0.5), settings, 1.0), jnp.float32(0)
        )

    gradient = jax.jit(jax.grad(loss))(before.trained)
    parts = ("actor", "critics", "log_alpha") if commands is not None else ("log_alpha",)
    for name in parts:
        of_parts = (getattr(tree, name) for tree in (before.trained, after.trained, gradient))
        for old, new, slope in zip(*(map(np.asarray, jax.tree.leaves(part)) for part in of_parts), strict=True):
            # Adam's first step: mean and root of the mean square are the gradient and its size.
            step = -0.01 * slope / (np.abs(slope) + 1e-5)
            clear = np.abs(slope) > 1e-6
            np.testing.assert_allclose(np.where(clear, new - old, 0), np.where(clear, step, 0), atol=2e-5, err_msg=name)
    of_critics = map(jax.tree.leaves, (before.targets, after.targets, after.trained.critics))
    for old, target, critic in zip(*(map(np.asarray, leaves) for leaves in of_critics), strict=True):
        np.testing.assert_allclose(target, 0.75 * old + 0.25 * critic, rtol=1e-5, atol=1e-7)


# --- what it converges to -------------------------------------------------------------------------------------------

CLOSED_FORM = SAC(
    environments=4, gradient_steps=4, batch=32, replay=1024, hidden=16, learning_rate=3e-3, discount=0.6, tau=0.05,
    reward_scale=0.5, target_entropy_ratio=0.5,
)  # fmt: skip


def soft_solution(pay: float) -> tuple[float, float, float]:
    """(alpha, probability of +1, value) of one state with rewards -pay and +pay, at the wanted entropy.

    Critics differ by their rewards alone, so pi = softmax(rewards / alpha), alpha such that H(pi) is what is wanted,
    and V = sum pi r + alpha H(pi) + discount V.
    """
    wanted = CLOSED_FORM.target_entropy_ratio * math.log(2)
    p = brentq(lambda p: -p * math.log(p) - (1 - p) * math.log(1 - p) - wanted, 0.5, 1 - 1e-9)
    alpha = 2 * pay / math.log(p / (1 - p))
    return alpha, p, ((2 * p - 1) * pay + alpha * wanted) / (1 - CLOSED_FORM.discount)


@pytest.mark.oracle
@pytest.mark.parametrize(("limit", "ends"), [(1, False), (3, False), (10**9, False), (10**9, True)])
def test_critics_converge_to_the_closed_form(limit: int, ends: bool) -> None:
    """One state, two actions: what is ahead ends with the episode, and critics know how much of it is left."""
    robot = Payer(pay=0.8, ends=ends, episode_limit=limit)
    environment = WithoutNeurons(robot, DISCRETE)
    learner, _ = trained_for(environment, CLOSED_FORM, 3000, learner=explored(start(environment, CLOSED_FORM)))
    pay = CLOSED_FORM.reward_scale * robot.pay
    alpha, p, value = soft_solution(pay)
    observation = jnp.ones((1, 1))
    for iteration in range(min(limit, 3)):
        # V_n = V (1 - discount^n), with n iterations to come after this one.
        ahead = 0.0 if ends else CLOSED_FORM.discount * value * (1 - CLOSED_FORM.discount ** (limit - iteration - 1))
        state = jnp.array([[1.0, 1.0 - 2.0 * iteration / limit]])
        q = np.asarray(forward(learner.trained.critics, state))[:, 0]
        np.testing.assert_allclose(q, np.tile([ahead - pay, ahead + pay], (2, 1)), atol=0.02)
    assert float(jnp.exp(learner.trained.log_alpha)) == pytest.approx(alpha, rel=0.06)
    policy = jax.nn.softmax(forward(learner.trained.actor, observation))[0]
    assert float(policy[1]) == pytest.approx(p, abs=0.02)


# --- what it learns -------------------------------------------------------------------------------------------------


TRIVIAL = SAC(
    environments=8, gradient_steps=4, batch=64, replay=8192, hidden=32, learning_rate=1e-3, discount=0.5,
    reward_scale=1.0, entropy_nats=-2.0,
)  # fmt: skip


@pytest.mark.parametrize("commands", [(-0.8, 0.0, 0.8), pytest.param(None, marks=pytest.mark.oracle)])
def test_a_trivial_task_is_learned(commands: tuple[float, ...] | None) -> None:
    environment = WithoutNeurons(Follower(), commands)
    learner, _ = trained_for(environment, TRIVIAL, 1500)
    wanted = jnp.array([[-0.75], [0.0], [0.75]]).repeat(400, axis=0)
    uniforms = jax.random.uniform(jax.random.key(9), (len(wanted), 1))
    action = draw_action(environment, learner.trained.actor, wanted, uniforms)
    command = np.asarray(action if commands is None else jnp.array(commands)[action])
    mistake = np.abs(command - np.asarray(wanted)[:, 0])
    # Acting at random misses by 0.7 on average; what is left is the entropy that the policy has as its target.
    assert mistake.mean() < 0.15


@pytest.mark.oracle
def test_two_commands_each_follow_their_own() -> None:
    environment = WithoutNeurons(FollowerOfTwo(), None)
    learner, _ = trained_for(environment, replace(TRIVIAL, reward_scale=2.0), 1500)
    wanted = jnp.array([[-0.75, 0.75], [0.0, -0.5], [0.75, 0.25]]).repeat(400, axis=0)
    uniforms = jax.random.uniform(jax.random.key(9), wanted.shape)
    mistake = np.abs(np.asarray(draw_action(environment, learner.trained.actor, wanted, uniforms) - wanted))
    # As for one command; acting at random misses by 0.7 on average.
    assert mistake.mean(axis=0).max() < 0.15


@pytest.mark.oracle
def test_most_hidden_units_outlive_a_start_that_finds_nothing() -> None:
    """Where gradients are all but 0, steps of their noise put units out: two of three with Adam's usual epsilon."""
    simulator = synthetic_simulator()
    environment = Animat(Navigation(), mapping_named("1-threshold"), simulator.n_conditions)
    settings = SAC(replay=16_384)
    keys = jax.random.split(jax.random.key(1), 8)
    learners = jax.jit(jax.vmap(partial(begin, EpisodeLimit(environment), settings)))(keys)
    run = jax.jit(jax.vmap(partial(train_chunk, EpisodeLimit(environment), settings), in_axes=(0, None, None, None)))
    learners, _ = run(learners, simulator, jnp.int32(0), jnp.int32(400))

    def alive(actor: Network, replay: jax.Array) -> jax.Array:
        hidden = replay[:8_000, : len(environment.observation_spec)]
        for layer in actor[:-1]:
            hidden = jax.nn.relu(hidden @ layer.weight + layer.bias)
        return jnp.mean(jnp.any(hidden > 0, axis=0))

    assert float(jnp.mean(jax.vmap(alive)(learners.trained.actor, learners.replay))) > 0.5


# --- side by side, piece by piece -----------------------------------------------------------------------------------


def animat() -> tuple[Environment[Any], NeuronSimulator]:
    simulator = synthetic_simulator()
    return Animat(Cartpole(), mapping_named("9-thresholds"), simulator.n_conditions), simulator


@pytest.mark.oracle
def test_policies_side_by_side_are_what_they_are_alone() -> None:
    environment, simulator = animat()
    keys = jax.random.split(jax.random.key(5), 3)
    together = jax.jit(jax.vmap(partial(train_chunk, EpisodeLimit(environment), SMALL), in_axes=(0, None, None, None)))(
        jax.jit(jax.vmap(partial(begin, EpisodeLimit(environment), SMALL)))(keys),
        simulator,
        jnp.int32(0),
        jnp.int32(30),
    )
    for i, key in enumerate(keys):
        learner = start(environment, SMALL, key)
        alone = trained_for(environment, SMALL, 30, simulator=simulator, learner=learner)
        of_both = (jax.tree.leaves(jax.tree.map(lambda leaf, i=i: leaf[i], together)), jax.tree.leaves(alone))
        for leaf, other in zip(*of_both, strict=True):
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf, other = jax.random.key_data(leaf), jax.random.key_data(other)
            np.testing.assert_allclose(leaf, other, rtol=1e-3, atol=1e-4)


def test_policies_of_different_keys_differ() -> None:
    environment, simulator = animat()
    first, second = (trained_for(environment, SMALL, 3, seed=seed, simulator=simulator)[0] for seed in (0, 1))
    assert not np.array_equal(first.trained.actor[0].weight, second.trained.actor[0].weight)
    assert not np.array_equal(first.replay, second.replay)


def test_chunks_of_any_size_end_in_the_same_bits() -> None:
    environment, simulator = animat()
    whole, of_whole = trained_for(environment, SMALL, 40, seed=6, simulator=simulator)
    pieces, episodes = start(environment, SMALL, jax.random.key(6)), 0.0
    for first, last in ((0, 7), (7, 7), (7, 33), (33, 40)):
        pieces, finished = chunk(environment, SMALL, pieces, simulator, first, last)
        episodes += float(finished.episodes)
    for leaf, other in zip(*map(jax.tree.leaves, (whole, pieces)), strict=True):
        assert jnp.array_equal(leaf, other)
    assert episodes == float(of_whole.episodes)


def test_another_simulator_is_data_and_compiles_nothing() -> None:
    environment, simulator = animat()
    learner, _ = trained_for(environment, SMALL, 2, seed=7, simulator=simulator)
    compiled = compiled_chunk._cache_size()  # type: ignore[attr-defined]
    other = synthetic_simulator((50, 40, 30, 20, 10))
    chunk(environment, SMALL, learner, other, 2, 3)
    assert compiled_chunk._cache_size() == compiled  # type: ignore[attr-defined]
