"""How a learner stands: entropy, alpha and critic loss, beside what is learned and without any influence on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file
from scipy.special import log_softmax, ndtri
from scipy.stats import norm

from animat.environment import Environment, WithoutNeurons
from animat.robots import Cartpole, Navigation
from animat.training.networks import Network
from animat.training.policy import CURVE, Policy
from animat.training.sac import Diagnosis, Learner, diagnose
from animat.training.specification import CHUNKS
from test_sac_learning import SMALL as TINY
from test_sac_learning import explored, start, trained_for
from test_training import SHORT, timeline_of, trained

compiled_diagnose = jax.jit(diagnose, static_argnums=(0, 1))


def through(network: Network, inputs: np.ndarray, critic: int | None = None) -> np.ndarray:
    """A network's outputs in float64; of critics, which are stacked, one's."""
    layers = [[np.asarray(part, np.float64) for part in layer] for layer in network]
    if critic is not None:
        layers = [[part[critic] for part in layer] for layer in layers]
    hidden = inputs
    for weight, bias in layers[:-1]:
        hidden = np.maximum(hidden @ weight + bias, 0)
    return hidden @ layers[-1][0] + layers[-1][1]


def rows_of(learner: Learner, available: int, numbers: np.ndarray) -> np.ndarray:
    return np.asarray(learner.replay, np.float64)[(numbers * np.float32(available)).astype(int)]


def drawn(environment: Environment[Any]) -> np.ndarray:
    return np.asarray(jax.random.uniform(jax.random.key(0), (1 + 2 * environment.n_drawn, 512)))


@pytest.mark.parametrize("paid", [True, False], ids=["entropy-is-paid-for", "nothing-pays-yet"])
def test_it_is_what_the_equations_say_of_discrete_actions(paid: bool) -> None:
    environment = WithoutNeurons(Cartpole(), (-1.0, 1.0))
    settings = replace(TINY, replay=200)
    learner, _ = trained_for(environment, settings, 80)
    learner = explored(learner) if paid else learner._replace(exploration=start(environment, settings).exploration)
    found = compiled_diagnose(environment, settings, learner, jnp.int32(160))
    rows, n = rows_of(learner, 160, drawn(environment)[0]), 5
    state, after, action, (reward, ended) = rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n].astype(int), rows[:, -2:].T
    log_pi = log_softmax(through(learner.trained.actor, state[:, :-1]), axis=1)
    alpha = np.exp(float(learner.trained.log_alpha))
    log_next = log_softmax(through(learner.trained.actor, after[:, :-1]), axis=1)
    next_q = np.minimum(*(through(learner.targets, after, critic) for critic in (0, 1)))
    value = (np.exp(log_next) * (next_q - paid * alpha * log_next)).sum(axis=1)
    target = reward + settings.discount * (1 - ended) * value
    q = [through(learner.trained.critics, state, critic)[np.arange(512), action] for critic in (0, 1)]
    loss = sum(0.5 * np.mean((each - target) ** 2) for each in q)
    assert found.entropy == pytest.approx(-(np.exp(log_pi) * log_pi).sum(axis=1).mean(), rel=1e-4)
    assert found.alpha == pytest.approx(alpha, rel=1e-6)
    assert found.critic_loss == pytest.approx(loss, rel=1e-3)


@pytest.mark.oracle
def test_it_is_what_the_equations_say_of_continuous_actions() -> None:
    environment = WithoutNeurons(Navigation(), None)
    settings = replace(TINY, replay=200)
    learner = explored(trained_for(environment, settings, 80)[0])
    found = compiled_diagnose(environment, settings, learner, jnp.int32(160))
    numbers, n = drawn(environment).astype(np.float64), len(environment.observation_spec) + 1
    rows = rows_of(learner, 160, drawn(environment)[0])
    state, after, action, (reward, ended) = rows[:, :n], rows[:, n : 2 * n], rows[:, [2 * n]], rows[:, -2:].T

    def act(observation: np.ndarray, uniforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, log_std = through(learner.trained.actor, observation).T
        log_std = np.clip(log_std, -5, 2)
        z = mean + np.exp(log_std) * ndtri(uniforms)
        return np.tanh(z)[:, None], norm.logpdf(z, mean, np.exp(log_std)) - np.log(1 - np.tanh(z) ** 2)

    def least(critics: Network, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return np.minimum(*(through(critics, np.hstack([state, action]), critic)[:, 0] for critic in (0, 1)))

    alpha = np.exp(float(learner.trained.log_alpha))
    next_action, log_next = act(after[:, :-1], numbers[1])
    target = reward + settings.discount * (1 - ended) * (least(learner.targets, after, next_action) - alpha * log_next)
    q = [through(learner.trained.critics, np.hstack([state, action]), critic)[:, 0] for critic in (0, 1)]
    assert found.entropy == pytest.approx(-act(state[:, :-1], numbers[2])[1].mean(), rel=1e-3)
    assert found.critic_loss == pytest.approx(sum(0.5 * np.mean((each - target) ** 2) for each in q), rel=1e-3)


def test_of_no_transitions_nothing_is_known() -> None:
    environment = WithoutNeurons(Cartpole(), (-1.0, 1.0))
    found = compiled_diagnose(environment, TINY, start(environment, TINY), jnp.int32(0))
    assert np.isnan(found).all()


def test_what_is_learned_does_not_depend_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = replace(SHORT, policies=1, iterations=2_000)
    with_it = trained(short, timeline_of(), tmp_path / "with")["p0"]
    none = Diagnosis(*np.full((3, 1), np.nan))
    monkeypatch.setattr("animat.training.group.diagnosis_program", lambda *_: lambda *_: none)
    without = trained(short, timeline_of(), tmp_path / "without")["p0"]
    for ours, theirs in zip((*with_it.weights, *with_it.biases), (*without.weights, *without.biases), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(with_it.learning_curve[:, :3], without.learning_curve[:, :3])
    assert np.isfinite(with_it.learning_curve[:, 3:]).all()
    assert np.isnan(without.learning_curve[:, 3:]).all()


def test_older_policies_are_read_without_it(tmp_path: Path) -> None:
    file = tmp_path / "p0.safetensors"
    policy = trained(replace(SHORT, policies=1, iterations=500), timeline_of(), tmp_path)["p0"]
    with safe_open(file, "numpy") as opened:
        arrays, metadata = {name: opened.get_tensor(name) for name in opened.keys()}, opened.metadata()  # noqa: SIM118
    arrays["learning_curve"] = np.ascontiguousarray(arrays["learning_curve"][:, :3])
    save_file(arrays, file, metadata)
    of_before = Policy.load(file)
    np.testing.assert_array_equal(of_before.learning_curve[:, :3], policy.learning_curve[:, :3])
    assert of_before.learning_curve.shape == (CHUNKS, len(CURVE))
    assert np.isnan(of_before.learning_curve[:, 3:]).all()


def test_before_training_actions_are_all_but_random_and_alpha_is_the_initial_one() -> None:
    environment = WithoutNeurons(Cartpole(), (-1.0, 1.0))
    first = compiled_diagnose(environment, TINY, start(environment, TINY), jnp.int32(1))
    assert first.entropy == pytest.approx(np.log(2), abs=0.01)
    assert first.alpha == pytest.approx(TINY.initial_alpha)
