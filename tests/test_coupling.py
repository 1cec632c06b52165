"""The best coupling and the context gap: against best couplings that are known, and intervals against a bootstrap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.coding.mapping import Thresholds
from animat.environment import Animat, WithoutNeurons
from animat.errors import InvalidArgument
from animat.evaluation import coupling
from animat.evaluation.commands import mean_commands
from animat.evaluation.coupling import ContextGap, Coupling, best_coupling, context_gap, least_context_gap
from animat.evaluation.optimum import Optimum
from animat.evaluation.rollouts import roll_out
from animat.evaluation.statistics import Interval
from animat.neurons.synthetic import synthetic_simulator
from animat.robots import Quantity, Robot, Wheels, robot_named


@pytest.fixture
def quick_coupling() -> None:
    """None: here the search is as it is."""


class Sensed(NamedTuple):
    at: jax.Array


@dataclass(frozen=True)
class Sensing(Robot[Sensed]):
    """Its sensor values are drawn in each iteration, so that nothing else can help."""

    episode_limit: int = 10
    name = "sensing"
    noise_size = 2

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("first", "1", 1.0), Quantity("second", "1", 1.0))

    def reset(self, key: Any) -> Sensed:
        return Sensed(jax.random.uniform(key, (2,), minval=-1.0))

    def advance(self, uniforms: Any, state: Sensed, u: Any) -> tuple[Sensed, Any, Any]:
        return Sensed(2 * uniforms - 1), self.reward(state.at, u), jnp.bool_(False)

    def reward(self, at: Any, u: Any) -> Any:
        raise NotImplementedError

    def observe(self, state: Sensed) -> Any:
        return state.at


@dataclass(frozen=True)
class Copying(Sensing):
    """The best command is tanh(2 a - b + 0.5): 1 per iteration."""

    def reward(self, at: Any, u: Any) -> Any:
        return 1 - (u - jnp.tanh(2 * at[0] - at[1] + 0.5)) ** 2


@dataclass(frozen=True)
class Siding(Sensing):
    """The command itself where a > 0.3, the opposite elsewhere: the best are the two outermost mean commands."""

    def reward(self, at: Any, u: Any) -> Any:
        return u * jnp.sign(at[0] - 0.3)


def mean_return(environment: Any, simulator: Any, found: Coupling) -> float:
    return float(roll_out(environment, simulator, found, episodes=4000, seed=99).returns.mean())


@pytest.mark.oracle
def test_the_best_coupling_of_a_continuous_command_is_found() -> None:
    environment = WithoutNeurons(Copying(), None)
    found = best_coupling(environment, None)
    assert found.kind == "graded"
    assert mean_return(environment, None, found) > 0.99 * Copying().episode_limit
    np.testing.assert_allclose(np.asarray(found.weights)[0, 0], [2.0, -1.0, 0.5], atol=0.3)


@pytest.mark.oracle
def test_the_best_coupling_through_neurons_is_found() -> None:
    simulator = synthetic_simulator()
    environment = Animat(Siding(), Thresholds(1), 5)
    found = best_coupling(environment, simulator)
    # By hand: a > 0.3 in 0.35 of the iterations.
    _, means = mean_commands(environment, simulator)
    best = Siding().episode_limit * (0.35 * means.max() - 0.65 * means.min())
    assert abs(mean_return(environment, simulator, found) - best) < 0.01 * best + 3 * 0.05


class Hovering(NamedTuple):
    at: jax.Array
    speed: jax.Array


@dataclass(frozen=True)
class Hover(Robot[Hovering]):
    """Rewarded near the middle of a plane, and ended far from it: leaving immediately soon returns no less."""

    episode_limit: int = 40
    name = "hover"
    n_commands = 2

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return tuple(Quantity(name, unit, 0.5) for unit in ("m", "m/s") for name in (f"x in {unit}", f"y in {unit}"))

    def reset(self, key: Any) -> Hovering:
        return Hovering(jax.random.uniform(key, (2,), minval=-0.8, maxval=0.8), jnp.zeros(2))

    def advance(self, uniforms: Any, state: Hovering, u: Any) -> tuple[Hovering, Any, Any]:
        speed = 0.9 * state.speed + 0.03 * u
        away = jnp.linalg.norm(state.at + speed)
        return Hovering(state.at + speed, speed), -away, away > 2.0

    def observe(self, state: Hovering) -> Any:
        return jnp.concatenate(state)

    def heuristic(self, observation: Any) -> Any:
        return -0.9 * observation[:2] - 1.8 * observation[2:]


@pytest.mark.oracle
def test_the_search_begins_near_the_heuristic_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coupling, "GENERATIONS", 3)
    environment, scale = WithoutNeurons(Hover(), None), 0.5
    weights = scale * np.array([[-0.9, 0, -1.8, 0, 0], [0, -0.9, 0, -1.8, 0]])
    starts = coupling._near_heuristic(environment, None, (0, 1, 2, 3), seed=1)
    np.testing.assert_allclose(starts[0].reshape(2, 5), weights, atol=1e-5)
    np.testing.assert_allclose(starts[2], 4 * starts[0])
    # Its starting point is far better than what so few generations find by themselves.
    by_itself = Coupling(jnp.asarray(4 * weights[None], jnp.float32), jnp.zeros((1, 1)), None, "graded", (0, 1, 2, 3))
    known = mean_return(environment, None, by_itself)
    assert mean_return(environment, None, best_coupling(environment, None)) >= known - 0.05 * abs(known)
    monkeypatch.setattr(coupling, "_near_heuristic", lambda *_: np.zeros((0, 0)))
    assert mean_return(environment, None, best_coupling(environment, None)) < known - 0.2 * abs(known)


def test_a_coupling_does_not_see_the_goal() -> None:
    spec = Wheels().observation_spec
    seen = tuple(i for i, quantity in enumerate(spec) if not quantity.of_goal)
    assert [spec[i].name for i in range(len(spec)) if i not in seen] == ["goal_distance", "goal_bearing"]
    weights = np.random.default_rng(0).normal(size=(2, len(seen) + 1))
    rule = Coupling(jnp.asarray(weights), jnp.zeros(1), None, "graded", seen)
    environment = WithoutNeurons(Wheels(), None)
    here = np.random.default_rng(1).uniform(size=(1, len(spec)))
    there = here.copy()
    there[0, -2:] = -5.0
    acted = [np.asarray(rule.act(environment, jnp.asarray(o), jnp.zeros((1, 2)))) for o in (here, there)]
    np.testing.assert_array_equal(*acted)
    np.testing.assert_allclose(acted[0][0], np.tanh(weights[:, :-1] @ here[0, :-2] + weights[:, -1]), rtol=1e-5)


def test_bodies_that_are_stepped_in_python_have_none() -> None:
    with pytest.raises(InvalidArgument, match="expected one in JAX, as the search for the best coupling takes"):
        best_coupling(WithoutNeurons(robot_named("gymnasium:Pendulum-v1"), None), None)


def optimum_of(value: float, grid_error: float = 0.0) -> Optimum:
    return Optimum(value, grid_error, value, 0.0, value, 0.0, 1000, 1)


@pytest.mark.oracle
def test_the_gaps_interval_is_that_of_a_bootstrap() -> None:
    rng = np.random.default_rng(5)
    of_coupling, at_random = rng.normal(40, 20, 400), rng.normal(-10, 30, 400)
    gap = context_gap(of_coupling, at_random, optimum_of(90.0)).gap
    assert gap is not None and gap.value == pytest.approx((90 - of_coupling.mean()) / (90 - at_random.mean()))
    drawn = [x[rng.integers(400, size=(20_000, 400))].mean(axis=1) for x in (of_coupling, at_random)]
    ends = np.quantile((90 - drawn[0]) / (90 - drawn[1]), [0.025, 0.975])
    np.testing.assert_allclose([gap.low, gap.high], ends, atol=0.1 * np.ptp(ends))


@pytest.mark.parametrize(("achieved", "low"), [(60.0, 0.0), (100.0, 0.0), (110.0, 10 / 180), (119.9, 20 / 190)])
def test_the_gaps_interval_begins_where_the_optimum_is_what_was_achieved(achieved: float, low: float) -> None:
    """Of a coupling that returns 100 and random stimuli at -70, where the value is 120, as with memory."""
    of_coupling, at_random = np.tile([99.0, 101.0], 500), np.tile([-71.0, -69.0], 500)
    for known, unknown in ((achieved, 0.0), (0.0, achieved)):
        gap = context_gap(of_coupling, at_random, Optimum(120.0, 0.1, known, 0.0, unknown, 0.0, 1000, 1))
        usual = context_gap(of_coupling, at_random, optimum_of(120.0, 0.1))
        assert gap.gap is not None and usual.gap is not None
        assert (gap.gap.value, gap.gap.high) == (usual.gap.value, usual.gap.high)
        assert gap.gap.low == pytest.approx(low, abs=0.002)
        assert gap.needs_context == (low > 0.05)
    # What was achieved has an error too, and may be no more than random stimuli.
    unsure = context_gap(of_coupling, at_random, Optimum(120.0, 0.1, achieved, 3.0, 0.0, 0.0, 100, 1)).gap
    assert unsure is not None and (unsure.low < gap.gap.low - 0.01 or low in (0.0, 20 / 190))
    worse = context_gap(at_random - 5, at_random, Optimum(120.0, 0.1, -70.0, 1.0, -80.0, 1.0, 100, 1)).gap
    assert worse is not None and worse.low == 0.0
    # Where the controller was not run, nothing else is known.
    nan = float("nan")
    assert context_gap(of_coupling, at_random, Optimum(120.0, 0.1, nan, nan, nan, nan, 0, 1)).gap == usual.gap


def test_a_task_that_a_reflex_solves_has_no_score() -> None:
    returns = np.full(100, 118.0) + np.arange(100) % 2
    gap = context_gap(returns, returns - 200, optimum_of(120.0))
    assert not gap.needs_context and gap.score(np.array([119.0, 118.0]), optimum_of(120.0)) is None
    assert "this task needs no more than a reflex" in gap.to_text()
    # From 0.02 to 0.08.
    unsure = context_gap(120 + np.linspace(-80, 60, 60), np.full(60, -80.0), optimum_of(120.0))
    assert unsure.gap is not None and unsure.gap.low < 0.05 < unsure.gap.high
    assert "whether this task needs more than a reflex is not known" in unsure.to_text()
    # In JSON the three cases are told apart, too.
    assert gap.to_dict()["needs_context"] is False and unsure.to_dict()["needs_context"] is None
    sure = context_gap(np.full(60, 10.0), np.full(60, -80.0), optimum_of(120.0))
    assert sure.to_dict()["needs_context"] is True
    hopeless = context_gap(returns, returns, optimum_of(100.0))
    assert hopeless.gap is None and "not above that of random stimuli" in hopeless.to_text()


def test_the_context_score_is_0_for_a_coupling_and_1_for_the_optimum() -> None:
    rng = np.random.default_rng(6)
    of_coupling, best = rng.normal(40, 20, 400), optimum_of(140.0)
    gap = context_gap(of_coupling, rng.normal(0, 1, 400), best)
    for level, expected in ((of_coupling.mean(), 0.0), (140.0, 1.0), (90.0, 0.5)):
        policies = level + np.array([-10.0, 0.0, 10.0])
        score = gap.score(policies, best)
        assert score is not None and score.value == pytest.approx(expected, abs=0.01) and score.low < score.value
    drawn = of_coupling[rng.integers(400, size=(20_000, 400))].mean(axis=1)
    policies = np.array([80.0, 90.0, 100.0, 95.0, 85.0, 100.0, 80.0, 90.0, 92.0, 88.0])
    score = gap.score(policies, best)
    again = policies.mean() + policies.std(ddof=1) / np.sqrt(10) * rng.standard_t(9, 20_000)
    ends = np.quantile((again - drawn) / (140 - drawn), [0.025, 0.975])
    assert score is not None
    np.testing.assert_allclose([score.low, score.high], ends, atol=0.05 * np.ptp(ends))


@pytest.mark.long
@pytest.mark.parametrize(("robot", "least", "most"), [("cartpole", 119.0, 120.0), ("swing-up", 40.0, 45.0)])
def test_known_tasks(robot: str, least: float, most: float, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = synthetic_simulator((18.0, 26.0, 38.0, 52.0, 66.0), shape=10.0)
    environment = Animat(robot_named(robot), Thresholds(1), 5)
    once = mean_return(environment, simulator, best_coupling(environment, simulator))
    assert least < once <= most
    monkeypatch.setattr(coupling, "GENERATIONS", 2 * coupling.GENERATIONS)
    twice = mean_return(environment, simulator, best_coupling(environment, simulator))
    assert abs(twice - once) < 0.01 * (once + 80)


@pytest.mark.parametrize("n", [2, *(pytest.param(n, marks=pytest.mark.oracle) for n in (4, 10))])
def test_the_scores_interval_holds_the_true_score_as_often_as_it_says(n: int) -> None:
    rng = np.random.default_rng(n)
    gap, best = ContextGap(40.0, 0.0, Interval(0.7, 0.6, 0.8, 0.95)), optimum_of(140.0)
    scores = [gap.score(rng.normal(90.0, 20.0, n), best) for _ in range(4_000)]
    holds = np.mean([score is not None and score.low <= 0.5 <= score.high for score in scores])
    assert holds == pytest.approx(0.95, abs=0.015)


def test_the_optimums_grid_is_in_the_scores_interval() -> None:
    gap = ContextGap(40.0, 0.0, Interval(0.7, 0.6, 0.8, 0.95))
    score = gap.score(np.array([90.0, 90.0]), optimum_of(140.0, 10.0))
    assert score is not None and score.high - score.value == pytest.approx(0.5 * 10 / 100)


def test_one_episode_gives_no_gap() -> None:
    gap = context_gap(np.array([40.0]), np.array([-10.0]), optimum_of(90.0))
    assert gap.gap is None and not gap.needs_context and gap.to_dict()["coupling_standard_error"] is None
    assert gap.to_text() == "best coupling 40.0; no context gap with one episode"


@pytest.mark.parametrize("coupling", [-60.0, -85.0])
@pytest.mark.parametrize("optimum", [10.0, 20.0, 49.0])
def test_without_a_known_optimum_gap_and_score_are_lower_bounds(coupling: float, optimum: float) -> None:
    """Above and below random stimuli, which return -80; the best known agent returns 10."""
    couplings, random, known = (np.full(4, each) for each in (coupling, -80.0, 10.0))
    least = least_context_gap(couplings, random, np.stack([known - 5, known, known - 20]), highest=50.0)
    assert least.to_dict()["is_least"] and least.best_known == 10 and least.gap is not None and least.needs_context
    assert least.gap.value <= (optimum - coupling) / (optimum + 80) + 1e-12
    assert least.gap.value == pytest.approx(min(1.0, (10 - coupling) / 90))
    for policies in (-5.0, 8.0, coupling - 5):
        score = least.score(np.array([policies, policies]), None)
        assert score is not None and score.value <= (policies - coupling) / (optimum - coupling) + 1e-12
        assert score.low == pytest.approx(score.value) and np.sign(score.low) == np.sign(policies - coupling)
    text = least.to_text(least.score(np.array([8.0, 8.0]), None))
    assert "context gap at least" in text and "context score at least" in text and "returns 10.0" in text


def test_the_least_gaps_interval_is_that_of_a_bootstrap_of_episodes_with_the_same_starts() -> None:
    rng, n = np.random.default_rng(1), 400
    starts = rng.normal(0, 20, n)
    couplings, random, known = (of + rng.normal(0, 10, n) for of in (-50 + starts, -80 + starts, 10 + 0 * starts))
    found = least_context_gap(couplings, random, known[None])
    pairs, others = rng.integers(n, size=(2, 4000, n))
    means = known[others].mean(axis=1), couplings[pairs].mean(axis=1), random[pairs].mean(axis=1)
    low, high = np.quantile((means[0] - means[1]) / (means[0] - means[2]), (0.025, 0.975))
    assert found.gap is not None
    assert (found.gap.low, found.gap.high) == pytest.approx((low, high), abs=0.1 * (high - low))


def test_the_best_of_many_agents_is_not_biased_by_the_episodes_in_which_it_was_chosen() -> None:
    rng, nothing = np.random.default_rng(2), np.zeros(40)
    found = [least_context_gap(nothing, nothing - 1, rng.normal(5, 10, (20, 40))).best_known for _ in range(500)]
    assert np.mean(np.array(found, float)) == pytest.approx(5, abs=4 * 10 / np.sqrt(20 * 500))


def test_where_no_agent_is_above_random_stimuli_or_the_coupling_nothing_is_known() -> None:
    rng = np.random.default_rng(3)
    couplings, random, known = (rng.normal(mean, 1, 50) for mean in (0.0, -80.0, -85.0))
    below_random = least_context_gap(couplings, random, known[None])
    assert below_random.gap is None and "the best known agent (-8" in below_random.to_text()
    # Of two episodes the best known agent is measured in the second: one.
    in_two = least_context_gap(couplings[:2], random[:2], np.array([[30.0, 31.0], [29.0, 33.0]]))
    assert in_two.gap is None
    assert in_two.to_text().endswith("no context gap, as the best known agent (31.0) was measured in one episode")
    below_coupling = least_context_gap(couplings, random, known[None] + 60)
    assert below_coupling.gap is not None and below_coupling.gap.value == 0 and not below_coupling.needs_context
    assert below_coupling.to_text().endswith("whether this task needs more than a reflex is not known")
    assert below_coupling.score(np.array([1.0, 2.0]), None) is None
