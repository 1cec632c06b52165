"""Gymnasium environments as bodies: conversion of spaces, training that survives a kill, faults in one line."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import pickle
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bodies_of_others  # registers them
from animat.cli import main
from animat.closed_loop.runner import HostRunner
from animat.coding.mapping import Thresholds
from animat.environment import WithoutNeurons
from animat.errors import BodyFailed, InvalidArgument
from animat.evaluation.coupling import Coupling
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import Constant, Uniform, networks_of, roll_out
from animat.evaluation.table import evaluate
from animat.reality_gap.predicting import ROLL_OUTS, episodes_on_host
from animat.robots import host, robot_from_dict, robot_named, robot_to_dict
from animat.robots.gymnasium import GymnasiumRobot
from animat.robots.host import Bodies, BodiesSnapshot
from animat.robots.registry import REGISTRY
from animat.studies.episodes import record_paths
from animat.training.folder import describe_training, expect_trainable
from animat.training.group import Group
from animat.training.host import OnHost
from animat.training.policy import Policy
from animat.training.settings import LEARNER, SAC
from animat.training.specification import CHUNKS, Training
from test_training import bits, timeline_of, train_group, trained

SMALL = SAC(environments=4, gradient_steps=1, batch=16, replay=1024, hidden=8)
TOY = "gymnasium:bodies_of_others:"


def named(name: str, **parameters: Any) -> GymnasiumRobot:
    robot = robot_named(f"{TOY}{name}-v0", **parameters)
    assert isinstance(robot, GymnasiumRobot)
    return robot


def training(robot: Any, mapping: Any = None, **more: Any) -> Training:
    settings = {"policies": 2, "iterations": 2_400, "duration_min": 60.0, "algorithm": SMALL} | more
    return Training(robot, mapping, **settings)


@pytest.mark.parametrize(("limit", "episodes"), [(20, 100), (200, 100), (400, 50), (1000, 20), (5000, 20)])
def test_long_episodes_are_predicted_from_fewer(limit: int, episodes: int) -> None:
    assert ROLL_OUTS * episodes_on_host(named("Slider", episode_limit=limit)) == episodes


def test_spaces_become_commands_observations_and_limits() -> None:
    robot = named("Slider", gain=0.2)
    assert (robot.n_commands, robot.episode_limit, robot.baseline_commands) == (1, 20, None)
    assert [q.scale for q in robot.observation_spec] == [2.0, 2.0] and robot.keeps_state
    np.testing.assert_allclose(robot.actions(np.array([[-1.0], [0.0], [1.0]]))[:], [[-1.0], [1.0], [3.0]])
    assert named("Slider", episode_limit=7).episode_limit == 7
    levels = named("Levels")
    assert levels.actions(np.array([[-1.0], [-0.34], [-0.3], [0.3], [0.34], [1.0]])) == [0, 0, 1, 1, 2, 2]
    np.testing.assert_allclose(levels.baseline_commands, [-2 / 3, 0, 2 / 3], atol=1e-12)
    # The middle of a level is that level.
    assert levels.actions(np.array(levels.baseline_commands)[:, None]) == [0, 1, 2]
    # What nothing bounds is measured: the second number is always 500.
    first, second = (q.scale for q in named("UnknownScale").observation_spec)
    assert second == 500 and 0.1 < first < 2.5
    assert named("UnknownScale") == named("UnknownScale")


def test_it_is_data_that_needs_no_environment() -> None:
    robot = named("Levels")
    data = robot_to_dict(robot)
    assert data["name"] == "gymnasium" and robot_from_dict(json.loads(json.dumps(data))) == robot
    assert pickle.loads(pickle.dumps(robot)) == robot and hash(robot) == hash(named("Levels"))
    unknown = {**data, "parameters": {**data["parameters"], "id": "nobody_has_this:Rover-v0"}}
    elsewhere = robot_from_dict(unknown)
    with pytest.raises(InvalidArgument, match=r"expected nobody_has_this to be imported.*--robot gymnasium:nobody_has"):
        Bodies(elsewhere, [(1,)])  # type: ignore[arg-type]
    with pytest.raises(InvalidArgument, match="gymnasium: settings: expected to be given, got nothing"):
        robot_from_dict({"name": "gymnasium", "parameters": {"id": "Pendulum-v1"}})
    with pytest.raises(InvalidArgument, match="levels: expected at most 1,024"):
        replace(robot, levels=10_000)


@pytest.mark.parametrize("id", ["Pendulum-v1", "Acrobot-v1", "CartPole-v1", "MountainCarContinuous-v0"])
def test_bodies_move_as_gymnasium_itself_moves_them(id: str) -> None:
    robot = robot_named(f"gymnasium:{id}")
    assert isinstance(robot, GymnasiumRobot) and robot.keeps_state
    bodies, body, env = Bodies(robot, [(1,), (2,)]), robot.body(), gymnasium.make(id)
    np.testing.assert_array_equal(body.reset(5), env.reset(seed=5)[0])
    bodies.begin()
    rng = np.random.default_rng(3)
    for _ in range(robot.episode_limit):
        command = rng.uniform(-1, 1, (1, 1))
        space: Any = env.action_space
        if robot.levels:
            action: Any = int((command[0, 0] + 1) / 2 * robot.levels)
        else:
            action = (space.low + (command[0] + 1) / 2 * (space.high - space.low)).astype(np.float32)
        seen, reward, terminated, truncated, _ = env.step(action)
        ours = body.step(robot.actions(command)[0])
        np.testing.assert_array_equal(ours[0], seen)
        assert (ours[1], ours[2]) == (reward, terminated)
        stepped = bodies.step(np.repeat(command, 2, axis=0))
        bodies.begin(np.flatnonzero(stepped.ended).tolist())
        if terminated or truncated:
            break
    # Its own time limit is the one of Gymnasium, which `Bodies` sees to.
    assert terminated or truncated


def test_a_snapshot_restores_bodies() -> None:
    robot = named("Slider")
    first = Bodies(robot, [(7, 0), (7, 1)])
    first.begin()
    rng = np.random.default_rng(0)
    for _ in range(27):
        stepped = first.step(rng.uniform(-1, 1, (2, 1)).astype(np.float32))
        first.begin(np.flatnonzero(stepped.ended).tolist())
    second = Bodies(robot, [(7, 0), (7, 1)])
    assert second.restore(first.snapshot)
    np.testing.assert_array_equal(second.observation, first.observation)
    for _ in range(15):
        command = rng.uniform(-1, 1, (2, 1)).astype(np.float32)
        one, other = first.step(command), second.step(command)
        np.testing.assert_array_equal(one.observation, other.observation)
        first.begin(np.flatnonzero(one.ended).tolist())
        second.begin(np.flatnonzero(other.ended).tolist())
    np.testing.assert_array_equal(first.observation, second.observation)
    # A body that answers otherwise than it did begins anew, and says so.
    moved = first.snapshot._replace(observation=first.observation + 1)
    assert not Bodies(robot, [(7, 0), (7, 1)]).restore(moved)


def test_dependence_on_earlier_episodes_is_reported() -> None:
    robot = named("Remembers")
    assert not robot.keeps_state and BodiesSnapshot.initial(robot, 3).commands.shape == (3, 0, 1)
    (caveat,) = robot.caveats()
    assert "episodes restart at each checkpoint" in caveat and named("Slider").caveats() == ()


@pytest.mark.oracle
def test_what_was_held_in_an_episode_that_is_not_continued_does_not_count_in_the_next() -> None:
    """The first half of the environments never holds an action itself."""
    on_host = OnHost(training(named("Remembers")).environment(0), SMALL)
    learners = on_host.begin(jnp.stack([jax.random.fold_in(jax.random.key(1), 0)]))
    held = learners.exploration
    held = held._replace(left=jnp.full_like(held.left, 5.0), was_held=jnp.ones_like(held.was_held))
    after, _ = on_host.train(learners._replace(exploration=held), None, jnp.int32(0), jnp.int32(1))
    n = SMALL.environments // 2
    assert not after.exploration.was_held[0, :n].any() and (after.exploration.left[0, :n] <= 0).all()


def test_alike_actors_have_the_same_episodes() -> None:
    environment = WithoutNeurons(named("Levels"), (-2 / 3, 0.0, 2 / 3))
    for alike in (True, False):
        ran = roll_out(environment, None, Constant(jnp.array([1, 1, 2])), episodes=5, seed=4, alike=alike)
        assert np.array_equal(ran.returns[0], ran.returns[1]) == alike
        assert not np.array_equal(ran.returns[0], ran.returns[2])


class Stopping:
    """A progress that ends the training after some chunks, like a kill."""

    def __init__(self, chunks: int) -> None:
        self.chunks = chunks

    def update(self, done: float, total: float, note: str = "") -> None:
        if done == self.chunks:
            raise KeyboardInterrupt


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("name", "mapping", "iterations"),
    [("Slider", None, 1_200), ("Levels", Thresholds(1), 2_400), ("Remembers", None, 2_400)],
)
def test_stopped_and_started_again_it_ends_in_the_same_bits(
    name: str, mapping: Any, iterations: int, tmp_path: Path
) -> None:
    timeline = None if mapping is None else timeline_of()
    asked = training(named(name), mapping, iterations=iterations)
    description = describe_training(asked, timeline)
    group = Group(asked, (0, 1), timeline, description["fingerprint"], {})
    undisturbed = train_group(group, None, Stopping(10**9))
    checkpoint = tmp_path / "checkpoint.npz"
    for chunks in (1, 7, 31):
        with pytest.raises(KeyboardInterrupt):
            train_group(group, checkpoint, Stopping(chunks), checkpoint_s=0.0)
    again = train_group(group, checkpoint, Stopping(10**9))
    for one, other in zip(undisturbed, again, strict=True):
        for a, b in zip((*one.weights, one.learning_curve), (*other.weights, other.learning_curve), strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(undisturbed[0].weights[0], undisturbed[1].weights[0])
    episodes = undisturbed[0].learning_curve[:, 1].sum()
    assert 0 < episodes <= iterations


@pytest.mark.oracle
def test_it_learns_what_can_be_learned(tmp_path: Path) -> None:
    """To stay in the middle: any other place is rewarded less, and random commands drift away by their mean."""
    asked = training(named("Slider"), policies=1, iterations=16_000, algorithm=replace(SMALL, hidden=32, batch=64))
    policies = trained(asked, None, tmp_path)
    table = evaluate(policies, None, episodes=20)
    of_policy, of_random = (row.mean_returns.mean() for row in table.rows[:2])
    # It needs some steps from where it starts, 0.25 away on average, at up to 0.1 or 0.3 a step.
    assert of_policy > -1.5 and of_random < -10
    assert "best_return" not in table.to_text() and isinstance(
        Policy.load(tmp_path / "p0.safetensors").robot, GymnasiumRobot
    )


def test_evaluation_counts_whole_episodes_whatever_their_number() -> None:
    robot = named("Slider")
    environment = WithoutNeurons(robot, (-0.5, 1.0))
    # -0.5 is an action of 0: it stays about where it starts; 1 is one of 3: it goes beyond 2 within 9 steps.
    still, away = (roll_out(environment, None, Constant(jnp.array([i])), episodes=70, seed=4) for i in (0, 1))
    assert not still.terminated.any() and np.all(still.lengths == 20)
    assert away.terminated.all() and away.lengths.min() >= 5 and away.lengths.max() <= 9
    fewer = roll_out(environment, None, Constant(jnp.array([0])), episodes=64, seed=4)
    np.testing.assert_array_equal(still.returns[:, :64], fewer.returns)
    bodies = Bodies(robot, [(4, 0, i) for i in range(70)])
    starts = np.abs(bodies.begin()[:, 0])
    assert np.corrcoef(starts, -still.returns[0])[0, 1] > 0.9


@pytest.mark.oracle
def test_through_neurons_conditions_are_counted_and_the_optimum_needs_a_grid(tmp_path: Path) -> None:
    policies = trained(training(named("Levels"), Thresholds(1)), timeline_of(), tmp_path)
    table = evaluate(policies, timeline_of(), episodes=6, optimum_resolution=1.0)
    assert table.no_optimum is not None and "value_grid" in table.no_optimum
    row = table.rows[0]
    assert row.episodes.presented.sum() == row.episodes.lengths.sum()
    assert {"silent", "shuffled", "random"} <= {row.name for row in table.rows}
    with pytest.raises(InvalidArgument, match="value_grid"):
        best_return(WithoutNeurons(named("Slider"), None), None)


def test_a_runner_starts_the_same_number_in_the_same_state() -> None:
    runner = HostRunner(named("Slider"), np.random.default_rng(2))
    start = runner.reset(3)
    after = runner.step(0.5)
    runner.reset(4)
    np.testing.assert_array_equal(runner.reset(3), start)
    np.testing.assert_array_equal(runner.step(0.5).observation, after.observation)


FAULTS = {
    "Dict": "expected an action space of kind Box or Discrete, got Dict",
    "MultiBinary": "expected an action space of kind Box or Discrete, got MultiBinary",
    "Unbounded": "expected actions with finite bounds",
    "ManyLevels": "expected at most 1,024 actions, got 2,000",
    "NoDimension": "expected actions of 1 to 64 dimensions, got 0",
    "ManyDimensions": "expected actions of 1 to 64 dimensions, got 65",
    "DictSeen": "expected an observation space of kind Box, got Dict",
    "Endless": "expected an episode limit, got an environment without one: --parameters episode_limit=1000",
    "Nan": "expected finite observations, got NaN or infinite ones",
    "NanReward": "expected finite rewards, got NaN or infinite ones",
    "Raises": "expected step to succeed, got ZeroDivisionError: a wheel came off",
    "Short": "expected observations of 2 numbers, got one of 1",
    "Starts": "expected observations of 2 numbers, got one of 1",
    "Nowhere": "NameNotFound: Environment `Nowhere` doesn't exist",
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_cannot_be_a_body_is_refused_in_one_line_before_training(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["train", f"{TOY}{name}-v0", "--mapping", "none", "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert code != 0 and error.count("\n") == 1 and "Traceback" not in error
    assert FAULTS[name] in error and f"{TOY}{name}-v0" in error, error
    assert not (tmp_path / "out").exists()
    assert main(["robots", f"{TOY}{name}-v0"]) == code
    assert capsys.readouterr().err == error


def test_a_limit_is_known_under_an_environments_own_wrappers() -> None:
    robot = named("Wrapped")
    assert robot.episode_limit == 20
    longer = HostRunner(GymnasiumRobot.named("bodies_of_others:Wrapped-v0", episode_limit=50), np.random.default_rng(2))
    longer.reset(0)
    assert not any(longer.step(0.0).truncated for _ in range(30))


def test_episodes_that_would_never_end_are_refused_before_training() -> None:
    robot = named("Remembers")
    assert not robot.keeps_episodes
    enough = CHUNKS * 4 * robot.episode_limit
    few = Training(robot, None, policies=1, iterations=enough // 2, algorithm=SAC(environments=4))
    with pytest.raises(InvalidArgument, match=f"iterations: expected {enough:,} or more, or an episode_limit of 10 or"):
        expect_trainable(few, is_saved=False)
    expect_trainable(replace(few, iterations=enough), is_saved=False)


@pytest.mark.oracle
def test_versions_of_all_packages_behind_a_body_are_reported() -> None:
    description = describe_training(Training(robot_named("gymnasium:Pendulum-v1"), None), None)
    assert description["versions"]["gymnasium"] == importlib.metadata.version("gymnasium")
    assert description["versions"]["learner"] == f"revision {LEARNER}"


def test_a_module_that_is_not_installed_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for id, words in (
        ("no_such_package.envs:Rover-v0", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("Pendulum-v99", "Pendulum-v99"),
        ("", "expected gymnasium: and an environment's id"),
    ):
        assert main(["train", f"gymnasium:{id}", "--mapping", "none", "--out", str(tmp_path / "out")]) != 0
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1


@pytest.mark.oracle
@pytest.mark.parametrize(("name", "words"), [("Raises", "a wheel came off"), ("Nan", "NaN"), ("Hangs", "it hangs")])
def test_a_fault_in_training_costs_nothing_that_was_finished(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host, "PATIENCE_S", 0.5 if name == "Hangs" else 120.0)
    sound = replace(named("Slider"), id=f"bodies_of_others:{name}-v0", settings=(("after", 400.0),))
    asked = training(sound, policies=1)
    checkpoint = tmp_path / "checkpoint.npz"
    group = Group(asked, (0,), None, "x", {})
    with pytest.raises(BodyFailed, match=words):
        train_group(group, checkpoint, Stopping(10**9), checkpoint_s=0.0)
    assert checkpoint.exists()
    # Mended, it goes on from there; the number of the body's steps is of this process alone.
    monkeypatch.setattr(bodies_of_others.Slider, "_break", lambda self: None)
    monkeypatch.setattr(bodies_of_others.Slider, "_seen", lambda self: np.array([self.at, self.gain], np.float32))
    assert train_group(group, checkpoint, Stopping(10**9), checkpoint_s=0.0)


@pytest.mark.oracle
def test_it_trains_evaluates_and_is_listed_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    arguments = ["gymnasium:Pendulum-v1", "--mapping", "none", "--policies", "1", "--iterations", "200"]
    assert main(["train", *arguments, "--parameters", "g=9.5", "--workers", "1", "--out", out]) == 0
    assert "1 policy in" in capsys.readouterr().out
    before = bits(tmp_path / "out")
    assert main(["train", *arguments, "--parameters", "g=9.5", "--workers", "1", "--out", out]) == 0
    assert bits(tmp_path / "out") == before and "is already finished" in capsys.readouterr().out
    assert Policy.load(tmp_path / "out" / "p0.safetensors").robot.settings == (("g", 9.5),)  # type: ignore[attr-defined]
    assert main(["evaluate", out, "--episodes", "2", "--robot", "gymnasium:Pendulum-v1"]) == 0
    assert "gymnasium:Pendulum-v1, without neurons: 1 policy, 2 episodes each" in capsys.readouterr().out
    assert main(["robots", "gymnasium:Acrobot-v1"]) == 0
    assert "observation_5 (1)" in capsys.readouterr().out


@pytest.mark.oracle
def test_mujoco_bodies_are_trained(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    robot = robot_named("gymnasium:Reacher-v5")
    assert isinstance(robot, GymnasiumRobot) and robot.keeps_state and robot.n_commands == 2
    policies = trained(training(robot, policies=1, iterations=400), None, tmp_path)
    row = roll_out(WithoutNeurons(robot, None), None, networks_of(list(policies.values())), episodes=3, seed=1)
    assert np.all(row.lengths == 50) and np.all(np.isfinite(row.returns))
    random = roll_out(WithoutNeurons(robot, None), None, Uniform(), episodes=3, seed=1)
    assert not np.array_equal(random.returns, row.returns)


def test_a_body_that_exits_is_reported_like_one_that_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def leave(self: Any) -> None:
        raise SystemExit(0)

    bodies = Bodies(replace(named("Slider"), settings=(("after", 0.0),)), [(1,)])
    bodies.begin()
    monkeypatch.setattr(bodies_of_others.Slider, "_break", leave)
    with pytest.raises(BodyFailed, match=r"Slider-v0: expected step to succeed, got SystemExit"):
        bodies.step(np.zeros((1, 1)))
    monkeypatch.setattr(bodies_of_others.Slider, "_seen", leave)
    with pytest.raises(BodyFailed, match=r"Slider-v0: expected reset to succeed, got SystemExit"):
        bodies.begin()


@pytest.mark.oracle
def test_replay_may_take_longer_than_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = named("Slider")
    first = Bodies(robot, [(1,), (2,)])
    first.begin()
    for _ in range(15):
        first.step(np.zeros((2, 1), np.float32))
    monkeypatch.setattr(host, "PATIENCE_S", 0.2)
    monkeypatch.setattr(bodies_of_others.Slider, "_seen", slowly(bodies_of_others.Slider._seen))
    second = Bodies(robot, [(1,), (2,)])
    assert second.restore(first.snapshot)


def slowly(call: Any) -> Any:
    def called(*arguments: Any) -> Any:
        time.sleep(0.02)
        return call(*arguments)

    return called


@pytest.mark.oracle
def test_the_alarm_of_others_and_bodies_that_catch_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = named("Slider")

    def swallows() -> None:
        for _ in range(2):
            with contextlib.suppress(BaseException):
                time.sleep(5)

    monkeypatch.setattr(host, "PATIENCE_S", 0.1)
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        signal.setitimer(signal.ITIMER_REAL, 100.0)
        assert host.call_body(robot, "step", lambda: 3) == 3
        assert 0 < signal.getitimer(signal.ITIMER_REAL)[0] <= 100.0
        with pytest.raises(BodyFailed, match="it hangs"):
            host.call_body(robot, "step", lambda: (swallows(), time.sleep(5)))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.oracle
def test_a_body_that_cuts_itself_off_early_does_not_end_the_return(monkeypatch: pytest.MonkeyPatch) -> None:
    step = bodies_of_others.Slider.step

    def cut_off_at_five(self: Any, action: Any) -> Any:
        observation, reward, ended, _, info = step(self, action)
        return observation, reward, ended, self.steps % 5 == 0, info

    monkeypatch.setattr(bodies_of_others.Slider, "step", cut_off_at_five)
    robot = replace(named("Slider", gain=0.0), episode_limit=8)
    asked = training(robot, policies=1, iterations=480)
    on_host = OnHost(asked.environment(0), SMALL)
    learners, finished = on_host.train(on_host.begin(jax.random.split(jax.random.key(1), 1)), None, 0, 12)
    assert finished.episodes.sum() > 0
    # Of each transition the last number; no body ever ended by itself, nor came to the limit.
    assert not np.asarray(learners.replay)[0, : 12 * SMALL.environments, -1].any()
    assert (np.asarray(learners.episodes.robot.iterations) < 5).all()


def test_a_limit_of_zero_and_episodes_too_long_to_keep_are_reported() -> None:
    with pytest.raises(InvalidArgument, match="episode_limit: expected at least 1, got 0"):
        named("Slider", episode_limit=0)
    robot = named("Slider", episode_limit=host.LONGEST_KEPT + 1)
    (caveat,) = robot.caveats()
    assert "20,001 iterations" in caveat and not BodiesSnapshot.initial(robot, 2).commands.size


def test_settings_are_numbers_and_whole_ones_stay_whole() -> None:
    """`frame_skip=5` must reach MuJoCo as a whole number, also from a file, which has 5.0."""
    robot = named("Slider", after=200)
    assert robot.settings == (("after", 200.0),) and robot_from_dict(robot_to_dict(robot)) == robot
    for made in (robot, replace(robot, settings=(("after", 200.0), ("gain", 0.25)))):
        environment = made.body()._env.unwrapped  # type: ignore[attr-defined]
        assert type(environment.after) is int and type(environment.gain) is float
    for value in ([1], "many", True):
        with pytest.raises(InvalidArgument, match="bodies_of_others:Slider-v0: after: expected a number, got"):
            named("Slider", after=value)
    with pytest.raises(InvalidArgument, match=r"episode_limit: expected a whole number, got \[9\]"):
        named("Slider", episode_limit=[9])


@pytest.mark.filterwarnings("ignore:.*unversioned environment:UserWarning")
def test_an_id_without_a_version_is_refused_in_one_line() -> None:
    with pytest.raises(InvalidArgument, match=r"gymnasium:CartPole: expected a Gymnasium environment.* id: CartPole$"):
        robot_named("gymnasium:CartPole")


def test_the_name_of_a_body_needs_none_of_its_parameters() -> None:
    # Made without parameters it has no limit, and is refused.
    assert REGISTRY.name_of(f"{TOY}Endless-v0") == named("Endless", episode_limit=9).name
    with pytest.raises(InvalidArgument, match="No module named 'nobody_has_this'"):
        REGISTRY.name_of("gymnasium:nobody_has_this:Rover-v0")


def test_an_episode_of_two_commands_is_kept_whole() -> None:
    """What a study keeps of an episode: one number per command, and the body's resulting path."""
    robot = named("Pair")
    environment = WithoutNeurons(robot, None)
    actors = Coupling(jnp.asarray([[[1.0, 0.5], [-2.0, 0.0]], [[0.0, -0.3], [3.0, 0.1]]]), None, None, "graded", (0,))
    kept = record_paths(environment, None, actors, seed=3)
    assert kept.commands.shape == (2, 20, 2) and kept.observations.shape == (2, 21, 2)
    for actor, (observations, commands) in enumerate(kept.episodes()):
        body = Bodies(robot, [(3, actor)])
        body.begin()
        for seen, command in zip(observations[1:], commands, strict=True):
            np.testing.assert_array_equal(body.step(np.array([command], np.float32)).observation[0], seen)
