"""Agents of one's own in the tables: against the policies that they wrap, and the same rule in JAX and outside."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.closed_loop.agents import Agent, Greedy
from animat.closed_loop.running import run_session
from animat.errors import InvalidArgument
from animat.evaluation.own_agents import agents_at
from animat.evaluation.rollouts import Actor
from animat.evaluation.table import evaluate
from animat.neurons.timeline import SimulatorTimeline, fit_timeline
from animat.reality_gap.calibration import Calibration
from animat.reality_gap.running import run_policies
from animat.recordings.recording import Recording
from animat.responses.extraction import extract_responses
from animat.responses.responses import Responses
from animat.robots import Cartpole
from animat.training.policy import Policy
from fake_culture import FakeCulture
from test_bodies_of_others import named
from test_closed_loop import loop_of
from test_evaluation import policy_of
from test_optimal_returns import answers
from test_reality_gap import PROTOCOL
from test_reality_gap import policy_of as navigator_of

PAGE = Path(__file__).parents[1] / "docs" / "agents.md"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Falling(Actor):
    """The fastest condition if the pole leans to the right."""

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return jnp.where(observation[:, 2] > 0, 4, 0)


@jax.tree_util.register_static
@dataclass(frozen=True)
class OfFour(Actor):
    """The same, for four observed quantities."""

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        _, _, angle, _ = jnp.moveaxis(observation * environment.scales, -1, 0)
        return jnp.where(angle > 0, 4, 0)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Always(Actor):
    index: float

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return jnp.full(len(observation), self.index)


@dataclass(frozen=True)
class Unregistered(Actor):
    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return jnp.zeros(len(observation), int)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tabular(Actor):
    """A condition for each fifth of the first quantity, from -1 to 1."""

    table: Any

    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return self.table[jnp.floor((observation[:, 0] + 1) * 2.499).astype(int)]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Misshaped(Actor):
    def act(self, environment: Any, observation: Any, uniforms: Any) -> Any:
        return observation @ jnp.zeros((7, 5))


class Plain:
    def act(self, observation: np.ndarray, rng: np.random.Generator) -> Any:
        return np.int64(4) if observation[2] > 0 else 0


class AtRandom:
    def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        return int(rng.integers(5))


class Wrong:
    def __init__(self, chosen: object) -> None:
        self.chosen = chosen

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> object:
        if isinstance(self.chosen, BaseException):
            raise self.chosen
        return self.chosen


class BeginsWith(Plain):
    def __init__(self, begun: Any) -> None:
        self.begun = begun

    def begin(self) -> Any:
        return self.begun


class Itself(Plain):
    def begin(self) -> Any:
        return self


def five_conditions() -> SimulatorTimeline:
    return fit_timeline([answers([60] * 5, 1)], kind="histogram")


def slider_of(timeline: SimulatorTimeline) -> Policy:
    """A policy for a robot outside JAX."""
    policy = policy_of(timeline)
    weights = (np.ones((2, 16), np.float32), *policy.weights[1:])
    return replace(policy, robot=named("Slider"), weights=weights, scales=np.ones(2, np.float32))


@pytest.mark.oracle
def test_an_agent_outside_jax_is_evaluated_as_one_in_jax_and_a_policy_as_itself() -> None:
    timeline = five_conditions()
    policy = policy_of(timeline, Cartpole(episode_limit=30))
    agents = {"in JAX": Falling(), "plain": Plain(), "the policy": Greedy(policy), "any": AtRandom()}
    found = evaluate({"p0": policy}, timeline, episodes=40, controls=["random"], agents=agents)
    returns = {row.name: row.episodes.returns.ravel() for row in found.rows}
    assert [*returns] == ["policies", "random", *agents]
    np.testing.assert_array_equal(returns["plain"], returns["in JAX"])
    np.testing.assert_array_equal(returns["the policy"], returns["policies"])
    error = np.hypot(returns["any"].std(), returns["random"].std()) / 40**0.5
    assert abs(returns["any"].mean() - returns["random"].mean()) < 4 * error
    assert len({*returns["any"].tolist()}) > 3
    # Drawn from its own random numbers only, so the same again.
    again = evaluate({"p0": policy}, timeline, episodes=40, controls=[], agents={"any": AtRandom()})
    np.testing.assert_array_equal(again.rows[1].episodes.returns.ravel(), returns["any"])


@pytest.mark.parametrize(
    ("name", "agent", "message"),
    [
        ("mine", Wrong(17), "agents: mine: act: expected the index of .* from 0 to 4, got 17"),
        ("mine", Wrong(True), "agents: mine: act: expected the index of .* from 0 to 4, got True"),
        pytest.param("mine", Wrong(0.5), "whole number from 0 to 4, got 0.5", marks=pytest.mark.oracle),
        pytest.param("mine", Wrong(None), "whole number from 0 to 4, got None", marks=pytest.mark.oracle),
        # A closed loop refuses it, too.
        pytest.param("mine", Wrong(2.0), "whole number from 0 to 4, got 2.0", marks=pytest.mark.oracle),
        pytest.param("mine", Wrong(SystemExit(3)), "agents: mine: SystemExit: 3", marks=pytest.mark.oracle),
        pytest.param(
            "mine",
            Always(99),
            "agents: mine: act: expected .* whole number from 0 to 4, got 99",
            marks=pytest.mark.oracle,
        ),
        pytest.param("mine", Always(-3), "whole number from 0 to 4, got -3", marks=pytest.mark.oracle),
        pytest.param(
            "mine",
            Always(1.0),
            "whole number from 0 to 4, got 1.0|to act in JAX, got TypeCheckError",
            marks=pytest.mark.oracle,
        ),
        ("mine", Misshaped(), "agents: mine: expected it to act in JAX, got"),
        (
            "mine",
            Wrong(ZeroDivisionError("no")),
            r"agents: mine: ZeroDivisionError: no \(.*test_own_agents.py, line \d+\)",
        ),
        pytest.param(
            "mine",
            BeginsWith(None),
            "agents: mine: begin: expected another object, which acts in .*, got None",
            marks=pytest.mark.oracle,
        ),
        pytest.param(
            "mine",
            Itself(),
            "agents: mine: begin: expected another object, .*, got the agent itself",
            marks=pytest.mark.oracle,
        ),
        (
            "mine",
            BeginsWith(Plain()),
            "agents: mine: begin: expected another object for each .*, got the same one twice",
        ),
        (
            "mine",
            Unregistered(),
            r"agents: mine: expected a JAX pytree \(jax.tree_util.register_static or .*, got Unreg",
        ),
        (
            "mine",
            Tabular(jnp.array(2)),
            r"agents: mine: expected one actor, each of its arrays with a first .* shapes \(\)",
        ),
        pytest.param(
            "mine", Tabular(jnp.arange(5)), r"first axis of length one, got the shapes \(5,\)", marks=pytest.mark.oracle
        ),
        ("mine", Plain, "agents: mine: expected an instance, got the class Plain: create one"),
        ("p0", Plain(), "agents: expected names other than .*, got p0"),
        pytest.param("mine", 3, "agents: mine: expected an Actor, or a method `act`, got 3", marks=pytest.mark.oracle),
        pytest.param("random", Plain(), "agents: expected names other than .*, got random", marks=pytest.mark.oracle),
        pytest.param(
            "policies", Plain(), "agents: expected names other than .*, got policies", marks=pytest.mark.oracle
        ),
    ],
)
def test_an_agent_that_cannot_act_is_refused_in_one_line(name: str, agent: Any, message: str) -> None:
    timeline = five_conditions()
    policy = policy_of(timeline, Cartpole(episode_limit=30))
    seen = Mock()
    with pytest.raises(InvalidArgument, match=message) as refused:
        evaluate({"p0": policy}, timeline, episodes=3, controls=[], agents={name: agent}, progress=seen)
    assert "\n" not in str(refused.value)
    # Before the policies have had their episodes.
    assert not seen.update.called or isinstance(agent, BeginsWith)
    # The next one is not blamed for it.
    evaluate({"p0": policy}, timeline, episodes=3, controls=[], agents={"mine": Plain()})


@pytest.mark.oracle
def test_an_agent_runs_beside_policies_with_its_own_prediction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("animat.reality_gap.calibration.BOOTSTRAPS", 4)
    with FakeCulture() as culture:
        recordings: list[Recording] = []
        for seed in range(2):
            recordings.append(culture.record(PROTOCOL, seed))
            culture.rest(60.0)
    series: list[Responses] = [extract_responses(each, burst_threshold=0.95) for each in recordings]
    policies = {"p0": navigator_of(0, series), "p1": navigator_of(1, series)}
    agents = {"like p1": Greedy(policies["p1"]), "first": Wrong(0)}
    with FakeCulture() as culture:
        gap = run_policies(
            policies, culture, Calibration.of_series(series), tmp_path, episodes=4, with_controls=False, agents=agents
        )
    rows = {row.name: row for row in gap.rows}
    assert [*rows] == ["policies", "p0", "p1", "random", *agents]
    assert [len(rows[name].measured) for name in ("p0", "p1", *agents)] == [4] * 4
    # Fewer episodes than of a policy: within their standard errors.
    like, p1 = rows["like p1"].predicted, rows["p1"].predicted
    assert len(like) < len(p1)
    error = np.hypot(like.std() / len(like) ** 0.5, p1.std() / len(p1) ** 0.5)
    assert abs(like.mean() - p1.mean()) < 4 * error + 1e-9
    assert rows["like p1"].comparison is not None and "your own agent" in gap.to_text()
    for name in ("p0", "policies", "coupling", "silent", "ideal actuator"):
        message = f"agents: expected names other than .*, got {name}"
        with FakeCulture() as culture, pytest.raises(InvalidArgument, match=message):
            run_policies(policies, culture, Calibration.of_series(series), tmp_path / "b", agents={name: Wrong(0)})
    for name, meant in {"controls": r"; did you mean with_controls\?", "robot": "", "adaptive": ""}.items():
        message = f"{name}: expected an argument of run_policies, or .*, got neither{meant}$"
        with FakeCulture() as culture, pytest.raises(InvalidArgument, match=message):
            run_policies(policies, culture, Calibration.of_series(series), tmp_path / "b", **{name: "random"})


@pytest.mark.oracle
def test_the_rules_of_the_page_are_one_rule() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    names: dict[str, Any] = {"__name__": __name__}
    for block in blocks[:2]:
        exec(compile(block, str(PAGE), "exec"), names)
    timeline = five_conditions()
    policy = policy_of(timeline)
    agents = {"rule": names["Rule"](policy.conditions), "in JAX": names["RuleInJax"](0, 4)}
    rule, in_jax = evaluate({"p0": policy}, timeline, controls=[], agents=agents).rows[1:]
    assert rule.episodes.returns.tolist() == in_jax.episodes.returns.tolist()
    assert rule.episodes.returns.mean() > 0


def test_agents_are_imported_by_their_place_and_made_with_the_conditions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_agents_of_a_test.py").write_text(
        "class Rule:\n"
        "    def __init__(self, conditions):\n"
        "        self.last = len(conditions) - 1\n"
        "    def act(self, observation, rng):\n"
        "        return self.last\n"
        "class Odd:\n"
        "    def __init__(self):\n"
        "        pass\n"
        "ready = Rule((1, 2))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    module, conditions = "own_agents_of_a_test", five_conditions().conditions
    agents = agents_at([f"{module}:Rule", f"{module}:ready"], conditions)
    assert [(name, agent.last) for name, agent in agents.items()] == [("Rule", 4), ("ready", 1)]
    for places, message in (
        ([f"{module}:Odd"], "to be created with the conditions to choose from, got TypeError"),
        ([module], "expected a module and what is in it, such as my_rule:Rule, got 'own_agents_of_a_test'"),
        ([f"{module}:Rule"] * 2, "expected different names, got 'own_agents_of_a_test:Rule'"),
        ([f"{module}:Nothing"], "to be importable, got AttributeError"),
        (["own_agents_of_a_test.py:Rule"], "such as own_agents_of_a_test:Rule, got a file"),
    ):
        with pytest.raises(InvalidArgument, match=message):
            agents_at(places, conditions)


@pytest.mark.oracle
def test_an_agent_sees_the_neurons_if_the_policies_do() -> None:
    timeline = fit_timeline([answers([60] * 5, 1)], kind="memory")
    robot = Cartpole(episode_limit=20)
    seeing = replace(
        policy_of(timeline, robot),
        neural_observation=True,
        weights=(np.ones((6, 16), np.float32), *policy_of(timeline, robot).weights[1:]),
        scales=np.ones(6, np.float32),
    )
    found = evaluate({"p0": seeing}, timeline, episodes=20, controls=[], agents={"it": Greedy(seeing), "rule": Plain()})
    assert found.rows[1].episodes.returns.tolist() == found.rows[0].episodes.returns.tolist()
    # In JAX it sees the robot, as in a closed loop.
    agents = {"plain": Plain(), "in JAX": Falling(), "of four": OfFour()}
    plain, *in_jax = evaluate({"p0": seeing}, timeline, episodes=20, controls=[], agents=agents).rows[1:]
    assert all(row.episodes.returns.tolist() == plain.episodes.returns.tolist() for row in in_jax)
    with pytest.raises(InvalidArgument, match="expected one that sees the robot only, got one with neural_observation"):
        evaluate({"p0": policy_of(timeline, robot)}, timeline, agents={"it": Greedy(seeing)})


class Counting:
    """Keeps to one condition in the first half of an episode, and to another in the second."""

    def __init__(self) -> None:
        self.seen = 0

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        self.seen += 1
        return 0 if self.seen <= 3 else 4


class Remembering:
    def begin(self) -> Counting:
        return Counting()

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        raise AssertionError("it was not begun")


def test_an_agent_that_remembers_begins_anew_in_each_episode() -> None:
    timeline = five_conditions()
    robot = Cartpole(episode_limit=7)
    policy = policy_of(timeline, robot)
    found = evaluate({"p0": policy}, timeline, episodes=9, controls=[], agents={"mine": Remembering()}).rows[1]
    lengths = found.episodes.lengths.ravel()
    presented = found.episodes.presented[0]
    assert presented[0] == np.minimum(lengths, 3).sum() and presented[4] == np.maximum(lengths - 3, 0).sum() > 0
    again = evaluate({"p0": policy}, timeline, episodes=9, controls=[], agents={"mine": Remembering()}).rows[1]
    assert again.episodes.returns.tolist() == found.episodes.returns.tolist()
    with pytest.raises(InvalidArgument, match=r"agents: mine: act: expected one condition for .*, got 0, then 4: draw"):
        evaluate({"p0": policy}, timeline, episodes=9, controls=[], agents={"mine": Counting()})


def test_in_a_loop_it_begins_anew_too(tmp_path: Path) -> None:
    agent = Agent("mine", "your own agent", Remembering())
    with FakeCulture() as culture:
        session = run_session(culture, loop_of(), [agent], tmp_path / "a", episodes=2)
    chosen = [(tick.episode, tick.iteration, tick.chosen) for tick in session.ticks if tick.iteration >= 0]
    assert {episode for episode, _, _ in chosen} == {0, 1}
    assert all(condition == (0 if iteration < 3 else 4) for _, iteration, condition in chosen)


@pytest.mark.oracle
@pytest.mark.parametrize("is_on_host", [False, True])
def test_ctrl_c_is_not_held_until_the_last_episode(is_on_host: bool, in_the_foreground: None) -> None:
    asked = 0

    class Slow:
        def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
            nonlocal asked
            asked += 1
            if asked == 20:
                os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            return int(rng.integers(5))

    timeline = five_conditions()
    policy = slider_of(timeline) if is_on_host else policy_of(timeline, Cartpole(episode_limit=60))
    with pytest.raises(KeyboardInterrupt):
        evaluate({"p0": policy}, timeline, episodes=40, controls=[], agents={"slow": Slow()})
    # Of about a thousand.
    assert asked < 200


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (Always(-1), "agents: mine: act: expected the index of .* from 0 to 4, got -1"),
        (Always(9), "agents: mine: act: expected the index of .* from 0 to 4, got 9"),
        (Always(1.0), "agents: mine: expected it to act in JAX, got TypeError: act: expected a whole number for each"),
        (Misshaped(), "agents: mine: expected it to act in JAX, got"),
    ],
)
def test_on_a_robot_outside_jax_an_agent_in_jax_is_tried_too(agent: Actor, message: str) -> None:
    timeline = five_conditions()
    policy = slider_of(timeline)
    with pytest.raises(InvalidArgument, match=message):
        evaluate({"p0": policy}, timeline, episodes=2, controls=[], agents={"mine": agent})
    # It is only asked for what the robot observes.
    evaluate({"p0": policy}, timeline, episodes=2, controls=[], agents={"mine": Tabular(jnp.arange(5)[None])})


class OneEpisode:
    """Lives as long as an episode, and wants to see nothing else."""

    def __init__(self, limit_rad: float = np.inf) -> None:
        self.limit_rad, self.seen = limit_rad, 0

    def begin(self) -> OneEpisode:
        return OneEpisode(0.2095)

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        self.seen += 1
        if abs(observation[2]) > self.limit_rad or self.seen > 60:
            raise ValueError(f"asked after its end, at {observation}")
        return 4


def test_an_agent_is_not_asked_after_its_episode() -> None:
    timeline = five_conditions()
    policies = {"p0": policy_of(timeline, Cartpole(episode_limit=60))}
    row = evaluate(policies, timeline, episodes=40, controls=[], agents={"it": OneEpisode()}).rows[1]
    assert np.ptp(row.episodes.lengths) > 0


@pytest.mark.parametrize("is_on_host", [False, True])
def test_an_agent_is_asked_in_each_iteration_of_its_episodes_and_its_first_answers_again(is_on_host: bool) -> None:
    asked = 0

    class Counted:
        def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
            nonlocal asked
            asked += 1
            return int(rng.integers(5))

    timeline = five_conditions()
    policies = {"p0": slider_of(timeline) if is_on_host else policy_of(timeline, Cartpole(episode_limit=60))}
    row = evaluate(policies, timeline, episodes=40, controls=[], agents={"it": Counted()}).rows[1]
    lengths = row.episodes.lengths.ravel()
    assert np.ptp(lengths) > 0 or is_on_host
    # In JAX it is tried once before.
    assert asked == lengths.sum() + min(20, lengths[0]) + (not is_on_host)
    with pytest.raises(InvalidArgument, match=r"agents: mine: act: expected one condition for .*, got 0, then 4: draw"):
        evaluate(policies, timeline, episodes=40, controls=[], agents={"mine": Counting()})


class OnlyBegins:
    def begin(self) -> Plain:
        return Plain()


def test_an_agent_may_have_begin_alone(tmp_path: Path) -> None:
    timeline = five_conditions()
    policies = {"p0": policy_of(timeline, Cartpole(episode_limit=30))}
    agents = {"begins": OnlyBegins(), "plain": Plain()}
    found = evaluate(policies, timeline, episodes=3, controls=[], agents=agents)
    assert found.rows[1].episodes.returns.tolist() == found.rows[2].episodes.returns.tolist()
    with pytest.raises(InvalidArgument, match=r"agents: expected a name for each, got ''"):
        evaluate(policies, timeline, episodes=3, controls=[], agents={"": Plain()})


def test_ctrl_c_ends_an_evaluation_whose_agent_hangs(in_the_foreground: None) -> None:
    released = threading.Event()
    waited = []

    class Hangs:
        def act(self, observation: np.ndarray, rng: np.random.Generator) -> int:
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
            waited.append(released.wait(60))
            return 0

    timeline = five_conditions()
    policies = {"p0": policy_of(timeline, Cartpole(episode_limit=30))}
    try:
        with pytest.raises(KeyboardInterrupt):
            evaluate(policies, timeline, episodes=3, controls=[], agents={"it": Hangs()})
        assert not waited, "it ends while the agent hangs"
    finally:
        released.set()
