"""Studies of robots with several commands, with lessons, with recordings that are drawn: as the library's own way."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from animat.coding.mapping import mapping_named
from animat.errors import InvalidArgument
from animat.execution.training import train
from animat.neurons.timeline import fit_timeline, load_timeline
from animat.progress import Silent
from animat.recordings.reading import read_recordings
from animat.responses.extraction import extract_series
from animat.robots import Wheels
from animat.stimulation.protocol import TWO_COMMANDS
from animat.studies.recording import FitSimulators, MakeRecordings, controllability
from animat.studies.run import run_study
from animat.studies.source import Source
from animat.studies.specification import Arm, Compared, RobotSpec, Simulators, Study
from animat.studies.task import study_seed
from animat.studies.toml import read_study, study_to_toml
from animat.studies.training import TrainArm
from animat.training.lessons import Lesson
from animat.training.policy import Policy
from animat.training.settings import SAC
from animat.training.specification import Training
from animat.tuning.specification import Tune, tuning_of, with_settings

NEAR = Lesson(starts={"x_m": (0.4, 0.6)}, until_return=45)
HERE = Path(__file__).parent
SMALL = {"environments": 8, "gradient_steps": 1, "batch": 16, "replay": 1024, "hidden": 8}
STUDY = Study(
    culture=Source("files", files=("data/tiny",)),
    simulators=Simulators(readouts="halves"),
    robots=(RobotSpec("wheels", iterations=3000, lessons=(NEAR,)),),
    arms=(Arm("in turn"), Arm("drawn", shadowing="drawn")),
    comparisons=(Compared("in turn and drawn", "in turn", "drawn", episodes=4),),
    policies=2,
    episodes=4,
    episodes_over_time=2,
    optimum_resolution=0.2,
    optimum_episodes=20,
    algorithm=SMALL,
)


def fitted(folder: Path) -> Path:
    MakeRecordings(STUDY, HERE).run(folder, Silent())
    return FitSimulators(STUDY).run(folder, Silent())[0]


@pytest.mark.oracle
def test_a_study_s_policies_are_those_of_the_same_training_by_hand(tmp_path: Path) -> None:
    kept = load_timeline(fitted(tmp_path))
    series = extract_series(read_recordings(tmp_path / "recordings"), readouts="halves")
    timeline = fit_timeline(series)
    assert kept.readouts == timeline.readouts
    for one, other in zip(jax.tree.leaves(kept.simulators), jax.tree.leaves(timeline.simulators), strict=True):
        np.testing.assert_array_equal(one, other)
    spec, arm = STUDY.robots[0], STUDY.arms[1]
    for member in range(2):
        # As many side by side as there are by hand: else sums are rounded otherwise.
        TrainArm(STUDY, spec, arm, (member,)).run(tmp_path, Silent())
    by_hand = Training(
        robot=Wheels(),
        mapping=mapping_named("1-threshold"),
        policies=2,
        iterations=3000,
        seed=study_seed(STUDY, "training", "wheels", "drawn"),
        shadowing="drawn",
        duration_min=60,
        algorithm=SAC(**SMALL),
        lessons=(NEAR,),
    )
    for name, policy in train(by_hand, timeline, None).items():
        of_study = Policy.load(tmp_path / f"policies/wheels/drawn/{name}.safetensors")
        for one, other in zip(policy.weights, of_study.weights, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.oracle
def test_responses_and_controllability_are_reported_for_each_readout(tmp_path: Path) -> None:
    timeline = load_timeline(fitted(tmp_path))
    series = extract_series(read_recordings(tmp_path / "recordings"), readouts="halves")
    with (tmp_path / "simulators/responses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    written = [[float(row["rate_hz of left"]), float(row["rate_hz of right"])] for row in rows]
    np.testing.assert_array_equal(written, np.concatenate([each.read_hz for each in series]))
    of_all = [float(row["rate_hz"]) for row in rows]
    # Halves have as many channels each.
    np.testing.assert_allclose(of_all, np.mean(written, axis=1))
    kept = controllability(timeline)[0.0]
    assert kept.labels[:3] == ("5 Hz, left", "5 Hz, right", "10 Hz, left")
    first, is_used = series[0], ~series[0].is_burst
    x_hz = first.read_hz[is_used & (first.condition == 0), 1]
    assert kept.in_data[1] == pytest.approx(np.mean(x_hz >= np.median(first.read_hz[is_used, 1])))


@pytest.mark.long
def test_it_runs_to_its_report(tmp_path: Path) -> None:
    ran = run_study(STUDY, tmp_path / "study", base=HERE, workers=1)
    page = ran.report.read_text()
    assert "in turn and drawn" in page
    assert (tmp_path / "study/policies/wheels/drawn/best/p0.safetensors").exists()
    assert "5 Hz, left" in (tmp_path / "study/tables/controllability.csv").read_text()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"simulators": Simulators()},
            r"simulators.readouts: expected as many as wheels has commands \(2\), got 'all', which are 1",
        ),
        (
            {"robots": (RobotSpec("wheels"), RobotSpec("cartpole"))},
            r"simulators.readouts: expected as many as cartpole has commands \(1\), got 'halves', which are 2; "
            "robots with more or fewer commands need another study",
        ),
        (
            {"robots": (RobotSpec("wheels", lessons=(Lesson(recordings_min=(0, 5)),)),)},
            r"robots.lessons: .*recordings_min.* \(wheels, in turn\)",
        ),
    ],
)
def test_inconsistent_settings_are_refused_before_anything_is_recorded(
    changed: dict[str, object], message: str
) -> None:
    with pytest.raises(InvalidArgument, match=message):
        replace(STUDY, **changed)  # type: ignore[arg-type]


@pytest.mark.parametrize("readouts", ["thirds", "[1, 2]", '{"left": [1], "left": [2]}', "{"])
def test_invalid_readouts_are_refused(readouts: str) -> None:
    with pytest.raises(InvalidArgument, match="readouts: expected"):
        Simulators(readouts=readouts)
    with pytest.raises(InvalidArgument, match=r"readouts\.left: expected at least 1, got"):
        Simulators(readouts='{"left": []}')


def test_a_virtual_culture_is_stimulated_at_places() -> None:
    corners = Source(places="corners", trials=20).protocol()
    assert (corners.places, corners.frequencies_hz) == ("corners", TWO_COMMANDS.frequencies_hz)
    assert Source(places="halves", frequencies_hz=(5, 80)).protocol().frequencies_hz == (5, 80)
    assert Source().protocol().places == ()
    for stimuli in ({"places": "halves"}, {"frequencies_hz": (5.0,)}):
        with pytest.raises(InvalidArgument, match="expected only for a culture that is recorded"):
            Source("files", files=("a",), **stimuli)  # type: ignore[arg-type]


def test_it_is_written_as_toml_and_read_as_the_same(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(study_to_toml(STUDY))
    assert read_study(tmp_path / "study.toml") == STUDY


def test_tuning_searches_readouts_and_teaches_no_lessons() -> None:
    plain = replace(STUDY, robots=(RobotSpec("wheels", iterations=3000),), arms=(Arm("in turn"),), comparisons=())
    groups = '{"left": [1, 2], "right": [3]}'
    tuning = tuning_of(plain, Tune(search={"readouts": ["halves", groups]}))
    assert tuning.space == {"readouts": ("halves", groups)}
    assert with_settings(plain, {"readouts": groups}).simulators.readouts == groups
    for study in (replace(plain, robots=STUDY.robots), replace(plain, arms=(Arm("drawn", shadowing="drawn"),))):
        with pytest.raises(InvalidArgument, match=r"robots.lessons: expected neither lessons nor shadowing = 'drawn'"):
            tuning_of(study, Tune())
