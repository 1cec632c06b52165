"""Actions that are held: for how long, where, and until when."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.coding.mapping import mapping_named
from animat.environment import Animat, WithoutNeurons
from animat.evaluation.table import evaluate
from animat.execution.training import train
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import SimulatorTimeline
from animat.responses.condition import Condition
from animat.robots import SwingUp, robot_named
from animat.stimulation.protocol import Presentation
from animat.training.exploration import Exploration, count_ended, explore, is_useful, n_uniforms, nothing_held
from animat.training.specification import Training

ENVIRONMENT = Animat(SwingUp(), mapping_named("9-thresholds"), 5)
NOT_ENDED = jnp.zeros(64, bool)

compiled_explore = jax.jit(explore, static_argnums=0)
compiled_count_ended = jax.jit(count_ended)


def history(
    n: int, iterations: int, environment: Animat | WithoutNeurons = ENVIRONMENT
) -> tuple[np.ndarray, Exploration]:
    """The actions of `iterations` in `n` environments whose policy always draws 7, or 7 of every command."""
    policy = jnp.full(n, 7) if environment.n_actions else jnp.full((n, environment.n_drawn), 7.0)

    def iteration(exploration: Exploration, key: jax.Array) -> tuple[Exploration, jax.Array]:
        uniforms = jax.random.uniform(key, (n, n_uniforms(environment)))
        taken, exploration = explore(environment, exploration, policy, uniforms)
        return exploration, taken

    keys = jax.random.split(jax.random.key(1), iterations)
    exploration, taken = jax.lax.scan(iteration, nothing_held(n, environment.n_drawn), keys)
    return np.asarray(taken), exploration


def test_a_random_action_is_held_for_a_while_in_the_second_half_of_the_environments() -> None:
    taken, exploration = history(9, 2_000)
    assert (taken[:, :5] == 7).all()
    assert np.asarray(exploration.was_held).tolist() == 5 * [False] + 4 * [True]
    held = taken[:, 5:]
    assert set(np.unique(held)) == {0, 1, 2, 3, 4, 7}
    shares = [float((held == action).mean()) for action in range(5)]
    assert shares == pytest.approx(5 * [np.mean(shares)], rel=0.2)


def test_lengths_of_every_order_are_equally_likely() -> None:
    """Of 64 environments one action each: held for k iterations or more with a chance of 1 - ln k / ln 50."""
    n, longest = 20_000, 50
    uniforms = jax.random.uniform(jax.random.key(2), (n, 3)).at[:, 0].set(0.0)
    _, exploration = compiled_explore(ENVIRONMENT, nothing_held(n, 1), jnp.full(n, 7), uniforms)
    lengths = np.asarray(exploration.left)[n // 2 :] + 1
    assert lengths.min() == 1
    assert lengths.max() == longest - 1
    for k in (2, 5, 10, 20, 40):
        expected = 1 - math.log(k) / math.log(longest)
        assert (lengths >= k).mean() == pytest.approx(expected, abs=4 * math.sqrt(0.25 / lengths.size))


def test_a_held_action_stays_the_same_for_its_length_and_ends_with_its_episode() -> None:
    n = 64
    begin = jnp.tile(jnp.array([0.0, 0.9, 0.5]), (n, 1))
    never = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (n, 1))
    policy = jnp.full(n, 7)
    length = math.floor(50**0.9)
    taken, exploration = compiled_explore(ENVIRONMENT, nothing_held(n, 1), policy, begin)
    for _ in range(length - 1):
        assert np.asarray(taken)[n // 2 :].tolist() == (n // 2) * [2]
        exploration = compiled_count_ended(exploration, NOT_ENDED, jnp.zeros(n))
        # What would begin another one changes nothing while one is held.
        taken, exploration = compiled_explore(ENVIRONMENT, exploration, policy, never)
    assert np.asarray(taken)[n // 2 :].tolist() == (n // 2) * [2]
    taken, exploration = compiled_explore(ENVIRONMENT, exploration, policy, never)
    assert (np.asarray(taken) == 7).all()

    _, exploration = compiled_explore(ENVIRONMENT, nothing_held(n, 1), policy, begin)
    exploration = compiled_count_ended(exploration, ~NOT_ENDED, jnp.zeros(n))
    assert not np.asarray(exploration.was_held).any()
    taken, _ = compiled_explore(ENVIRONMENT, exploration, policy, never)
    assert (np.asarray(taken) == 7).all()


def test_several_continuous_commands_are_held_together() -> None:
    environment = WithoutNeurons(robot_named("wheels"), None)
    taken, _ = history(8, 500, environment)
    assert taken.shape == (500, 8, 2)
    held = taken[:, 4:].reshape(-1, 2)
    held = held[held[:, 0] != 7]
    assert (np.abs(held) <= 1).all()
    assert abs(np.corrcoef(held.T)[0, 1]) < 0.3


def test_one_environment_is_the_policys() -> None:
    taken, _ = history(1, 200)
    assert (taken == 7).all()


def test_what_is_known_of_late_episodes_is_their_weighted_mean() -> None:
    """Against a loop that counts episode by episode, with one that ends a time."""
    rng = np.random.default_rng(3)
    exploration = nothing_held(4, 1)._replace(was_held=jnp.array([False, False, True, True]))
    weights: list[list[float]] = [[0.0, 0.0], [0.0, 0.0]]
    for _ in range(200):
        which, value = int(rng.integers(4)), float(rng.normal())
        returns = jnp.full(4, 1e6).at[which].set(value)
        after = compiled_count_ended(exploration, jnp.arange(4) == which, returns)
        exploration = after._replace(was_held=exploration.was_held)
        kind = weights[which // 2]
        kind[0], kind[1] = 0.98 * kind[0] + 1.0, 0.98 * kind[1] + value
    assert np.asarray(exploration.episodes) == pytest.approx([kind[0] for kind in weights], rel=1e-4)
    assert np.asarray(exploration.returns) == pytest.approx([kind[1] for kind in weights], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize(
    ("alone", "with_held", "expected"),
    [
        ((0, 0), (0, 0), True),
        ((5, 10), (0, 0), True),
        ((5, 0), (5, 0), True),
        ((5, 10), (5, 9), False),
        ((5, 8), (5, 9), True),
    ],
)
def test_actions_are_held_until_the_policy_alone_does_better(
    alone: tuple[float, float], with_held: tuple[float, float], expected: bool
) -> None:
    episodes, returns = zip(alone, with_held, strict=True)
    exploration = nothing_held(8, 1)._replace(episodes=jnp.array(episodes, float), returns=jnp.array(returns, float))
    assert bool(is_useful(exploration)) == expected
    # A single environment holds nothing that could be compared with.
    assert not is_useful(exploration._replace(left=exploration.left[:1]))
    uniforms = jnp.zeros((8, 3))
    taken, _ = jax.jit(partial(explore, ENVIRONMENT))(exploration, jnp.full(8, 7), uniforms)
    assert bool((np.asarray(taken) != 7).any()) == expected


@pytest.mark.long
def test_swing_up_is_learned_through_nine_thresholds() -> None:
    """To 0.85 of the optimal return (141.7, by dynamic programming) in 400,000 iterations, by each of four policies.

    Without held actions nine of ten saw no reward in 500,000.
    """
    simulator = synthetic_simulator((18.0, 26.0, 38.0, 52.0, 66.0), shape=10.0)
    timeline = SimulatorTimeline(
        simulators=jax.tree.map(lambda leaf: leaf[None], simulator),
        start_min=np.zeros(1),
        conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in (5.0, 10.0, 20.0, 40.0, 80.0)),
        window_ms=(2.0, 10.0),
        presentation=Presentation("mixed"),
        fidelities=(),
        findings=(),
    )
    training = Training(SwingUp(), "9-thresholds", policies=4, iterations=400_000, shadowing=False)
    rows = evaluate(train(training, timeline, None), timeline, episodes=1_000, controls=()).rows
    assert rows[0].mean_returns.min() > 120
    assert rows[0].mean_returns.max() < 143
