"""A goal from the command line to the outcome of episodes: training, files, evaluation, studies, the loop."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.loop import Loop
from animat.coding.mapping import Thresholds
from animat.environment import WithoutNeurons
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.evaluation.rollouts import Constant, roll_out
from animat.evaluation.table import evaluate
from animat.execution.training import train
from animat.goals.robot import with_goal
from animat.reality_gap.session_responses import outcomes
from animat.responses.condition import Condition
from animat.robots import Cartpole, Navigation
from animat.studies.episodes import episode_rows, goals_met, read_episodes, write_episodes
from animat.studies.folder import describe_study
from animat.studies.specification import Arm, RobotSpec, Study
from animat.studies.toml import read_study, study_to_toml
from animat.training.folder import describe_training, expect_folder_for, write_description
from animat.training.policy import Policy
from animat.training.sac import begin, train_chunk
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.wrappers import EpisodeLimit

GOAL = "avoid pole_angle outside -12..12 deg; avoid cart_position outside -0.5..0.5 m; drive cart_position in -9..9 cm"
TINY = SAC(environments=4, gradient_steps=1, batch=8, replay=64, hidden=4)


@pytest.mark.oracle
def test_what_is_learned_from_is_shaped_and_what_is_reported_is_not() -> None:
    robot = with_goal("navigation", "reach x, y around 0.7, 0.7 radius 0.1 m")
    environment = EpisodeLimit(WithoutNeurons(robot, (-1.0, 1.0)))
    learner = begin(environment, TINY, jax.random.key(1))
    before = jax.vmap(robot.potential)(learner.episodes.robot)
    learner, _ = train_chunk(environment, TINY, learner, None, jnp.int32(0), jnp.int32(1))
    after = jax.vmap(robot.potential)(learner.episodes.robot)
    np.testing.assert_allclose(learner.returns, -1.0)
    learned_from = np.asarray(learner.replay[: TINY.environments, -2])
    np.testing.assert_allclose(learned_from, TINY.reward_scale * (-1 + TINY.discount * after - before), rtol=1e-4)
    assert np.all(np.abs(learned_from + TINY.reward_scale) > 1e-3)


def test_trainings_are_described_with_their_goal() -> None:
    plain = Training(Cartpole(), None)
    assert "goal" not in plain.to_dict() and plain.to_dict()["robot"]["name"] == "cartpole"
    data = Training(with_goal("cartpole", GOAL), None).to_dict()
    assert {**data, "goal": None} == {**plain.to_dict(), "goal": None} and data["goal"] == GOAL
    own = Study(robots=(RobotSpec("cartpole"),))
    assert "goal" not in study_to_toml(own)


@pytest.mark.oracle
def test_policies_carry_their_goal_and_are_evaluated_with_it(tmp_path: Path) -> None:
    robot = with_goal("cartpole", GOAL)
    training = Training(robot, None, policies=1, iterations=64, commands=(-1.0, 1.0), algorithm=TINY)
    trained = train(training, None, None)
    trained["p0"].save(tmp_path / "p0.safetensors")
    assert Policy.load(tmp_path / "p0.safetensors").robot == robot
    write_description(tmp_path, describe_training(training, None))
    expect_folder_for(training, tmp_path)
    with pytest.raises(Mismatch, match="goal"):
        expect_folder_for(replace(training, robot=with_goal("cartpole", GOAL + " weight 2")), tmp_path)
    evaluation = evaluate(trained, None, episodes=3, controls=("heuristic",))
    data = evaluation.to_dict()
    assert data["objectives"] == GOAL.split("; ")
    heuristic = next(row for row in data["rows"] if row["name"] == "heuristic")
    assert heuristic["success_share"] == 1 and heuristic["satisfaction_percent"] == pytest.approx([100] * 3)
    text = evaluation.to_text()
    assert re.search(r"ended early\s+success\s+satisfied\s+margin", text)
    assert "drive cart_position in -9..9 cm: " in text
    plain = replace(evaluation, objectives=())
    assert "success" not in plain.to_text() and "objectives" not in plain.to_dict()


def test_a_fingerprint_includes_the_goal() -> None:
    trainings = [Training(robot, None) for robot in (Cartpole(), with_goal("cartpole", GOAL))]
    assert len({describe_training(each, None)["fingerprint"] for each in trainings}) == 2
    studies = [Study(robots=(RobotSpec("cartpole", goal=goal),)) for goal in (None, GOAL)]
    assert len({describe_study(each, {})["fingerprint"] for each in studies}) == 2


@pytest.mark.oracle
def test_the_command_line_takes_a_goal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "policies")
    sac = [f"{name}={getattr(TINY, name)}" for name in ("environments", "gradient_steps", "batch", "replay", "hidden")]
    given = ["cartpole", "--mapping", "none", "--policies", "1", "--iterations", "64", "--out", out, "--sac", *sac]
    assert main(["train", *given, "--workers", "1", "--goal", GOAL]) == 0
    capsys.readouterr()
    assert main(["evaluate", out, "--episodes", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["objectives"] == GOAL.split("; ")
    assert main(["train", *given, "--goal", "drive cart_positon in -10..10 cm"]) == 1
    error = capsys.readouterr().err
    assert "did you mean cart_position?" in error and error.count("\n") == 1


def test_a_study_has_a_goal_in_its_file(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(f'[[robots]]\nname = "cartpole"\ngoal = """\n{GOAL.replace("; ", chr(10))}\n"""\n')
    study = read_study(file)
    assert study.robots[0].robot() == with_goal("cartpole", GOAL)
    file.write_text(study_to_toml(study))
    assert read_study(file) == study
    file.write_text('[[robots]]\nname = "cartpole"\ngoal = "drive x in 0..1 m"\n')
    with pytest.raises(InvalidFile, match="of cartpole: expected a quantity among") as error:
        read_study(file)
    assert "\n" not in str(error.value)


@pytest.mark.oracle
def test_a_study_tabulates_how_far_each_objective_was_met(tmp_path: Path) -> None:
    goal = "avoid cart_position above 0.1 m; minimize cart_velocity below 0 m/s"
    specs = (RobotSpec("cartpole", goal=goal), RobotSpec("navigation"))
    parts, ran = [], {}
    for spec in specs:
        ran[spec.name] = roll_out(
            WithoutNeurons(spec.robot(), (-0.1, 0.1)), None, Constant(jnp.array([0, 1])), episodes=2, seed=1
        )
        labels = {"robot": spec.name, "arm": "a", "at_min": 0.0}
        parts.append(write_episodes(tmp_path / f"{spec.name}.npz", [episode_rows(ran[spec.name], **labels)]))
    table = read_episodes(parts)
    rows = list(goals_met(Study(robots=specs, arms=(Arm("a"),)), table))
    assert [(row.robot, row.objective) for row in rows] == [("cartpole", each) for each in goal.split("; ")]
    outcome = ran["cartpole"].outcome
    assert outcome is not None and 0 < np.mean(outcome.succeeded) < 1
    for i, row in enumerate(rows):
        assert row.episodes == 4 and row.success_share == np.mean(outcome.succeeded)
        assert row.margin == pytest.approx(np.mean(outcome.margin))
        assert row.satisfaction == pytest.approx(np.mean(np.asarray(outcome.satisfaction)[..., i]))
    assert "succeeded" not in read_episodes(parts[1:])


def test_a_robots_goals_do_not_depend_on_robots_without_goals(tmp_path: Path) -> None:
    specs = (RobotSpec("cartpole", goal="avoid cart_position above 0.1 m"), RobotSpec("navigation"))
    shape, files = (1, 200), []
    margin = np.random.default_rng(1).uniform(size=shape).astype(np.float32)
    outcome = SimpleNamespace(succeeded=margin > 0.5, margin=margin, satisfaction=100 * margin[..., None])
    for spec, of in zip(specs, (outcome, None), strict=True):
        ran: Any = SimpleNamespace(returns=margin, lengths=np.ones(shape), terminated=margin > 0.5, outcome=of)
        rows = episode_rows(ran, robot=spec.name, arm="a", at_min=0.0)
        files.append(write_episodes(tmp_path / f"{spec.name}.npz", [rows]))
    study = Study(robots=specs, arms=(Arm("a"),))
    (together,), (alone,) = (list(goals_met(study, read_episodes(some))) for some in (files, files[:1]))
    assert together == alone
    assert alone.margin == pytest.approx(np.mean(margin, dtype=np.float64), rel=1e-14)


def test_a_closed_loop_reports_outcomes_of_whole_episodes_by_observations() -> None:
    robot = with_goal(Navigation(episode_limit=3), "reach x above 0.5 m")
    starts = [(0.0, 0.0, 0.0)] * 3
    paths = [[0.2, 0.6], [0.2, 0.3, 0.4], [0.2]]
    ticks = []
    for number, path in enumerate(paths):
        # A stimulus of the warm-up moves nothing, nor does one whose response was a burst.
        ticks.append(SimpleNamespace(episode=number, reward=None, observation=()))
        ticks += [SimpleNamespace(episode=number, reward=-1.0, observation=(x, 0.0, 0.0)) for x in path]
    episodes: Any = [
        SimpleNamespace(number=i, start=start, is_whole=i < 2) for i, start in enumerate(starts)
    ]  # the last one was broken off
    session: Any = SimpleNamespace(episodes=episodes, ticks=ticks)
    found = outcomes(robot, session)
    assert list(found) == [0, 1] and [bool(each.succeeded) for each in found.values()] == [True, False]
    np.testing.assert_allclose([each.margin for each in found.values()], [0.1, -0.1], atol=1e-6)
    assert outcomes(Navigation(), session) == {}


def test_the_log_of_a_session_has_the_goal() -> None:
    conditions = tuple(Condition(f"{f:g} Hz", f, "Hz", (f,)) for f in (5.0, 10.0))
    robots = (Cartpole(), with_goal("cartpole", GOAL))
    loops = [Loop(robot, Thresholds(1), conditions, np.arange(11.0)).to_dict() for robot in robots]  # type: ignore[arg-type]
    assert loops[1]["goal"] == GOAL and loops[1]["robot"] == loops[0]["robot"] and "goal" not in loops[0]


def test_a_goal_in_a_damaged_file_is_reported(tmp_path: Path) -> None:
    from animat.goals.robot import robot_of

    with pytest.raises(InvalidArgument, match="did you mean avoid"):
        robot_of({"robot": {"name": "cartpole", "parameters": {}}, "goal": "avod pole_angle above 1 rad"})
