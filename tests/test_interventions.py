"""Interventions: the known effect of each on a robot whose rewards are known, and the table of all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.coding.mapping import Linear, Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation.commands import mean_commands
from animat.evaluation.controls import interventions_of
from animat.evaluation.interventions import run_interventions
from animat.evaluation.rollouts import Actor, Networks, roll_out, trajectories
from animat.neurons.simulator import indifferent
from animat.neurons.synthetic import synthetic_simulator
from animat.robots import Cartpole, Quantity, Robot, Wheels
from animat.training.networks import Layer
from animat.wrappers import GoalSwitch, IdealActuator, ReversedMapping, ShuffledDelivery, YokedDelivery


class Aimed(NamedTuple):
    sensed: jax.Array
    goal: jax.Array


@dataclass(frozen=True)
class Aiming(Robot[Aimed]):
    """Senses a number that is drawn in each iteration; its goal is -1 or 1, and the reward goal x sensed x u."""

    episode_limit: int = 10
    name = "aiming"
    noise_size = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("sensed", "1", 1.0), Quantity("goal", "1", 1.0, of_goal=True))

    def reset(self, key: Any) -> Aimed:
        one, other = jax.random.uniform(key, (2,))
        return Aimed(jnp.sign(one - 0.5), jnp.sign(other - 0.5))

    def advance(self, uniforms: Any, state: Aimed, u: Any) -> tuple[Aimed, Any, Any]:
        sensed = jnp.sign(uniforms[0] - 0.5)
        return Aimed(sensed, state.goal), (state.goal * state.sensed * u).astype(jnp.float32), jnp.bool_(False)

    def observe(self, state: Aimed) -> Any:
        return jnp.stack(state)

    def with_goal_of(self, state: Aimed, other: Aimed) -> Aimed:
        return state._replace(goal=other.goal)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Best(Actor):
    """The last condition where goal and sensor agree, the first where they do not."""

    number: Any

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return jnp.where(observation[:, 0] * observation[:, 1] > 0, environment.n_actions - 1, 0)


SIMULATOR = synthetic_simulator()
ENVIRONMENT = Animat(Aiming(), Thresholds(1), 5)
BEST = Best(jnp.zeros(1))


def episodes_of(environment: Any, simulator: Any = SIMULATOR, actor: Actor = BEST) -> np.ndarray:
    return roll_out(environment, simulator, actor, episodes=2000, seed=5).returns[0]


@dataclass(frozen=True)
class Delayed(Animat[Any]):
    delay: int = 2


def test_each_intervention_changes_one_thing_also_in_an_environment_with_more_attributes() -> None:
    own = Delayed(ENVIRONMENT.robot, ENVIRONMENT.mapping, ENVIRONMENT.n_conditions)
    found = {}
    for each in interventions_of(own, SIMULATOR, BEST, switch_at=4):  # type: ignore[arg-type]
        environment, simulator = each.within(own, SIMULATOR)
        assert environment.n_actions == own.n_actions
        # Four even draws for each of five conditions: the same four, or silence.
        answered = np.unique(simulator.evenly_drawn(4)) if simulator is not SIMULATOR else []
        found[each.name] = type(environment), len(answered)
    assert found == {
        "ideal actuator": (IdealActuator, 0), "random spikes": (Delayed, 4), "silent": (Delayed, 1),
        "shuffled": (ShuffledDelivery, 0), "yoked": (YokedDelivery, 0), "turned round": (ReversedMapping, 0),
        "goal switched": (GoalSwitch, 0),
    }  # fmt: skip
    assert "goal switched" not in {each.name for each in interventions_of(own, SIMULATOR, BEST)}  # type: ignore[arg-type]


@pytest.mark.parametrize("simulator", [SIMULATOR, indifferent(SIMULATOR)])
def test_an_ideal_actuator_stretches_mean_commands_to_the_full_range(simulator: Any) -> None:
    means = mean_commands(ENVIRONMENT, simulator)[1]
    low, high = means.min(), means.max()
    wanted = np.interp(means, [low, high], [-1, 1]) if high > low else np.zeros(5)
    # Shuffled delivery changes which condition is presented, and not what an ideal actuator makes of it.
    for environment in (ENVIRONMENT, ShuffledDelivery(ENVIRONMENT)):
        ideal = interventions_of(environment, simulator, BEST)[0]  # type: ignore[arg-type]
        np.testing.assert_allclose(ideal.commands, wanted, atol=1e-12)


@pytest.mark.oracle
def test_each_intervention_does_what_it_says() -> None:
    usual = episodes_of(ENVIRONMENT)
    found = {each.name: each for each in interventions_of(ENVIRONMENT, SIMULATOR, BEST, switch_at=4)}  # type: ignore[arg-type]
    returns = {name: episodes_of(*each.within(ENVIRONMENT, SIMULATOR)) for name, each in found.items()}
    assert [*found] == [
        "ideal actuator", "random spikes", "silent", "shuffled", "yoked", "turned round", "goal switched"
    ]  # fmt: skip
    _, means = mean_commands(ENVIRONMENT, SIMULATOR)
    assert abs(usual.mean() - 10 * (means[-1] - means[0]) / 2) < 4 * usual.std() / np.sqrt(2000)
    np.testing.assert_array_equal(returns["ideal actuator"], 10.0)
    np.testing.assert_array_equal(returns["turned round"], -usual)
    # Without a link between choice and command, the goal is met half of the time.
    for name in ("random spikes", "silent", "shuffled", "yoked"):
        assert abs(returns[name].mean()) < 4 * returns[name].std() / np.sqrt(2000), name
    # A policy that knows the goal is not affected by a switch.
    assert abs(returns["goal switched"].mean() - usual.mean()) < 6 * usual.std() / np.sqrt(2000)


def test_random_spikes_have_the_rates_of_the_culture_and_do_not_depend_on_stimuli() -> None:
    spikes = indifferent(SIMULATOR)
    uniforms = (jnp.arange(4096) + 0.5) / 4096
    conditions = jnp.arange(SIMULATOR.n_conditions)
    own, of_all = (
        np.asarray(jax.jit(jax.vmap(jax.vmap(each.quantile, (None, 0)), (0, None)))(conditions, uniforms))
        for each in (SIMULATOR, spikes)
    )
    np.testing.assert_array_equal(of_all, of_all[:1].repeat(len(of_all), axis=0))
    shares = np.linspace(0.05, 0.95, 19)
    np.testing.assert_allclose(np.quantile(of_all, shares), np.quantile(own, shares), rtol=0.01)


def test_yoked_stimuli_are_those_of_the_episode_that_is_observed() -> None:
    yoked = YokedDelivery(Animat(Aiming(), Linear(), 5))
    traced = trajectories(yoked, SIMULATOR, BEST, episodes=50, seed=2)
    other = traced.states.info["other_episode"].robot
    agree = np.asarray(other.goal * other.sensed)[:, :, :-1] > 0
    np.testing.assert_array_equal(traced.actions == 4, agree)
    # The two episodes are independent.
    here = np.asarray(traced.states.robot.goal * traced.states.robot.sensed)[:, :, :-1] > 0
    assert 0.4 < (here == agree).mean() < 0.6
    assert 0.2 < (other.goal[..., 0] == traced.states.robot.goal[..., 0]).mean() < 0.8


@pytest.mark.oracle
def test_the_goal_is_switched_once_and_nothing_else() -> None:
    plain = Animat(Wheels(), Thresholds(1), 5)
    body, other = (Wheels().reset(jax.random.key(i)) for i in (1, 2))
    switched = Wheels().with_goal_of(body, other)
    assert switched[:3] == body[:3] and switched[3:] == other[3:]
    assert plain.robot == GoalSwitch(plain, 3).robot
    environment = GoalSwitch(ENVIRONMENT, 3)
    once, usual = (trajectories(each, SIMULATOR, BEST, episodes=40, seed=3) for each in (environment, ENVIRONMENT))
    goals, sensed = (np.asarray(each) for each in (once.states.robot.goal, once.states.robot.sensed))
    np.testing.assert_array_equal(sensed, usual.states.robot.sensed)
    np.testing.assert_array_equal(goals[..., :3], np.asarray(usual.states.robot.goal)[..., :3])
    np.testing.assert_array_equal(goals[..., 3:], goals[..., 3:4].repeat(8, axis=2))
    changed = goals[..., 3] != goals[..., 2]
    assert changed.all()
    # A policy that knows the goal changes its choice at the first action after the switch.
    differs = once.actions != usual.actions
    np.testing.assert_array_equal(differs[..., :3], False)
    np.testing.assert_array_equal(differs[..., 3], changed)
    with pytest.raises(InvalidArgument, match="cartpole has no method `with_goal_of`"):
        GoalSwitch(Animat(Cartpole(), Thresholds(1), 5), 3)


def linear_networks(*weights: np.ndarray) -> Networks:
    """Policies of one layer, without a bias."""
    stacked = np.stack(weights).astype(np.float32)
    layer = Layer(jnp.asarray(stacked), jnp.zeros((len(weights), 1, stacked.shape[2])))
    return Networks((layer,), jnp.ones((len(weights), stacked.shape[1])), greedy=True)


@pytest.mark.oracle
def test_the_table_distinguishes_a_policy_that_knows_its_goal_from_one_that_does_not() -> None:
    towards = np.array([[0.0] * 5, [-1.0, 0.0, 0.0, 0.0, 1.0]])
    knows = run_interventions(ENVIRONMENT, SIMULATOR, linear_networks(towards, 2 * towards), episodes=50, seed=1)
    rows = {row["name"]: row for row in knows.to_dict()["rows"]}
    # Two equally likely goals, each with its own action: 1 bit, whether stimuli have an effect or not.
    for name in ("as they are", "silent", "shuffled"):
        assert rows[name]["goal_information"]["bits"]["value"] == pytest.approx(1.0, abs=0.05)
    turning = knows.turning
    assert turning is not None and (turning.at, turning.episodes, turning.after) == (5, 64, 1.0)
    assert turning.turned == 1.0
    blind = run_interventions(ENVIRONMENT, SIMULATOR, linear_networks(towards[::-1]), episodes=50, seed=1)
    information = blind.rows[0].information
    assert information is not None and (information.bits.value, information.p) == (0.0, 1.0)
    assert blind.turning is not None and (blind.turning.turned, blind.turning.after) == (0.0, None)
    text = knows.to_text()
    assert "of 1.00 bits" in text and "first at action 1 after the switch" in text
    usual, turned = (row.returns for row in (knows.rows[0], knows.rows[6]))
    np.testing.assert_allclose(knows.rows[6].lost.value, (usual - turned).mean())


@pytest.mark.oracle
def test_a_single_goal_and_missing_neurons_are_reported() -> None:
    falling = linear_networks(np.zeros((4, 5)))
    made = run_interventions(Animat(Cartpole(), Thresholds(1), 5), SIMULATOR, falling, episodes=5, seed=1)
    assert made.turning is None and "the robot has only one goal" in made.to_text()
    assert [row.name for row in made.rows][-1] == "turned round"
    with pytest.raises(InvalidArgument, match="expected policies that act through neurons"):
        run_interventions(WithoutNeurons(Cartpole(), (-1.0, 1.0)), None, falling, episodes=5, seed=1)
