"""Goal information: against closed forms, and its permutation null."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation import information
from animat.evaluation.information import conditional_information, goal_information
from animat.evaluation.rollouts import Actor
from animat.robots import Cartpole, Quantity, Robot


class Sensing(NamedTuple):
    sensed: jax.Array
    goal: jax.Array


@dataclass(frozen=True)
class Sensor(Robot[Sensing]):
    """Senses 0 or 1, drawn in each iteration; its goal is one of four, drawn at the start."""

    episode_limit: int = 5
    name = "sensor"
    noise_size = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("sensed", "1", 2.0), Quantity("goal", "1", 4.0, of_goal=True))

    def reset(self, key: Any) -> Sensing:
        one, other = jax.random.uniform(key, (2,))
        return Sensing(jnp.floor(2 * one), jnp.floor(4 * other))

    def advance(self, uniforms: Any, state: Sensing, u: Any) -> tuple[Sensing, Any, Any]:
        return Sensing(jnp.floor(2 * uniforms[0]), state.goal), jnp.float32(0.0), jnp.bool_(False)

    def observe(self, state: Sensing) -> Any:
        return jnp.stack(state)

    def with_goal_of(self, state: Sensing, other: Sensing) -> Sensing:
        return state._replace(goal=other.goal)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Choosing(Actor):
    """One of three actions, by its probability given the sensor and the goal: shape (actors, 2, 4, 3)."""

    probabilities: Any

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        sensed, goal = (observation * environment.scales).astype(jnp.int32).T
        below = jnp.cumsum(self.probabilities[sensed, goal], axis=-1)[:, :-1]
        return jnp.sum(uniforms >= below, axis=-1)


ENVIRONMENT = WithoutNeurons(Sensor(), (-1.0, 0.0, 1.0))


def closed_form(probabilities: np.ndarray) -> float:
    """For equally likely goals and sensor values, in bits."""
    joint = probabilities / 4
    mixture = probabilities.mean(axis=1, keepdims=True)
    terms = np.where(joint > 0, joint * np.log2(np.where(joint > 0, probabilities / mixture, 1.0)), 0.0)
    return float(terms.sum(axis=(1, 2)).mean())


def of_both(base: np.ndarray) -> np.ndarray:
    """The information is the same at both sensor values."""
    return np.stack([base, base[::-1]])


CASES = {
    "drawn": of_both(np.random.default_rng(3).dirichlet(np.full(3, 0.5), 4)),
    "blind": of_both(np.tile(np.array([0.2, 0.3, 0.5]), (4, 1))),
    "certain": of_both(np.eye(3)[[0, 1, 2, 2]]),
}


@pytest.mark.parametrize("case", CASES)
def test_the_information_of_drawn_actions_is_that_of_the_closed_form(case: str) -> None:
    rng, probabilities = np.random.default_rng(2), CASES[case][0]
    goals = rng.integers(4, size=(400, 63))
    below = np.cumsum(probabilities, axis=-1)[goals][..., None, :-1]
    actions = (rng.random((400, 63, 128, 1)) >= below).sum(axis=-1)
    assert conditional_information(actions, 3).mean() == pytest.approx(closed_form(CASES[case]), abs=0.01)


@pytest.mark.oracle
@pytest.mark.parametrize("case", CASES)
def test_the_information_of_a_constructed_policy_is_that_of_the_closed_form(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(information, "PERMUTATIONS", 99)
    # The goals of an actor's episodes are a sample of the four: more episodes than usual make it more even.
    monkeypatch.setattr(information, "EPISODES", 384)
    actors = Choosing(jnp.asarray(np.tile(CASES[case], (4, 1, 1, 1)), jnp.float32))
    found = goal_information(ENVIRONMENT, None, actors, draws=32)
    bits = found.bits
    assert bits.low - 0.01 < closed_form(CASES[case]) < bits.high + 0.01
    assert bits.value == pytest.approx(closed_form(CASES[case]), abs=0.01)
    assert found.most == pytest.approx(np.log2(3))
    assert (found.p > 0.01) == (case == "blind")


def test_few_draws_and_few_goals_are_corrected_for() -> None:
    """Infinitely many goals, half of which need each action: 1 bit for a certain policy, 0 for a blind one."""
    rng = np.random.default_rng(1)
    certain = np.repeat(rng.integers(2, size=(10_000, 10, 1)), 2, axis=2)
    assert conditional_information(certain, 2).mean() == pytest.approx(1.0, abs=0.01)
    blind = rng.integers(2, size=(2_000, 10, 32))
    assert conditional_information(blind, 2).mean() == pytest.approx(0.0, abs=0.01)


@pytest.mark.oracle
def test_the_permutation_null_holds_at_five_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(information, "PERMUTATIONS", 39)
    blind = Choosing(jnp.asarray(CASES["blind"][None], jnp.float32))
    p = np.array([goal_information(ENVIRONMENT, None, blind, draws=2, seed=seed).p for seed in range(200)])
    # 10 expected; 99.9 % of binomial counts lie between.
    assert 2 <= np.sum(p <= 0.05) <= 22
    assert abs(p.mean() - 0.5125) < 4 * 0.29 / np.sqrt(200)


def test_pairs_are_of_one_goal_and_ties_count_as_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    assert information._n_differing(np.array([[0, 1, 1, 1], [2, 2, 0, 1]])) == 2
    monkeypatch.setattr(information, "PERMUTATIONS", 19)
    # Of the same action everywhere, every permutation is as good as what was seen.
    constant = Choosing(jnp.asarray(of_both(np.tile(np.eye(3)[0], (4, 1)))[None], jnp.float32))
    assert goal_information(ENVIRONMENT, None, constant, draws=2).p == 1.0


def test_what_has_one_goal_or_continuous_actions_has_none() -> None:
    actors = Choosing(jnp.asarray(CASES["blind"][None], jnp.float32))
    with pytest.raises(InvalidArgument, match="cartpole has no method `with_goal_of`"):
        goal_information(WithoutNeurons(Cartpole(), (-1.0, 1.0)), None, actors)
    with pytest.raises(InvalidArgument, match="expected discrete actions"):
        goal_information(WithoutNeurons(Sensor(), None), None, actors)
