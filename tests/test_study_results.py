"""What a study's tables say: of returns whose order is known, of episodes run apart, and of a real recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.animat import Animat
from animat.cli import main
from animat.coding.mapping import Thresholds
from animat.evaluation.optimum import best_return
from animat.evaluation.rollouts import networks_of, roll_out
from animat.evaluation.statistics import holm
from animat.neurons.simulator import fit_histogram
from animat.neurons.timeline import fit_timeline
from animat.progress import Silent
from animat.recordings.reading import read_recordings
from animat.responses.series import extract_series
from animat.robots import Navigation
from animat.studies.draws import draw_seed
from animat.studies.evaluating import HEAD, Evaluate
from animat.studies.limits import HEAD as LIMIT_HEAD
from animat.studies.limits import Limit
from animat.studies.places import controls_file, episodes_file, limits_file, read_table, table_file, write_table
from animat.studies.recording import Record
from animat.studies.shown import limits_shown
from animat.studies.simulating import Fit
from animat.studies.specification import Body, Compared, Source, Study, StudyCondition
from animat.studies.tabulating import References, Tabulate
from animat.studies.training import TrainGroup
from animat.training.policy import Policy, load_policies

# --- which side is better -------------------------------------------------------------------------------------------

WORSE = StudyCondition("worse", mapping="none", trained=False)
BETTER = StudyCondition("better", mapping="none", trained=False)
LIKE = StudyCondition("like", mapping="none", trained=False)
RETURNS = {
    "worse": [-80.0, -75.0, -70.0, -72.0, -78.0, -74.0],
    "better": [10.0, 12.0, 8.0, 15.0, 9.0, 11.0],
    "like": [11.0, 9.5, 8.5, 14.0, 10.5, 10.2],
}


def compared_returns(folder: Path, *comparisons: Compared) -> list[dict[str, Any]]:
    """The table of comparisons for made-up returns of six policies: two episodes each, one below and one above."""
    study = Study(
        robots=(Body("cartpole"), Body("navigation")),
        conditions=(WORSE, BETTER, LIKE),
        comparisons=comparisons,
        policies=6,
        episodes=2,
    )
    for body in study.robots:
        for condition in study.conditions:
            rows = [
                (0.0, f"p{policy}", episode, mean + off, 10, 0)
                for policy, mean in enumerate(RETURNS[condition.name])
                # A third episode, that no comparison asks for, would turn every order around.
                for episode, off in enumerate((-1.0, 1.0, -5.0 * mean))
            ]
            write_table(episodes_file(folder, body, condition), HEAD, rows)
        random = [("random", 0.0, "", 0, -80.0, 10, 1)]
        write_table(controls_file(folder, body, LIKE), ("control", *HEAD), random)
        limit = {"mapping": "none", "percentiles": "moving", "at_min": 0.0, "best_return": 20.0, "grid_error": 0.1}
        limit |= {"monte_carlo": 20.0, "standard_error": 0.1, "without_clock": 20.0, "left_out": None}
        write_table(limits_file(folder, body.name), LIMIT_HEAD, [[limit.get(name, 0.0) for name in LIMIT_HEAD]])
    Tabulate(study).run(folder, Silent())
    return read_table(table_file(folder, "comparisons"))


def test_the_better_side_is_named_and_the_effect_has_its_sign(tmp_path: Path) -> None:
    up = Compared("up", "worse", "better", episodes=2)
    down = Compared("down", "better", "worse", episodes=2)
    by_name = {(row["comparison"], row["robot"]): row for row in compared_returns(tmp_path, up, down)}
    for robot in ("cartpole", "navigation"):
        rising, falling = by_name["up", robot], by_name["down", robot]
        assert (rising["outcome"], falling["outcome"]) == ("second better", "first better")
        assert rising["effect"] == -falling["effect"] != 0
        assert rising["u"] == falling["u"] == 0
        assert rising["mean_first"] == falling["mean_second"] == pytest.approx(np.mean(RETURNS["worse"]))
        assert rising["mean_second"] == falling["mean_first"] == pytest.approx(np.mean(RETURNS["better"]))
        assert rising["score_second"] == pytest.approx((rising["mean_second"] + 80) / 100)


def test_sides_that_are_alike_are_not_ordered_and_all_robots_count_for_holm(tmp_path: Path) -> None:
    rows = compared_returns(
        tmp_path, Compared("alike", "better", "like", episodes=2), Compared("up", "worse", "better", episodes=2)
    )
    assert all("better" not in row["outcome"] for row in rows if row["comparison"] == "alike")
    corrected = holm({f"{row['comparison']}/{row['robot']}": row["p_normal"] for row in rows})
    assert len(corrected) == 4
    assert [row["p_holm"] for row in rows] == [corrected[f"{row['comparison']}/{row['robot']}"] for row in rows]


# --- who answers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delivery", ["chosen", "shuffled"])
def test_policies_are_evaluated_as_they_are_trained_on_the_minute_s_own_neurons(tmp_path: Path, delivery: Any) -> None:
    condition = StudyCondition("control", delivery=delivery, trained=False)
    study = Study(
        culture=Source("made-up", sessions=2, interval_min=140.0, presentations=20, channels=32),
        robots=(Body("navigation", parameters={"episode_limit": 60}),),
        conditions=(condition, StudyCondition("other")),
        comparisons=(Compared("with another", "control", "other", at_min=0.0, episodes=7),),
        policies=2,
        episodes=7,
        episodes_over_time=3,
        actions="drawn",
    )
    (body,) = study.robots
    for task in (
        Record(study, tmp_path),
        Fit(study),
        TrainGroup(study, body, condition, (0, 1)),
        Evaluate(study, body, condition),
    ):
        task.run(tmp_path, Silent())
    got = read_table(episodes_file(tmp_path, body, condition))

    timeline = fit_timeline(extract_series(read_recordings(tmp_path / "recordings")))
    policies = load_policies(tmp_path / "policies" / "navigation" / "control")
    networks = networks_of(list(policies.values()), greedy=False)
    environment = Animat(Navigation(episode_limit=60), Thresholds(1), 5, delivery)
    expected = {}
    for at_min in (0.0, 140.0):
        seed = draw_seed(study.seed, "navigation", "control", at_min)
        for name, answering in (("own", at_min), ("other", 140.0 - at_min)):
            ran = roll_out(environment, timeline.at(answering), networks, 2, episodes=7, seed=seed)
            expected[name, at_min] = ran.returns
        turned = replace(environment, delivery="chosen" if delivery == "shuffled" else "shuffled")
        expected["turned", at_min] = roll_out(turned, timeline.at(at_min), networks, 2, episodes=7, seed=seed).returns
        returns = np.array([row["return"] for row in got if row["at_min"] == at_min]).reshape(2, 7)
        np.testing.assert_allclose(returns, expected["own", at_min], rtol=1e-6)
        # So that the test can fail.
        assert not np.allclose(returns, expected["other", at_min])
        assert not np.allclose(returns, expected["turned", at_min])


# --- the best possible returns --------------------------------------------------------------------------------------

FEW = Study(
    culture=Source(kind="made-up", sessions=2, interval_min=140, presentations=40, channels=32),
    robots=(Body("navigation", parameters={"episode_limit": 60}),),
    conditions=(StudyCondition("1 threshold", trained=False), StudyCondition("without neurons", mapping="none")),
    comparisons=(Compared("c", "without neurons", "1 threshold", at_min=0.0, episodes=2),),
    limit_resolution=0.25,
    limit_episodes=20,
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("few")
    Record(FEW, folder).run(folder, Silent())
    Fit(FEW).run(folder, Silent())
    return folder


def limits_of(folder: Path, name: str = "limits") -> list[dict[str, Any]]:
    (file,) = Limit(FEW, FEW.robots[0], over_time=name == "over-time").run(folder, Silent())
    assert file == limits_file(folder, "navigation", name)
    return read_table(file)


def test_conditions_of_few_responses_are_left_out_of_a_study_s_limits_and_told(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = extract_series(read_recordings(recorded / "recordings"))
    n = [[len(responses.rates_of(i)) for i in range(5)] for responses in series]
    # As many as the fewest at 0 min has, and one more: at 140 min all have as many.
    enough = min(n[0]) + 1
    assert min(n[1]) >= enough > min(n[0])
    monkeypatch.setattr("animat.evaluation.resampling.FEW_SAMPLES", enough)
    few = [i for i in range(5) if n[0][i] < enough]
    at_first, at_last, without = limits_of(recorded)
    assert at_first["left_out"] == "; ".join(f"{series[0].conditions[i].label} ({n[0][i]})" for i in few)
    assert at_last["left_out"] is None is without["left_out"]
    for row in (at_first, at_last):
        assert row["low_95"] <= row["best_return"] <= row["high_95"]
    assert without["low_95"] is without["high_95"] is None
    # Of the others, at the thresholds of all.
    kept = series[0].only([i for i in range(5) if i not in few])
    simulator = replace(fit_histogram(kept), percentiles=fit_histogram(series[0]).percentiles)
    environment = Animat(Navigation(episode_limit=60), Thresholds(1), 5 - len(few))
    assert at_first["best_return"] == best_return(environment, simulator, resolution=0.25, episodes=0).value

    for condition in FEW.conditions:
        random = [("random", at_min, "", 0, -80.0, 10, 1) for at_min in (0.0, 140.0)]
        write_table(controls_file(recorded, FEW.robots[0], condition), ("control", *HEAD), random)
    known, condition = References(FEW, recorded, FEW.robots[0]), FEW.conditions[0]
    assert known.limit(condition, 0.0) is None is known.score(condition, 0.0, 5.0)
    assert known.limit(condition, 140.0) is not None is not known.score(condition, 140.0, 5.0)
    rough = limits_of(recorded, "over-time")
    assert [row["left_out"] for row in rough] == [at_first["left_out"], None]
    assert {row["low_95"] for row in rough} == {None}
    note = limits_shown([{"robot": "navigation", **row} for row in (at_first, at_last, without)])
    assert "1 of 3 limits leave out conditions with fewer than 30 responses" in note.note
    assert note.rows[0][-1] == at_first["left_out"]


def test_where_no_condition_has_enough_responses_a_study_has_no_limit(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.evaluation.resampling.FEW_SAMPLES", 41)
    at_first, at_last, without = limits_of(recorded)
    for row in (at_first, at_last):
        assert row["left_out"].count(" Hz (") == 5
        assert {row[name] for name in LIMIT_HEAD[3:-1]} == {None}
    assert without["best_return"] > 0
    shown = limits_shown([{"robot": "navigation", **row} for row in (at_first, without)])
    assert shown.rows[0][shown.head.index("limit ± grid")] is None and 0 not in shown.marked


# --- a real recording -----------------------------------------------------------------------------------------------

TWO_CONDITIONS = """
title = "An organoid's answers to two intervals"
policies = 2
episodes = 20
episodes_over_time = 2
limit_resolution = 0.4
limit_episodes = 400
algorithm = {{ environments = 8, updates = 1, batch = 16, replay = 1024, hidden = 8 }}

[culture]
kind = "files"
files = ["{file}"]

[simulators]
conditions = "interval:5,10+-25%"

[[robots]]
name = "navigation"
iterations = 2000

[[conditions]]
name = "1 threshold"

[[conditions]]
name = "9 thresholds"
mapping = "9-thresholds"

[[comparisons]]
name = "1 and 9 thresholds"
first = "1 threshold"
second = "9 thresholds"
"""


@pytest.mark.oracle
def test_a_study_of_a_real_recording_with_two_conditions(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = real_data / "organoid_cartpole_maxone.npz"
    (tmp_path / "study.toml").write_text(TWO_CONDITIONS.format(file=file))
    folder = tmp_path / "study"
    assert main(["study", str(tmp_path / "study.toml"), "--out", str(folder), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["comparisons"]
    assert row["outcome"] == "too few policies to tell"

    policy = Policy.load(folder / "policies" / "navigation" / "9-thresholds" / "p0.safetensors")
    assert [condition.label for condition in policy.conditions] == ["5 Hz", "10 Hz"]
    limits = {limit["mapping"]: limit for limit in read_table(table_file(folder, "limits"))}
    scores = read_table(table_file(folder, "scores"))
    assert {score["mapping"] for score in scores} == set(limits) == {"1-threshold", "9-thresholds"}
    for score in scores:
        limit = limits[score["mapping"]]
        # That culture could do better than chance, and never well: without neurons the limit is above 20.
        assert score["random"] + 20 < limit["best_return"] < 10
        assert abs(limit["monte_carlo"] - limit["best_return"]) < 4 * limit["standard_error"] + limit["grid_error"] + 1
        assert score["mean_return"] < limit["best_return"] + 4 * limit["standard_error"] + limit["grid_error"]
    assert (folder / "report.html").stat().st_size > 100_000
