"""Files that 0.1.0 wrote are read. Oracle: what the code of that commit said of them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.closed_loop.session import read_session
from animat.errors import InvalidFile, Mismatch
from animat.goals.robot import robot_of
from animat.recordings.reading import read_recordings
from animat.responses.extraction import extract_series
from animat.stimulation.protocol import Protocol
from animat.studies.run import plan_study, run_study
from animat.studies.toml import read_study
from animat.training.folder import check_claim, describe_training, expect_folder_for
from animat.training.policy import Policy
from animat.training.specification import Training
from test_studies import Halts

pytestmark = pytest.mark.usefixtures("in_this_process", "few_bootstraps")

ARCHIVE = Path(__file__).parent / "data" / "commit_5e75c96.tar.xz"


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("old")
    shutil.unpack_archive(ARCHIVE, folder)
    return folder


@pytest.fixture(scope="module")
def expected(old: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((old / "told.json").read_text())
    return content


def test_recordings_are_what_they_were(
    old: Path, expected: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = read_recordings([old / "recordings"])
    for recording, was in zip(recordings, expected["recordings"], strict=True):
        assert recording.start_min == was["start_min"]
        assert recording.channels.label.tolist() == was["channels"]
        assert (len(recording.spike_times_s), len(recording.stimuli)) == (was["spikes"], was["stimuli"])
        assert recording.spike_times_s.sum() == pytest.approx(was["spike_times_s"], rel=1e-12)
        assert recording.stimuli.time_s.sum() == pytest.approx(was["stimulus_times_s"], rel=1e-12)
        assert sorted(set(recording.stimuli.frequency_hz.tolist())) == was["frequencies_hz"]
        assert str(recording.presentation) == was["presentation"].replace("a presentation", "per trial")
    assert [each.rate_hz.tolist() for each in extract_series(recordings)] == expected["rate_hz"]
    assert main(["inspect", str(old / "recordings")]) == 0
    assert capsys.readouterr().out.count("usable") == 2


@pytest.mark.oracle
def test_a_policy_acts_as_it_did_and_is_evaluated_and_run(
    old: Path, expected: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = Policy.load(old / "policies" / "p0.safetensors")
    assert [condition.label for condition in policy.conditions] == expected["policy"]["conditions"]
    for seen, was in zip(([0.5, 0.2, 1.0], [0.1, 0.9, -2.0]), expected["policy"]["probabilities"], strict=True):
        np.testing.assert_allclose(policy.probabilities(np.array(seen)), was, rtol=1e-5)
    given = [str(old / "policies"), "--recordings", str(old / "recordings"), "--json"]
    assert main(["evaluate", *given]) == 0
    evaluated = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [row["name"] for row in evaluated["rows"]][:2] == ["policies", "random"]
    run = ["--culture", "replay", "--episodes", "1", "--controls", "random", "--out", str(tmp_path / "session")]
    assert main(["run", *given, *run]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["session"]["ended_by"] == "plan"


def test_a_session_is_read_and_its_recording_written_again(old: Path, expected: dict[str, Any], tmp_path: Path) -> None:
    shutil.copytree(old / "session", tmp_path / "session")
    session = read_session(tmp_path / "session")
    was = expected["session"]
    assert session.ending.by == was["ended_by"]
    assert sum(episode.pulses for episode in session.episodes) == was["pulses"]
    assert "warm-up" in {tick.handled for tick in session.ticks}
    ticks = [[t.agent, t.delivered, t.rate_hz, t.command, t.reward] for t in session.ticks]
    assert ticks == was["ticks"]
    for name in ("session.nwb", "ticks.csv"):
        (tmp_path / "session" / name).unlink()
    assert main(["recover", str(tmp_path / "session")]) == 0
    (again,), (before,) = (read_recordings([folder / "session" / "session.nwb"]) for folder in (tmp_path, old))
    np.testing.assert_array_equal(again.spike_times_s, before.spike_times_s)
    np.testing.assert_array_equal(again.stimuli.time_s, before.stimuli.time_s)


def test_a_study_is_read_and_its_folder_left_to_the_version_that_began_it(old: Path, tmp_path: Path) -> None:
    shutil.copytree(old, tmp_path / "old")
    folder, study = tmp_path / "old" / "study", read_study(tmp_path / "old" / "study.toml")
    assert [job.name for job in plan_study(study, tmp_path / "old")][:2] == ["record", "fit"]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(Mismatch, match=r"got one of another .*; give another folder"):
        run_study(study, folder, base=tmp_path / "old", executor=Halts())
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_studys_former_keys_are_read_by_their_names_of_today(tmp_path: Path) -> None:
    former, today = tmp_path / "former.toml", tmp_path / "today.toml"
    text = """optimum_resolution = 0.5
optimum_episodes = 7
[culture]
trials = 40
[simulators]
allow = ["dead-window"]
[[robots]]
name = "navigation"
optimum_resolution = 0.4
[algorithm]
gradient_steps = 1
tau = 0.5
[[arms]]
name = "linear"
mapping = "linear"
"""
    today.write_text(text)
    for now, before in (
        ("optimum", "limit"),
        ("allow", "despite"),
        ("arms", "conditions"),
        ("gradient_steps", "updates"),
        ("tau", "follow"),
        ("trials", "presentations"),
    ):
        text = text.replace(now, before)
    former.write_text(text)
    assert read_study(former) == read_study(today)
    former.write_text("limit_resolution = 0.5\noptimum_resolution = 0.5\n")
    with pytest.raises(InvalidFile, match="limit_resolution: no such setting at the top"):
        read_study(former)


def test_channels_are_read_and_a_culture_that_was_made_up_is_refused(old: Path, tmp_path: Path) -> None:
    written = old / "study" / "study.toml"
    assert "channels = 256\n" in written.read_text()
    assert read_study(written) == read_study(old / "study.toml")
    (former := tmp_path / "former.toml").write_text('[culture]\nkind = "made-up"\nchannels = 32\n')
    with pytest.raises(InvalidFile, match=r"toml: culture\.kind: expected 'virtual' or 'files', got 'made-up'"):
        read_study(former)


def test_a_trainings_folder_is_left_to_the_version_that_began_it(old: Path) -> None:
    begun = json.loads((old / "policies" / "training.json").read_text())["training"]
    training = Training(robot_of(begun), begun["mapping"], begun["policies"], begun["iterations"], begun["seed"])
    training = replace(training, duration_min=begun["duration_min"])
    with pytest.raises(Mismatch, match=r"^[^\n]* got one of another .*; give another folder"):
        expect_folder_for(training, old / "policies")
    with pytest.raises(Mismatch, match=r"^[^\n]* got one of another .*; give another folder"):
        check_claim(old / "policies", describe_training(training, None))


def test_a_protocol_of_presentations_is_one_of_trials() -> None:
    protocol = Protocol(order="mixed", trials=40)
    former = protocol.to_json().replace("trials", "presentations")
    assert "presentations" in former and Protocol.from_json(former) == protocol
