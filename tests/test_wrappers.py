"""What is put around an environment: the episode limit, shuffled delivery, neural observation."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy import stats

from animat.coding.mapping import Thresholds
from animat.environment import Animat, Environment, State, WithoutNeurons
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import Actor, Constant, Networks, Seen, Uniform, Uniforms, roll_out
from animat.evaluation.table import evaluate
from animat.live.plan import Timetable, check_plan
from animat.neurons.memory import MemorySimulator
from animat.neurons.synthetic import synthetic_simulator
from animat.robots import Cartpole
from animat.stimulation.protocol import Protocol
from animat.training.group import programs
from animat.training.policy import Policy
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.wrappers import EpisodeLimit, NeuralObservation, ShuffledDelivery, Wrapper, YokedDelivery
from test_memory import persistent
from test_optimum import STEPS, Stairs
from test_training import SMALL, timeline_of, trained

ANIMAT = Animat(Cartpole(), Thresholds(9), 5)
DIRECT = WithoutNeurons(Stairs(2), (-1.0, 1.0))
DIRECT_FOR_SEVEN = WithoutNeurons(Stairs(7), (-1.0, 1.0))


def ended_after(environment: Environment[Any], *actions: int) -> tuple[int, bool, bool]:
    """How many iterations an episode has, and how it ended."""
    state = environment.reset(jax.random.key(0))
    for action in actions:
        state = environment.step(jax.random.key(1), state, jnp.int32(action), None)
        if any(state.ended):
            break
    return int(state.iteration), bool(state.ended.terminated), bool(state.ended.truncated)


def test_the_episode_limit_cuts_off_what_has_not_ended_by_itself() -> None:
    """Two steps of stairs lead to their top, and up and down again to nowhere."""
    limited = EpisodeLimit(DIRECT)
    assert ended_after(limited, 1, 0, 1, 1) == (2, False, True)
    assert ended_after(limited, 1, 1) == (2, True, False)
    assert ended_after(EpisodeLimit(WithoutNeurons(Stairs(1), (-1.0, 1.0))), 1, 1) == (1, False, True)
    # Without it an episode goes on.
    assert ended_after(DIRECT, 1, 0, 1, 1) == (4, True, False)


def test_shuffled_delivery_draws_every_condition_as_often_and_changes_nothing_else() -> None:
    shuffled, n = ShuffledDelivery(ANIMAT), 20_000
    uniforms = jax.random.uniform(jax.random.key(3), (n, shuffled.noise_size))
    state, simulator = ANIMAT.reset(jax.random.key(0)), synthetic_simulator()
    every = jax.jit(jax.vmap(lambda u, a, of: of.advance(u, state, a, simulator), (0, 0, None)), static_argnums=2)
    chosen = jnp.arange(n) % 5
    after = every(uniforms, chosen, shuffled)
    delivered = np.asarray(after.info["delivered"])
    table = np.histogram2d(np.asarray(chosen), delivered, bins=5)[0]
    assert stats.chisquare(table.ravel()).pvalue > 1e-3
    for one, other in zip(*map(jax.tree.leaves, (after, every(uniforms, delivered, ANIMAT))), strict=True):
        np.testing.assert_array_equal(one, other)
    # For robots that are stepped outside JAX, too.
    for u, a, of in zip(uniforms[:3], chosen, delivered, strict=False):
        both = shuffled.respond(u, state, a, simulator), ANIMAT.respond(u, state, jnp.int32(of), simulator)
        for one, other in zip(*map(jax.tree.leaves, both), strict=True):
            np.testing.assert_array_equal(one, other)
    # Neither what neurons answer nor the robot's noise goes with what was drawn for them.
    anew = every(jax.random.uniform(jax.random.key(4), uniforms.shape), delivered, ANIMAT)
    for i in range(5):
        answers = (np.asarray(each.info["rate_hz"])[delivered == i] for each in (after, anew))
        assert stats.ks_2samp(*answers).pvalue > 1e-3
        moved = (np.asarray(jax.vmap(ANIMAT.robot.observe)(each.robot))[delivered == i, 1] for each in (after, anew))
        assert stats.ks_2samp(*moved).pvalue > 1e-3


def test_wrappers_go_together_in_any_order() -> None:
    kinds: tuple[type[Wrapper[Any]], ...] = (EpisodeLimit, ShuffledDelivery, NeuralObservation)
    simulator = persistent()
    seen = []
    for first, second, third in itertools.permutations(kinds):
        environment = third(second(first(Animat(Stairs(2), Thresholds(1), 2))))
        state = environment.reset(jax.random.key(0))
        leaves = [environment.observe(state)]
        for i in range(2):
            state = environment.step(jax.random.key(i), state, jnp.int32(0), simulator)
            leaves += [environment.observe(state), *jax.tree.leaves(state)]
        assert [quantity.name for quantity in environment.observation_spec] == ["step", "trace", "load"]
        assert len(environment.scales) == len(leaves[0]) == 3
        seen.append([np.asarray(leaf).tolist() for leaf in leaves])
    assert all(each == seen[0] for each in seen)


def test_the_neurons_seen_are_those_of_the_episode_that_the_agent_acts_in() -> None:
    """Yoked delivery shows the agent another episode, whichever wrapper is the outer one."""
    animat, simulator = Animat(Stairs(2), Thresholds(1), 2), persistent()
    seen = []
    for environment in (NeuralObservation(YokedDelivery(animat)), YokedDelivery(NeuralObservation(animat))):
        state, observations = environment.reset(jax.random.key(0)), []
        for i in range(3):
            state = environment.step(jax.random.key(i), state, jnp.int32(i % 2), simulator)
            observations.append(np.asarray(environment.observe(state)).tolist())
        seen.append(observations)
    assert seen[0] == seen[1]
    assert seen[0][-1][-2] != float(state.neurons[0])
    # When it ends, the other episode starts again.
    others: list[Any] = [state.info["other_episode"]]
    for i in range(3):
        state = environment.step(jax.random.key(i), state, jnp.int32(1), simulator)
        others.append(state.info["other_episode"])
    iterations = [int(other.iteration) for other in others]
    assert 0 in iterations and all(after in (0, before + 1) for before, after in itertools.pairwise(iterations))


@dataclass(frozen=True)
class Tired(Wrapper[Any]):
    """A wrapper of one's own, which remembers: every other push up is one down."""

    def reset(self, key: Any) -> State:
        state = self.inside.reset(key)
        return state._replace(info={**state.info, "pushes": jnp.int32(0)})

    def advance(self, uniforms: Any, state: State, action: Array, simulator: Any) -> State:
        pushes = state.info["pushes"] + action
        after = self.inside.advance(uniforms, state, action * pushes % 2, simulator)
        return after._replace(info={**after.info, "pushes": pushes})


def test_a_custom_wrapper_remembers() -> None:
    """Up, down, up, down: the stairs have no end, but for the limit."""
    for environment in (Tired(EpisodeLimit(DIRECT_FOR_SEVEN)), EpisodeLimit(Tired(DIRECT_FOR_SEVEN))):
        up = roll_out(environment, None, Constant(jnp.array([1])), episodes=2, seed=0)
        assert up.lengths.tolist() == [[7, 7]]
        assert not up.terminated.any()


@pytest.mark.parametrize("wrapper", [ShuffledDelivery, NeuralObservation])
def test_what_is_of_neurons_is_refused_without_them(wrapper: type[Wrapper[Any]]) -> None:
    with pytest.raises(InvalidArgument, match="inside: expected an Animat, which has neurons, got WithoutNeurons"):
        wrapper(EpisodeLimit(DIRECT))


# --- what the neurons remember ----------------------------------------------------------------------------------------


def contrary() -> MemorySimulator:
    """Heads in 0.2 and 0.8 of the tosses of two coins after tails, and in 0.8 and 0.2 after heads."""
    after = np.array([[0.0] * (10 - t) + [1.0] * t + [0.0] * t + [1.0] * (10 - t) for t in (2, 8)])
    before = np.array([[0.5] * 10 + [1.0] * 10] * 2)
    histories = np.stack([before, np.full_like(before, 0.5)], axis=-1)
    arrays = {"before": before, "histories": histories, "after_hz": after, "left": 0.5 + after / 2}
    return replace(persistent(), **{name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()})


STAIRS = Animat(Stairs(), Thresholds(1), 2)
# The gambler's ruin: from the middle of four steps, p = 0.8 up.
UP_AT_BEST = 1 / (1 + (0.2 / 0.8) ** 2)
# Who sees the step alone knows the last toss on the two outer ones, and tosses the second coin on the middle one. Its
# values there after tails and heads: t = 0.8 (0.8 + 0.2 t) + 0.2 * 0.8 h, h = 0.2 (0.8 + 0.2 t) + 0.8 * 0.8 h.
UP_BLIND = float(np.linalg.solve([[1 - 0.16, -0.16], [-0.04, 1 - 0.64]], [0.64, 0.16])[0])


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ByThePast(Actor):
    """The second coin after tails, the first one after heads."""

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        return (observation[:, -2] < 0.75).astype(jnp.int32)


def mean_return(environment: Environment[Any], actor: Actor) -> float:
    return float(roll_out(environment, contrary(), actor, episodes=4000, seed=1).returns.mean())


@pytest.mark.oracle
def test_who_sees_the_past_does_what_is_possible_with_neurons_that_remember() -> None:
    assert best_return(STAIRS, contrary(), grid=STEPS, episodes=0).value == pytest.approx(UP_AT_BEST, abs=1e-3)
    error = np.sqrt(UP_AT_BEST * (1 - UP_AT_BEST) / 4000)
    assert abs(mean_return(NeuralObservation(STAIRS), ByThePast()) - UP_AT_BEST) < 4 * error
    for blind in (Uniform(), Constant(jnp.array([0])), Constant(jnp.array([1]))):
        assert mean_return(STAIRS, blind) < 0.8


@pytest.mark.oracle
def test_a_policy_learns_to_go_by_the_past() -> None:
    settings = SAC(replay=16_384, hidden=32, reward_scale=1.0)
    reached = {}
    for environment in (STAIRS, NeuralObservation(STAIRS)):
        beginning, chunk = programs(environment, settings)
        learners, _ = chunk(
            beginning(jax.random.split(jax.random.key(1), 2)), contrary(), jnp.int32(0), jnp.int32(1000)
        )
        networks = Networks(learners.deployed, jnp.tile(environment.scales, (2, 1)), greedy=True)
        episodes = roll_out(environment, contrary(), networks, episodes=4000, seed=1)
        reached[type(environment)] = episodes.returns.mean(axis=1)
    # Four standard errors of 4,000 episodes.
    np.testing.assert_allclose(reached[NeuralObservation], UP_AT_BEST, atol=0.015)
    np.testing.assert_allclose(reached[Animat], UP_BLIND, atol=0.022)


# --- from training to the loop ----------------------------------------------------------------------------------------

SEEING = Training(Cartpole(), Thresholds(1), policies=1, iterations=2_000, algorithm=SMALL, neural_observation=True)


@pytest.fixture(scope="module")
def seeing(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    return trained(SEEING, timeline_of(), tmp_path_factory.mktemp("seeing"))["p0"]


@pytest.mark.oracle
def test_a_policy_knows_what_it_sees_and_is_evaluated_so(seeing: Policy, tmp_path: Path) -> None:
    assert seeing.neural_observation
    assert seeing.weights[0].shape[0] == len(seeing.scales) == 6
    blind = trained(replace(SEEING, neural_observation=False), timeline_of(), tmp_path / "blind")["p0"]
    assert not blind.neural_observation
    tables = [evaluate({"p": policy}, timeline_of(), episodes=20) for policy in (seeing, blind)]
    # Who acts without looking, or looks at the robot alone, does the same whatever the policies see.
    for one, other in zip(*(table.rows for table in tables), strict=True):
        assert one.name == other.name
        if one.name in ("random", "heuristic") or one.name.startswith("constant"):
            np.testing.assert_array_equal(one.episodes.returns, other.episodes.returns)
    with pytest.raises(Mismatch, match="the same neural_observation as"):
        evaluate({"p": seeing, "q": blind}, timeline_of(), episodes=20)


def test_no_live_run_shows_what_neurons_remember(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match="neural_observation: expected False"):
        check_plan(SEEING, Protocol(), tmp_path / "live", Timetable(), 1, {})


def test_a_neural_observation_is_of_neurons() -> None:
    with pytest.raises(InvalidArgument, match="neural_observation: expected only with a mapping"):
        Training("cartpole", None, neural_observation=True)
    with pytest.raises(InvalidArgument, match="neural_observation: expected true or false, got 'yes'"):
        replace(SEEING, neural_observation="yes")  # type: ignore[arg-type]


@pytest.mark.oracle
def test_a_file_that_is_wrong_about_what_its_policy_sees_is_refused(seeing: Policy, tmp_path: Path) -> None:
    seeing.save(tmp_path / "p0.safetensors")
    whole = (tmp_path / "p0.safetensors").read_bytes()
    field = b'\\"neural_observation\\": true'
    # Told again by its provenance, further on.
    assert whole.count(field) == 2
    for other in (b"0   ", b"null", b"[5] "):
        (tmp_path / "other.safetensors").write_bytes(whole.replace(field, field.replace(b"true", other), 1))
        with pytest.raises(InvalidFile, match=r"this policy cannot be loaded: (weights|neural)"):
            Policy.load(tmp_path / "other.safetensors")


@pytest.mark.parametrize("n_conditions", [2, 5])
def test_an_animat_has_as_many_conditions_as_its_simulator(n_conditions: int) -> None:
    animat = Animat(Cartpole(), Thresholds(9), n_conditions)
    simulator, state = timeline_of().at(0.0), animat.reset(jax.random.key(0))
    with pytest.raises(InvalidArgument, match=f"n_conditions: expected 3, those of the simulator, got {n_conditions}"):
        animat.step(jax.random.key(1), state, jnp.int32(0), simulator)
    for none in (0, -n_conditions):
        with pytest.raises(InvalidArgument, match=f"n_conditions: expected at least 1, got {none}"):
            Animat(Cartpole(), Thresholds(9), none)


@pytest.mark.parametrize("commands", [(), (2.0, -1.0), (float("nan"),)])
def test_commands_beyond_the_bounds_are_refused(commands: tuple[float, ...]) -> None:
    with pytest.raises(InvalidArgument, match=r"^commands: expected numbers from -1 to 1, at least one"):
        WithoutNeurons(Cartpole(), commands)


@pytest.mark.oracle
def test_what_an_environment_is_made_of_is_checked() -> None:
    # Elsewhere, as the tests check types before it can.
    program = """
import animat
for make in (
    lambda: animat.WithoutNeurons("cartpole", None),
    lambda: animat.WithoutNeurons(animat.Cartpole(), 1.0),
    lambda: animat.EpisodeLimit(animat.Cartpole()),
):
    try:
        make()
    except animat.InvalidArgument as error:
        print(error)
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    robot, commands, inside = ran.stdout.splitlines()
    assert robot.startswith("robot: expected") and commands.startswith("commands: expected")
    assert inside.startswith("inside: expected")
