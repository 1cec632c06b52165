"""Soft Actor-Critic's parts: losses, gradients, actions; against a float64 reference, scipy and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

import sac_reference as reference
from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.robots.cartpole import Cartpole
from animat.robots.navigation import Navigation
from animat.training.networks import Layer, Network, draw_action, forward, squashed_normal
from animat.training.replay import Batch
from animat.training.sac import Parameters, continuous_losses, discrete_losses
from animat.training.settings import SAC
from two_wheels import Wheels

SETTINGS = SAC(discount=0.9, target_entropy_ratio=0.3, entropy_nats=-0.5)
N, HIDDEN, ACTIONS, SIZE = 3, 5, 4, 12
LOSSES = ("critics", "actor", "alpha")


def all_losses(trained: Parameters, targets: Network, batch: Batch, uniforms: jax.Array | None) -> jax.Array:
    if uniforms is None:
        return jnp.stack(discrete_losses(trained, targets, batch, SETTINGS))
    return jnp.stack(continuous_losses(trained, targets, batch, uniforms, SETTINGS))


compiled_losses = jax.jit(all_losses)
compiled_gradients = jax.jit(jax.jacrev(all_losses))
compiled_squashed_normal = jax.jit(squashed_normal)
compiled_draw_action = jax.jit(draw_action, static_argnums=0)


def reference_losses(trained: Parameters, targets: Network, batch: Batch, uniforms: jax.Array | None) -> np.ndarray:
    trained, targets, batch = reference.in_float64((trained, targets, batch))
    if uniforms is None:
        wanted = SETTINGS.target_entropy_ratio * math.log(ACTIONS)
        return np.array(
            reference.discrete_losses(trained, targets, batch, discount=SETTINGS.discount, entropy_wanted=wanted)
        )
    return np.array(
        reference.continuous_losses(
            trained,
            targets,
            batch,
            np.asarray(uniforms, np.float64),
            discount=SETTINGS.discount,
            entropy_wanted=SETTINGS.entropy_nats * uniforms.shape[-1],
        )
    )


def problem(seed: int, *, commands: int) -> tuple[Parameters, Network, Batch, jax.Array | None]:
    """Of so many continuous commands; 0: of discrete actions."""
    n_actions = None if commands else ACTIONS
    trained, targets = reference.drawn_networks(seed, N, HIDDEN, n_actions, commands)
    uniforms = None
    if commands:
        uniforms = jax.random.uniform(jax.random.key(seed), (2, SIZE, commands), minval=0.01, maxval=0.99)
    return trained, targets, reference.drawn_batch(seed, SIZE, N, n_actions, commands), uniforms


COMMANDS = (0, pytest.param(1, marks=pytest.mark.oracle), 2)
"""Actions; one command and two, which are one program for another width."""


@pytest.mark.parametrize("commands", COMMANDS)
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_losses_equal_a_float64_reference(commands: int, seed: int) -> None:
    given_ = problem(seed, commands=commands)
    np.testing.assert_allclose(compiled_losses(*given_), reference_losses(*given_), rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("commands", COMMANDS)
def test_each_loss_moves_its_own_parameters_only(commands: int) -> None:
    gradients: Trained = compiled_gradients(*problem(1, commands=commands))
    for i, loss in enumerate(LOSSES):
        for name, of_part in zip(("actor", "critics", "alpha"), gradients, strict=True):
            moved = any(np.any(np.asarray(leaf)[i] != 0) for leaf in jax.tree.leaves(of_part))
            assert moved == (name == loss), f"{loss} loss, parameters of {name}"


@pytest.mark.oracle
@pytest.mark.parametrize("commands", COMMANDS)
def test_gradients_equal_finite_differences_of_the_reference(commands: int) -> None:
    trained, targets, batch, uniforms = problem(2, commands=commands)
    gradients: Trained = compiled_gradients(trained, targets, batch, uniforms)
    parts = {"critics": ("critics", 0), "actor": ("actor", 1), "log_alpha": ("alpha", 2)}
    rng = np.random.default_rng(0)
    for name, (_, loss) in parts.items():
        leaves, structure = jax.tree.flatten(reference.in_float64(getattr(trained, name)))
        of_leaves = jax.tree.leaves(getattr(gradients, name))
        for which, leaf in enumerate(leaves):
            for place in rng.choice(leaf.size, min(leaf.size, 6), replace=False):
                ends = []
                for step in (1e-6, -1e-6):
                    moved = leaf.copy()
                    moved.flat[place] += step
                    others = [moved if i == which else other for i, other in enumerate(leaves)]
                    stepped = reference.in_float64(trained)._replace(**{name: jax.tree.unflatten(structure, others)})
                    # What a loss holds fixed (the target, the other parts) does not depend on its own parameters.
                    ends.append(reference_losses(stepped, targets, batch, uniforms)[loss])
                slope = (ends[0] - ends[1]) / 2e-6
                got = np.asarray(of_leaves[which])[loss].flat[place]
                np.testing.assert_allclose(got, slope, rtol=2e-3, atol=2e-3, err_msg=f"{name} leaf {which} at {place}")


def test_the_last_transitions_of_episodes_do_not_look_ahead() -> None:
    trained, targets, batch, _ = problem(3, commands=0)
    elsewhere = batch._replace(next_state=batch.next_state + 100.0)
    for ended, changes in ((1.0, False), (0.0, True)):
        losses = [
            compiled_losses(trained, targets, b._replace(ended=jnp.full(SIZE, ended)), None)[0]
            for b in (batch, elsewhere)
        ]
        assert (abs(losses[0] - losses[1]) > 1e-3) == changes


@pytest.mark.parametrize("size", [1e2, 1e4, 1e30])
def test_losses_and_gradients_stay_finite_for_huge_logits(size: float) -> None:
    trained, targets, batch, _ = problem(4, commands=0)
    last = trained.actor[-1]
    decided = Layer(last.weight, last.bias + jnp.array([size, -size, 0.0, -size]))
    trained = trained._replace(actor=(*trained.actor[:-1], decided))
    assert np.all(np.isfinite(compiled_losses(trained, targets, batch, None)))
    for leaf in jax.tree.leaves(compiled_gradients(trained, targets, batch, None)):
        assert np.all(np.isfinite(leaf))


@pytest.mark.parametrize("outputs", [(-40.0, 3.0), (40.0, -9.0), (0.0, 50.0), (1e4, 0.0)])
def test_continuous_losses_stay_finite_at_the_ends(outputs: tuple[float, float]) -> None:
    trained, targets, batch, _ = problem(5, commands=1)
    last = trained.actor[-1]
    extreme = Layer(jnp.zeros_like(last.weight), jnp.array([outputs]))
    trained = trained._replace(actor=(*trained.actor[:-1], extreme))
    uniforms = jnp.stack([jnp.zeros((SIZE, 1)), jnp.full((SIZE, 1), 1.0 - 2.0**-24)])
    assert np.all(np.isfinite(compiled_losses(trained, targets, batch, uniforms)))
    for leaf in jax.tree.leaves(compiled_gradients(trained, targets, batch, uniforms)):
        assert np.all(np.isfinite(leaf))


# --- actions --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.5), (-1.2, -0.3), (0.3, -3.0)])
def test_the_squashed_normals_density_integrates_to_one(mean: float, log_std: float) -> None:
    uniforms = jnp.linspace(1e-5, 1 - 1e-5, 200_001)
    outputs = jnp.tile(jnp.array([[mean, log_std]]), (len(uniforms), 1))
    action, log_p = compiled_squashed_normal(outputs, uniforms[:, None])
    area = integrate.trapezoid(np.exp(np.asarray(log_p, np.float64)), np.asarray(action[:, 0], np.float64))
    assert area == pytest.approx(1.0, abs=2e-3)


@given(
    mean=st.integers(-60, 60).map(lambda tenths: tenths / 10),
    log_std=st.integers(-80, 40).map(lambda tenths: tenths / 10),
    uniform=st.integers(1, 9_999).map(lambda ten_thousandths: ten_thousandths / 10_000),
)
@settings(max_examples=100, deadline=None)
def test_the_squashed_normal_is_scipys_change_of_variables(mean: float, log_std: float, uniform: float) -> None:
    action, log_p = compiled_squashed_normal(jnp.array([[mean, log_std]]), jnp.array([[uniform]]))
    kept = min(max(log_std, -5.0), 2.0)
    z = stats.norm.ppf(uniform, mean, math.exp(kept))
    assert float(action[0, 0]) == pytest.approx(math.tanh(z), abs=2e-4)
    assert float(log_p[0]) == pytest.approx(reference.log_density(z, mean, kept), rel=1e-3, abs=1e-3)


def constant_actor(outputs: list[float]) -> Network:
    """A network that answers the same to everything."""
    return (Layer(jnp.zeros((4, 2)), jnp.zeros((1, 2))), Layer(jnp.zeros((2, len(outputs))), jnp.array([outputs])))


def test_actions_are_drawn_as_often_as_softmax_says() -> None:
    logits = [0.3, -1.0, 2.0, 0.0, -3.0]
    environment = WithoutNeurons(Cartpole(), (-1.0, -0.5, 0.0, 0.5, 1.0))
    n = 200_000
    uniforms = jax.random.uniform(jax.random.key(11), (n, 1))
    drawn = np.asarray(compiled_draw_action(environment, constant_actor(logits), jnp.zeros((n, 4)), uniforms))
    expected = n * np.exp(logits) / np.exp(logits).sum()
    assert stats.chisquare(np.bincount(drawn, minlength=5), expected).pvalue > 1e-3


@pytest.mark.parametrize("logits", [[-200.0, 0.0, -200.0], [0.0, -200.0, 0.0], [0.0, 1e-3, -1e-3], [1e30, 0.0, -1e30]])
def test_actions_are_valid_and_possible_at_both_ends_of_the_uniforms(logits: list[float]) -> None:
    environment = WithoutNeurons(Cartpole(), (-1.0, 0.0, 1.0))
    uniforms = jnp.array([[0.0], [2.0**-24], [0.5], [1.0 - 2.0**-24]])
    drawn = np.asarray(compiled_draw_action(environment, constant_actor(logits), jnp.zeros((4, 4)), uniforms))
    possible = np.flatnonzero(np.array(logits) >= max(logits) - 100)
    assert set(drawn) <= set(possible)


def test_continuous_actions_follow_the_squashed_normal() -> None:
    environment = WithoutNeurons(Navigation(), None)
    n = len(environment.observation_spec)
    actor = (Layer(jnp.zeros((n, 2)), jnp.zeros((1, 2))), Layer(jnp.zeros((2, 2)), jnp.array([[0.4, -0.7]])))
    uniforms = jax.random.uniform(jax.random.key(12), (20_000, 1))
    drawn = np.asarray(compiled_draw_action(environment, actor, jnp.zeros((20_000, n)), uniforms), np.float64)
    assert np.all(np.abs(drawn) <= 1)
    assert stats.kstest(np.arctanh(drawn), stats.norm(0.4, math.exp(-0.7)).cdf).pvalue > 1e-3


def test_each_of_several_commands_follows_its_own_squashed_normal() -> None:
    environment = WithoutNeurons(Wheels(), None)
    n = len(environment.observation_spec)
    outputs = jnp.array([[0.4, -1.0, -0.7, 0.2]])  # two means, then two log deviations
    actor = (Layer(jnp.zeros((n, 2)), jnp.zeros((1, 2))), Layer(jnp.zeros((2, 4)), outputs))
    uniforms = jax.random.uniform(jax.random.key(13), (20_000, 2))
    drawn = np.asarray(compiled_draw_action(environment, actor, jnp.zeros((20_000, n)), uniforms), np.float64)
    assert drawn.shape == (20_000, 2)
    z = np.arctanh(drawn)
    assert stats.kstest(z[:, 0], stats.norm(0.4, math.exp(-0.7)).cdf).pvalue > 1e-3
    assert stats.kstest(z[:, 1], stats.norm(-1.0, math.exp(0.2)).cdf).pvalue > 1e-3
    assert abs(stats.pearsonr(*z.T).statistic) < 0.03


def test_a_stack_of_networks_is_each_of_them() -> None:
    trained, _ = reference.drawn_networks(6, N, HIDDEN, ACTIONS)
    inputs = jax.random.normal(jax.random.key(0), (7, N + 1))
    stacked = np.asarray(forward(trained.critics, inputs))
    critics = reference.in_float64(trained.critics)
    for which in (0, 1):
        rows = np.array([reference.outputs(critics, np.asarray(x, np.float64), which) for x in inputs])
        np.testing.assert_allclose(stacked[which], rows, rtol=1e-5, atol=1e-5)


# --- settings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["environments", "gradient_steps", "batch", "replay", "hidden"])
def test_settings_refuse_counts_below_one(name: str) -> None:
    with pytest.raises(InvalidArgument, match=f"^{name}: expected at least 1, got 0"):
        replace(SAC(), **{name: 0})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("learning_rate", "reward_scale", "initial_alpha") for value in (0.0, math.inf)],
        *[(name, value) for name in ("discount", "tau", "target_entropy_ratio") for value in (-0.1, 1.1)],
        ("entropy_nats", math.nan),
        ("learning_rate", math.nan),
        ("discount", math.nan),
    ],
)
def test_settings_refuse_rates_and_shares_that_cannot_be(name: str, value: float) -> None:
    with pytest.raises(InvalidArgument, match=f"^{name}: expected .+, got {value:g}"):
        replace(SAC(), **{name: value})


def test_settings_refuse_a_replay_that_would_split_a_round() -> None:
    with pytest.raises(InvalidArgument, match=r"^replay: expected a multiple of environments \(3\), got 10$"):
        SAC(environments=3, replay=10)
