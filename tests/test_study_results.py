"""A study's tables: for returns whose order is known, for episodes run separately, and for a real recording."""

from __future__ import annotations

import csv
import json
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from animat.cli import main
from animat.coding.mapping import Thresholds
from animat.environment import Animat
from animat.errors import InvalidFile
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import Episodes, networks_of, roll_out
from animat.evaluation.statistics import holm
from animat.neurons.simulator import fit_histogram
from animat.neurons.synthetic import synthetic_simulator
from animat.neurons.timeline import SimulatorTimeline, fit_timeline
from animat.progress import Silent
from animat.recordings.reading import read_recordings
from animat.report.results import ComparedReturns, Results, Score, StudyOptimum
from animat.responses.extraction import extract_series
from animat.robots import Navigation
from animat.studies.episodes import COLUMNS, RANDOM, Paths, episode_rows, mean_returns, read_episodes, write_episodes
from animat.studies.evaluating import EvaluateArm
from animat.studies.folder import RESULTS, controls_file, episodes_file, optima_file, table_file
from animat.studies.optima import FindOptima, read_optima
from animat.studies.pictures import _courses, _minutes_in_training, paths_rows
from animat.studies.recording import FitSimulators, MakeRecordings
from animat.studies.report_tables import optima_table
from animat.studies.results import read_typed, write_table, write_typed
from animat.studies.source import Source
from animat.studies.specification import Arm, Compared, RobotSpec, Study, mapping_label
from animat.studies.tabulating import References, Tabulate, _comparisons, _controls, _finite, _optimum_error, _scores
from animat.studies.task import study_seed
from animat.studies.training import TrainArm
from animat.training.policy import Policy, load_policies
from animat.wrappers import ShuffledDelivery

# --- which side is better -------------------------------------------------------------------------------------------

TIMELINE = SimulatorTimeline(synthetic_simulator(), np.array([0.0, 10.0]), (), (2.0, 10.0), None, (), ())
"""Of two recordings whose simulators are of no interest."""
HERE, RECORDED = Path(__file__).parent, Source("files", files=("data/tiny",))
WORSE = Arm("worse", mapping="none", trained=False)
BETTER = Arm("better", mapping="none", trained=False)
LIKE = Arm("like", mapping="none", trained=False)
RETURNS = {
    "worse": [-80.0, -75.0, -70.0, -72.0, -78.0, -74.0],
    "better": [10.0, 12.0, 8.0, 15.0, 9.0, 11.0],
    "like": [11.0, 9.5, 8.5, 14.0, 10.5, 10.2],
}


def compared_returns(folder: Path, *comparisons: Compared) -> tuple[ComparedReturns, ...]:
    """The comparisons of synthetic returns of six policies: two episodes each, one below and one above."""
    study = Study(
        robots=(RobotSpec("cartpole"), RobotSpec("navigation")),
        arms=(WORSE, BETTER, LIKE),
        comparisons=comparisons,
        policies=6,
        episodes=2,
    )
    for spec in study.robots:
        for arm in study.arms:
            # A third episode, that no comparison asks for, would turn every order around.
            returns = np.array([[mean - 1.0, mean + 1.0, -4.0 * mean] for mean in RETURNS[arm.name]])
            table = episode_rows(episodes_of(returns), robot=spec.name, arm=arm.name, at_min=0.0)
            write_episodes(episodes_file(folder, spec, arm), [table])
        write_random(folder, spec, LIKE, 0.0)
        optimum = StudyOptimum(spec.name, "none", "moving", 0.0, 20.0, None, None, 0.1, 20.0, 0.1, 20.0, 0.1, 100, None)
        write_typed(optima_file(folder, spec.name), [optimum])
    Tabulate(study).run(folder, Silent())
    results = read_typed(folder / RESULTS, Results)
    with table_file(folder, "comparisons").open(newline="") as file:
        assert [row["u"] for row in csv.DictReader(file)] == [str(row.u) for row in results.comparisons]
    assert not table_file(folder, "goals").exists(), "no robot of the study has a goal"
    return results.comparisons


def write_random(folder: Path, spec: RobotSpec, arm: Arm, *minutes: float) -> None:
    """Controls of which only random is there: one episode a minute, with a return of -80."""
    ran, through = episodes_of(np.array([[-80.0]])), mapping_label(arm.mapping, arm.percentiles)
    tables = [episode_rows(ran, robot=spec.name, arm=through, agent=RANDOM, at_min=at_min) for at_min in minutes]
    write_episodes(controls_file(folder, spec, arm), tables)


def episodes_of(returns: np.ndarray) -> Episodes:
    """Episodes of ten iterations each."""
    none = np.zeros((*returns.shape, 0), np.int64)
    return Episodes(
        returns, np.full(returns.shape, 10), np.zeros(returns.shape, bool), none, none[:, 0].astype(np.float64)
    )


def test_the_table_of_episodes_has_a_row_for_each(tmp_path: Path) -> None:
    returns, terminated = np.array([[1.0, 2.5], [-3.0, 0.1]]), np.array([[True, False], [False, False]])
    ran = replace(episodes_of(returns), terminated=terminated)
    parts = [episode_rows(ran, robot="cartpole", arm="a b", at_min=at_min) for at_min in (0.0, 10.5)]
    other = episode_rows(ran, robot="cartpole", arm="1-threshold", agent="silent", at_min=0.0, over_time=True)
    files = [write_episodes(tmp_path / "a.npz", parts), write_episodes(tmp_path / "b.npz", [other])]
    table = read_episodes(files)
    assert tuple(table) == COLUMNS and len(table) == 12
    rows = table[(table["arm"] == "a b") & (table["at_min"] == 10.5)]
    assert list(zip(rows["actor"], rows["episode"], rows["return"], rows["ended"], strict=True)) == [
        (0, 0, 1.0, "terminated"), (0, 1, 2.5, "truncated"), (1, 0, -3.0, "truncated"), (1, 1, 0.1, "truncated"),
    ]  # fmt: skip
    assert table["agent"].tolist() == ["policy"] * 8 + ["silent"] * 4
    assert table["over_time"].tolist() == [False] * 8 + [True] * 4
    assert mean_returns(rows).tolist() == [1.75, -1.45] and mean_returns(rows, 1).tolist() == [1.0, -3.0]
    written = files[0].read_bytes()
    write_episodes(files[0], parts)
    assert files[0].read_bytes() == written
    files[1].write_bytes(written[:100])
    with pytest.raises(InvalidFile, match=r"b\.npz: expected arrays of this study"):
        read_episodes(files)


def test_the_better_side_is_named_and_the_effect_has_its_sign(tmp_path: Path) -> None:
    up = Compared("up", "worse", "better", episodes=2)
    down = Compared("down", "better", "worse", episodes=2)
    by_name = {(row.comparison, row.robot): row for row in compared_returns(tmp_path, up, down)}
    for robot in ("cartpole", "navigation"):
        rising, falling = by_name["up", robot], by_name["down", robot]
        assert (rising.outcome, falling.outcome) == ("second better", "first better")
        assert rising.effect == -falling.effect != 0
        assert rising.u == falling.u == 0
        assert rising.mean_first == falling.mean_second == pytest.approx(np.mean(RETURNS["worse"]))
        assert rising.mean_second == falling.mean_first == pytest.approx(np.mean(RETURNS["better"]))
        assert rising.score_second == pytest.approx((rising.mean_second + 80) / 100)
        assert rising.as_in_paper is None, "the study is not the paper's"


def test_sides_that_are_alike_are_not_ordered_and_all_robots_count_for_holm(tmp_path: Path) -> None:
    rows = compared_returns(
        tmp_path, Compared("alike", "better", "like", episodes=2), Compared("up", "worse", "better", episodes=2)
    )
    assert all("better" not in row.outcome for row in rows if row.comparison == "alike")
    corrected = holm({f"{row.comparison}/{row.robot}": row.p_normal for row in rows})
    assert len(corrected) == 4
    assert [row.p_holm for row in rows] == [corrected[f"{row.comparison}/{row.robot}"] for row in rows]


def test_means_and_errors_of_arms_and_controls_are_those_counted_by_hand(tmp_path: Path) -> None:
    """Policies and controls with several actors are judged by each one's mean, and others by their episodes."""
    # The first has the name of its mapping, under which the controls are listed.
    arms = Arm("1-threshold"), Arm("new", trained=False), Arm("control", delivery="shuffled")
    study = Study(robots=(RobotSpec("cartpole"),), arms=arms, policies=3, episodes=2)
    (spec,) = study.robots
    run = [
        ("1-threshold", "policy", [[1.0, 3.0], [5.0, 7.0], [0.0, 8.0]]),
        ("new", "policy", [[1.0, 2.0]]),
        ("control", "policy", [[-6.0, -4.0]]),
        ("1-threshold", "random", [[-10.0, 0.0, 10.0, -20.0]]),
        ("1-threshold", "silent", [[0.0, 2.0], [4.0, 6.0]]),
        ("1-threshold", "shuffled", [[-5.0, -5.0], [-6.0, -6.0]]),
        ("1-threshold", "constant", [[7.0]]),
    ]
    of_one = [
        episode_rows(episodes_of(np.array(returns)), robot="cartpole", arm=arm, agent=agent, at_min=0.0)
        for arm, agent, returns in run
    ]
    later = [of_one[0].assign(**{"return": 1000.0, "over_time": True}), of_one[2].assign(robot="another")]
    optimum = StudyOptimum("cartpole", "1-threshold", "moving", 0.0, 20.0, None, None, 0.5, 15.0, 0.1, *[None] * 4)
    write_typed(optima_file(tmp_path, "cartpole"), [optimum])
    known = References(study, tmp_path, spec, pd.concat([*of_one, *later]))
    trained, new, control = _scores(known, 0.0, 0.0)
    # The means are 2, 6 and 4.
    assert (trained.policies, trained.episodes, trained.mean_return, trained.standard_deviation) == (3, 2, 4.0, 2.0)
    assert (trained.random, trained.optimum, trained.normalised_score) == (-5.0, 20.0, pytest.approx(9 / 25))
    assert (new.policies, new.mean_return, new.standard_deviation) == (1, 1.5, None)
    assert (control.random, control.optimum, control.normalised_score) == (-5.0, None, None)
    rows = [(row.control, row.actors, row.mean_return, row.standard_error) for row in _controls(known)]
    assert rows == [
        ("trained: 1-threshold", 3, 4.0, pytest.approx(2 / 3**0.5)),
        ("trained: control", 1, -5.0, None),
        ("random", 1, -5.0, pytest.approx((500 / 3 / 4) ** 0.5)),
        ("silent", 2, 3.0, pytest.approx(2.0)),
        ("shuffled", 2, -5.5, pytest.approx(0.5)),
        ("constant", 1, 7.0, None),
    ]
    # Where choices have no effect the optimum is a different one, which is not known: as in `animat evaluate`.
    scored = {row.control: row.normalised_score for row in _controls(known) if row.optimum == 20.0}
    assert scored == {"trained: 1-threshold": pytest.approx(9 / 25), "random": 0.0, "constant": pytest.approx(12 / 25)}
    assert {row.normalised_score for row in _controls(known) if row.optimum is None} == {None}
    compared = replace(study, comparisons=(Compared("learned", "control", "1-threshold"),))
    (row,) = _comparisons(compared, 0.0, [known])
    assert (row.random_second, row.optimum_first, row.optimum_second) == (-5.0, None, 20.0)
    assert row.score_first is None and row.score_second == pytest.approx(9 / 25)
    # Of four policies the middle half counts.
    apart = episodes_of(np.array([[0.0], [0.0], [0.0], [100.0]]))
    skewed = episode_rows(apart, robot="cartpole", arm="1-threshold", agent="policy", at_min=0.0)
    score = next(_scores(References(study, tmp_path, spec, pd.concat([skewed, *of_one[1:]])), 0.0, 0.0))
    assert (score.mean_return, score.interquartile_mean) == (25.0, 0.0)
    # Where nothing can be learned, no return has a score.
    write_typed(optima_file(tmp_path, "cartpole"), [replace(optimum, best_return=-5.0)])
    assert References(study, tmp_path, spec, known.table).score(arms[0], 0.0, 4.0) is None
    # Its controller misses the value by more than the grid's error; without a grid there is neither.
    errors = [_optimum_error(each) for each in (optimum, replace(optimum, monte_carlo=20.1), None)]
    assert errors == [5.0, 0.5, None] and _optimum_error(replace(optimum, grid_error=None)) is None


@pytest.mark.parametrize(
    ("shape", "heads", "cells"),
    [((), ["command"], ["", "0.5", "-1.0"]), ((2,), ["command_1", "command_2"], [",", "0.5,-1.0", "0.25,0.0"])],
)
def test_paths_have_a_column_for_each_command(
    tmp_path: Path, shape: tuple[int, ...], heads: list[str], cells: list[str]
) -> None:
    # The second episode has ended after one iteration; what follows is meaningless.
    commands = np.resize([0.5, -1.0, 0.25, 0.0], (2, 2, *shape))
    recorded = Paths(np.zeros((2, 3, 1)), commands, np.array([2, 1]))
    lines = write_table(tmp_path / "paths.csv", *paths_rows(["x"], {"a": recorded})).read_text().splitlines()
    assert lines[0] == ",".join(["arm,policy,iteration,x", *heads])
    assert lines[1:4] == [f"a,p0,{i},0.0,{cell}" for i, cell in enumerate(cells)] and len(lines) == 6


def test_one_policy_on_a_robot_without_bounds_has_no_interval_and_its_results_are_json(tmp_path: Path) -> None:
    assert [_finite(end) for end in (-np.inf, 1.5, np.inf)] == [None, 1.5, None]
    score = Score("rover", "one", "none", 0.0, 1, 2, 3.0, None, 3.0, *5 * [None])
    results = Results((score,), (), (), (), (), ())
    write_typed(tmp_path / "results.json", results)
    data = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert data["scores"][0]["low_95"] is None
    assert read_typed(tmp_path / "results.json", Results) == results


# --- who answers ----------------------------------------------------------------------------------------------------


@pytest.mark.oracle
@pytest.mark.parametrize("delivery", ["chosen", "shuffled"])
def test_policies_are_evaluated_as_they_are_trained_on_the_minute_s_own_neurons(tmp_path: Path, delivery: Any) -> None:
    arm = Arm("control", delivery=delivery, trained=False)
    study = Study(
        culture=RECORDED,
        robots=(RobotSpec("navigation", parameters={"episode_limit": 60}),),
        arms=(arm, Arm("other")),
        comparisons=(Compared("with another", "control", "other", at_min=0.0, episodes=7),),
        policies=2,
        episodes=7,
        episodes_over_time=3,
        actions="drawn",
    )
    (spec,) = study.robots
    for task in (
        MakeRecordings(study, HERE),
        FitSimulators(study),
        TrainArm(study, spec, arm, (0, 1)),
        EvaluateArm(study, spec, arm),
    ):
        task.run(tmp_path, Silent())
    got = read_episodes([episodes_file(tmp_path, spec, arm)])
    got = got[~got["over_time"]]

    timeline = fit_timeline(extract_series(read_recordings(tmp_path / "recordings")))
    policies = load_policies(tmp_path / "policies" / "navigation" / "control")
    networks = networks_of(list(policies.values()), greedy=False)
    chosen = Animat(Navigation(episode_limit=60), Thresholds(1), 5)
    shuffled = ShuffledDelivery(chosen)
    environment, turned = (shuffled, chosen) if delivery == "shuffled" else (chosen, shuffled)
    expected = {}
    for at_min in (0.0, 140.0):
        seed = study_seed(study, "navigation", "control", at_min)
        for name, answering in (("own", at_min), ("other", 140.0 - at_min)):
            ran = roll_out(environment, timeline.at(answering), networks, episodes=7, seed=seed)
            expected[name, at_min] = ran.returns
        expected["turned", at_min] = roll_out(turned, timeline.at(at_min), networks, episodes=7, seed=seed).returns
        returns = got[got["at_min"] == at_min]["return"].to_numpy().reshape(2, 7)
        np.testing.assert_allclose(returns, expected["own", at_min], rtol=1e-6)
        # So that the test can fail.
        assert not np.allclose(returns, expected["other", at_min])
        assert not np.allclose(returns, expected["turned", at_min])


# --- the optimal returns --------------------------------------------------------------------------------------

FEW = Study(
    culture=RECORDED,
    robots=(RobotSpec("navigation", parameters={"episode_limit": 60}),),
    arms=(Arm("1 threshold", trained=False), Arm("without neurons", mapping="none")),
    comparisons=(Compared("c", "without neurons", "1 threshold", at_min=0.0, episodes=2),),
    optimum_resolution=0.25,
    optimum_episodes=20,
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("few")
    MakeRecordings(FEW, HERE).run(folder, Silent())
    FitSimulators(FEW).run(folder, Silent())
    return folder


def optima_of(folder: Path, name: str = "optima") -> tuple[StudyOptimum, ...]:
    (file,) = FindOptima(FEW, FEW.robots[0], over_time=name == "over-time").run(folder, Silent())
    assert file == optima_file(folder, "navigation", name)
    return read_optima(folder, "navigation", name)


@pytest.mark.oracle
def test_conditions_of_few_responses_are_left_out_of_a_study_s_optima_and_named(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = extract_series(read_recordings(recorded / "recordings"))
    n = [[len(responses.rates_of(i)) for i in range(5)] for responses in series]
    # As many as the fewest at 0 min has, and one more: at 140 min all have as many.
    enough = min(n[0]) + 1
    assert min(n[1]) >= enough > min(n[0])
    monkeypatch.setattr("animat.evaluation.optimal_returns.FEW_SAMPLES", enough)
    few = [i for i in range(5) if n[0][i] < enough]
    at_first, at_last, without = optima_of(recorded)
    assert at_first.left_out == "; ".join(f"{series[0].conditions[i].label} ({n[0][i]})" for i in few)
    assert at_last.left_out is None is without.left_out
    for row in (at_first, at_last):
        assert row.low_95 <= row.best_return <= row.high_95
    assert without.low_95 is without.high_95 is None
    # Of the others, at the thresholds of all.
    kept = series[0].only([i for i in range(5) if i not in few])
    simulator = replace(fit_histogram(kept), percentiles=fit_histogram(series[0]).percentiles)
    environment = Animat(Navigation(episode_limit=60), Thresholds(1), 5 - len(few))
    assert at_first.best_return == best_return(environment, simulator, resolution=0.25, episodes=0).value

    for arm in FEW.arms:
        write_random(recorded, FEW.robots[0], arm, 0.0, 140.0)
    random = read_episodes(controls_file(recorded, FEW.robots[0], arm) for arm in FEW.arms)
    known, arm = References(FEW, recorded, FEW.robots[0], random), FEW.arms[0]
    assert known.optimum(arm, 0.0) is None is known.score(arm, 0.0, 5.0)
    assert known.optimum(arm, 140.0) is not None is not known.score(arm, 140.0, 5.0)
    over_time = optima_of(recorded, "over-time")
    assert [row.left_out for row in over_time] == [at_first.left_out, None]
    assert {row.low_95 for row in over_time} == {None}
    note = optima_table((at_first, at_last, without))
    assert "1 of 3 optima leave out conditions with fewer than 30 responses" in note.note
    assert note.rows[0][-1] == at_first.left_out


def synthetic_references(folder: Path, study: Study) -> tuple[References, References]:
    """Of two recordings, the first without an optimum; policies and random actions return -80."""
    spec, arm, minutes = study.robots[0], study.arms[0], (0.0, 10.0)
    run = {"ran": episodes_of(np.array([[-80.0]])), "robot": spec.name, "over_time": True}
    through = {"arm": mapping_label(*arm.kind), "agent": RANDOM}
    table = pd.concat(
        [episode_rows(**run, **of, at_min=at_min) for at_min in minutes for of in ({"arm": arm.name}, through)]
    )
    rows = [
        StudyOptimum(spec.name, *arm.kind, at, *[20.0] * 8, 100, few) for at, few in ((0.0, "5 Hz (3)"), (10.0, None))
    ]
    for what in ("optima", "over-time"):
        write_typed(optima_file(folder, spec.name, what), rows)
    known, coarse = (References(study, folder, spec, table, over_time=over_time) for over_time in (False, True))
    return known, coarse


def test_an_optimum_that_is_known_only_later_is_shown_from_then_on(tmp_path: Path) -> None:
    known, coarse = synthetic_references(tmp_path, Study(robots=(RobotSpec("navigation"),), policies=1))
    (panel,) = _courses(known, coarse, TIMELINE)
    assert panel.optimum is not None
    np.testing.assert_equal(panel.optimum, [np.nan, 20.0])


def test_lines_of_learning_curves_are_of_the_simulator_in_use(tmp_path: Path) -> None:
    arms = [Arm(str(of).lower(), shadowing=of) for of in (True, False, "drawn")]
    study = Study(robots=(RobotSpec("navigation"),), arms=tuple(arms), training_min=20.0)
    known, _ = synthetic_references(tmp_path, study)
    minutes = [_minutes_in_training(known, arm, TIMELINE) for arm in arms]
    np.testing.assert_equal(minutes, [[0.0] * 30 + [10.0] * 30, [0.0] * 60, [np.nan] * 60])
    assert known.random(arms[2], np.nan) is None is known.best_return(arms[2], np.nan)


@pytest.mark.oracle
def test_where_no_condition_has_enough_responses_a_study_has_no_optimum(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.evaluation.optimal_returns.FEW_SAMPLES", 41)
    at_first, at_last, without = optima_of(recorded)
    for row in (at_first, at_last):
        assert row.left_out.count(" Hz (") == 5
        assert set(astuple(row)[4:-1]) == {None}
    assert without.best_return > 0
    shown = optima_table((at_first, without))
    assert shown.rows[0][shown.head.index("optimum ± grid")] is None and 0 not in shown.marked


# --- a real recording -----------------------------------------------------------------------------------------------

TWO_ARMS = """
title = "An organoid's answers to two intervals"
policies = 2
episodes = 20
episodes_over_time = 2
optimum_resolution = 0.4
optimum_episodes = 400
algorithm = {{ environments = 8, gradient_steps = 1, batch = 16, replay = 1024, hidden = 8 }}

[culture]
kind = "files"
files = ["{file}"]

[simulators]
conditions = "interval:5,10+-25%"

[[robots]]
name = "navigation"
iterations = 2000

[[arms]]
name = "1 threshold"

[[arms]]
name = "9 thresholds"
mapping = "9-thresholds"

[[comparisons]]
name = "1 and 9 thresholds"
first = "1 threshold"
second = "9 thresholds"
"""


@pytest.mark.oracle
@pytest.mark.usefixtures("in_this_process")
def test_a_study_of_a_real_recording_with_two_conditions(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = real_data / "organoid_cartpole_maxone.npz"
    (tmp_path / "study.toml").write_text(TWO_ARMS.format(file=file))
    folder = tmp_path / "study"
    assert main(["study", str(tmp_path / "study.toml"), "--out", str(folder), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["comparisons"]
    assert row["outcome"] == "too few policies to tell"

    policy = Policy.load(folder / "policies" / "navigation" / "9-thresholds" / "p0.safetensors")
    assert [condition.label for condition in policy.conditions] == ["5 Hz", "10 Hz"]
    results = read_typed(folder / RESULTS, Results)
    optima, scores = {optimum.mapping: optimum for optimum in results.optima}, results.scores
    assert {score.mapping for score in scores} == set(optima) == {"1-threshold", "9-thresholds"}
    for score in scores:
        optimum = optima[score.mapping]
        # That culture could do better than chance, and never well: without neurons the optimum is above 20.
        assert score.random + 20 < optimum.best_return < 10
        assert abs(optimum.monte_carlo - optimum.best_return) < 4 * optimum.standard_error + optimum.grid_error + 1
        assert score.mean_return < optimum.best_return + 4 * optimum.standard_error + optimum.grid_error
    assert (folder / "report.html").stat().st_size > 100_000
