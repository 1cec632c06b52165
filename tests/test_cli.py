"""The commands as a user runs them, on good input and on bad: one line, an exit status, nothing half-written."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import docstring_parser
import numpy as np
import pytest

import animat
from animat.cli import COMMANDS, main
from animat.cli.command import print_warnings
from animat.cli.train import Train
from animat.coding.mapping import Thresholds
from animat.cultures.series import Series
from animat.environment import Animat
from animat.errors import InvalidArgument
from animat.evaluation.optimal_returns import WellSampled
from animat.evaluation.optimum import Optimum, best_return
from animat.neurons.timeline import fit_timeline
from animat.recordings.findings import Finding
from animat.recordings.reading import read_recordings
from animat.responses.condition import Condition
from animat.responses.extraction import extract_series
from animat.robots import Cartpole, robot_named
from animat.training.policy import Policy
from animat.training.settings import SAC
from animat.watch.training import TrainingView
from rig_files import event_table, mapping_table, spike_table, write_maxwell
from synthetic_recordings import write_synthetic_series
from test_evaluation import WITHOUT_NEURONS, policy_of

pytestmark = pytest.mark.usefixtures("in_this_process")

TWO_CONDITIONS: Any = SimpleNamespace(
    conditions=(Condition("5 Hz", 5.0, "Hz"), Condition("80 Hz", 80.0, "Hz")), window_ms=(2.0, 10.0), presentation=None
)
PENDULUM = policy_of(TWO_CONDITIONS, robot_named("gymnasium:Pendulum-v1"))
QUICK = ["--policies", "2", "--iterations", "1000"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("series") / "recordings"
    write_synthetic_series(1, folder, sessions=2, patterns=40, channels=64)
    return folder


@pytest.fixture(scope="module")
def policies(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "policies"
    assert main(["train", "cartpole", "--recordings", str(recordings), *QUICK, "--out", str(folder)]) == 0
    return folder


def last_json(printed: str) -> dict[str, object]:
    """The last line as JSON, which has no NaN: `jq` and every other language would stumble over one."""
    return json.loads(printed.splitlines()[-1], parse_constant=pytest.fail)  # type: ignore[no-any-return]


@pytest.mark.oracle
def test_what_training_reports_is_what_the_deployed_policies_get(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # So short that no episode ends in the last chunk: the learning curve knows no return.
    short = ["train", "cartpole", "--recordings", str(recordings), "--policies", "1", "--iterations", "32"]
    assert main([*short, "--out", str(tmp_path), "--json"]) == 0
    printed = capsys.readouterr().out
    reported = last_json(printed)
    assert main(["evaluate", str(tmp_path), "--recordings", str(recordings), "--json"]) == 0
    evaluated = last_json(capsys.readouterr().out)
    assert reported["returns"] == evaluated["policies"]
    assert reported["random"] == evaluated["rows"][1]["mean_return"]  # type: ignore[index]
    assert reported["recorded_at_min"] == evaluated["recorded_at_min"] == 10.0
    assert f"1 policy in {tmp_path}; mean return on the simulator at 10 min: {reported['returns']['p0']:.1f}" in printed  # type: ignore[index]


@pytest.mark.oracle
def test_the_live_page_has_what_returns_are_compared_with(
    recordings: Path,
    policies: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with_a_coarse_optimum(monkeypatch)
    folder = tmp_path / "policies"
    shutil.copytree(policies, folder)
    manifest = json.loads((folder / "training.json").read_text())
    (shown,) = levels_in(folder)
    assert shown == ("random actions", manifest["random_return"])
    out = folder / "evaluation.json"
    evaluate = ["evaluate", str(folder), "--recordings", str(recordings), "--at-min", "0", "--optimum", "--json"]
    assert main([*evaluate, "--out", str(out)]) == 0
    evaluated = last_json(capsys.readouterr().out)
    assert json.loads(out.read_text()) == evaluated
    returns = {row["name"]: row["mean_return"] for row in evaluated["rows"]}  # type: ignore[attr-defined]
    # The random actions of 100 episodes on the first simulator are those that training reported.
    assert returns["random"] == manifest["random_return"]
    assert levels_in(folder) == [
        ("random actions", returns["random"]),
        ("best coupling", returns["coupling"]),
        ("optimal return", evaluated["optimum"]["value"]),  # type: ignore[index]
    ]
    # A resumed training reports it as before.
    assert main(["train", "cartpole", "--recordings", str(recordings), *QUICK, "--out", str(folder)]) == 0
    assert json.loads((folder / "training.json").read_text()) == manifest
    capsys.readouterr()
    assert main([*evaluate, "--out", str(folder / "training.json" / "x.json")]) == 1
    assert "training.json" in capsys.readouterr().err
    assert main([*evaluate, "--out", str(folder)]) == 1
    assert capsys.readouterr().err == f"animat: --out: expected a file, got the folder {folder}\n"


@pytest.mark.parametrize(
    ("command", "status"),
    [
        (["train", "cartpole", "--iterations", "abc"], 2),
        (["train", "cartpole", "--iteration", "10"], 2),
        (["train", "cartpole", "--iterations", "-5"], 1),
        (["inspect", "no-such-file.nwb"], 1),
    ],
)
def test_a_command_line_that_cannot_be_read_has_another_exit_status_than_other_errors(
    command: list[str], status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command) == status
    assert capsys.readouterr().err.count("\n") == 1


def with_a_coarse_optimum(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The optimal return on a coarse grid; returns the resolutions asked for."""
    asked = []

    def coarse(*case: Any, resolution: float, **options: Any) -> Optimum:
        asked.append(resolution)
        return best_return(*case, resolution=0.25, episodes=0, **options)

    with_interval = WellSampled.with_interval

    def narrow(*of: Any, resolution: float, **options: Any) -> Optimum:
        return with_interval(*of, resolution=0.25, resamples=3, **options)

    monkeypatch.setattr("animat.evaluation.table.best_return", coarse)
    monkeypatch.setattr(WellSampled, "with_interval", narrow)
    return asked


def levels_in(folder: Path) -> list[tuple[str, float]]:
    """The horizontal lines of the learning curves on the live page."""
    chart = next(each for each in TrainingView(folder).view(None, 8.0)["blocks"] if each["title"] == "Learning curves")
    lines = [each for each in chart["series"] if each["style"] == "dashed"]
    assert all(each["y"][0] == each["y"][1] for each in lines)
    return [(each["name"], each["y"][0]) for each in lines]


@pytest.mark.oracle
def test_settings_of_the_algorithm_are_those_that_policies_are_trained_with(recordings: Path, tmp_path: Path) -> None:
    few = ["--policies", "1", "--iterations", "640", "--sac", "discount=0.9", "hidden=8", "environments=16"]
    assert main(["train", "cartpole", "--recordings", str(recordings), *few, "--out", str(tmp_path)]) == 0
    settings = json.loads((tmp_path / "training.json").read_text())["training"]["algorithm"]
    assert settings == asdict(SAC(discount=0.9, hidden=8, environments=16))
    assert [w.shape for w in Policy.load(tmp_path / "p0.safetensors").weights] == [(4, 8), (8, 8), (8, 5)]


@pytest.mark.oracle
def test_another_training_s_folder_is_refused_before_recordings_are_read_and_a_finished_one_is_reported(
    recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    again = ["train", "cartpole", "--recordings", str(recordings), *QUICK, "--out", str(policies)]
    files = {file: file.read_bytes() for file in policies.iterdir()}
    assert main(again) == 0
    printed = capsys.readouterr().out
    assert f"this training is already finished; the policies in {policies} are unchanged" in printed
    assert f"2 policies in {policies}; mean return" in printed
    assert {file: file.read_bytes() for file in policies.iterdir()} == files

    def never(*_: object) -> None:
        raise AssertionError("the recordings were read")

    monkeypatch.setattr("animat.cli.train.Train.timeline", never)
    for option, difference in (
        (["--seed", "9"], "training.seed: 1 there, 9 now"),
        (["--shadowing", "off"], "training.shadowing: True there, False now"),
        (["--mapping", "1-threshold"], "training.mapping: '9-thresholds' there, '1-threshold' now"),
    ):
        assert main([*again, *option]) == 1
        assert f"got one of another ({difference})" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in policies.iterdir()} == files


def test_the_whole_way(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    series, trained, figures = tmp_path / "recordings", tmp_path / "policies", tmp_path / "figures"
    replay = ["--culture", "replay", "--recordings", str(recordings), "--trials", "100"]
    assert main(["record", *replay, "--out", str(series), "--json"]) == 0
    printed = capsys.readouterr().out
    assert len(last_json(printed)["recordings"]) == 2 and "there already" not in printed  # type: ignore[arg-type]

    assert main(["inspect", str(series), "--out", str(figures), "--json"]) == 0
    results = last_json(capsys.readouterr().out)["recordings"]
    assert [r["stimuli"] for r in results] == [500, 500]  # type: ignore[attr-defined, index]
    assert all(Path(figure).is_file() for r in results for figure in r["figures"])  # type: ignore[attr-defined, index]

    train = ["train", "cartpole", "--recordings", str(series), *QUICK, "--out", str(trained)]
    assert main([*train, "--json"]) == 0
    assert set(last_json(capsys.readouterr().out)["returns"]) == {"p0", "p1"}  # type: ignore[call-overload]

    evaluate = ["evaluate", str(trained), "--recordings", str(series), "--at-min", "0"]
    assert main([*evaluate, "--json"]) == 0
    results = last_json(capsys.readouterr().out)
    assert results["recorded_at_min"] == 0.0
    assert set(results["policies"]) == {"p0", "p1"}  # type: ignore[call-overload]


def test_recordings_that_were_there_already_are_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def recorded(_: object, __: object, folder: Path, **___: object) -> Series:
        folder.mkdir(exist_ok=True)
        (folder / "recording_0000_min.nwb").touch()
        return Series([*folder.iterdir()], [])

    monkeypatch.setattr("animat.cultures.series.record_series", recorded)
    for were_there in ("", "; all existed already"):
        assert main(["record", "--out", str(tmp_path / "out")]) == 0
        assert capsys.readouterr().out == f"1 recording in {tmp_path / 'out'}{were_there}\n"


def test_help_says_what_a_number_of_one_is_without_the_option(capsys: pytest.CaptureFixture[str]) -> None:
    """1 is True to Python, and a flag's default is not said."""
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Decides every random draw (default: 1)" in said and "(default: True)" not in said


@pytest.mark.oracle
def test_evaluate_writes_over_no_file_but_an_evaluation(
    recordings: Path, policies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(policies), "--recordings", str(recordings), "--episodes", "2", "--out"]
    assert main([*command, str(tmp_path / "found.json")]) == 0
    assert main([*command, str(tmp_path / "found.json")]) == 0
    for name, content in (("recording.nwb", b"\x89HDF"), ("list.json", b"[]"), ("other.json", b'{"a": 1}')):
        (tmp_path / name).write_bytes(content)
        capsys.readouterr()
        assert main([*command, str(tmp_path / name)]) == 1
        assert "--out: expected a new file or one of an earlier evaluation" in capsys.readouterr().err
        assert (tmp_path / name).read_bytes() == content


@pytest.mark.oracle
def test_a_training_that_is_no_better_than_random_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = ["train", "cartpole", "--mapping", "none", "--policies", "1", "--iterations", "480"]
    assert main([*train, "--out", str(tmp_path / "out"), "--json"]) == 0
    said = capsys.readouterr()
    results: Any = last_json(said.out)
    named = [each["name"] for each in results["findings"]]
    assert results["returns"]["p0"] < results["random"] and named == ["no-better-than-random"]
    assert "the policies are no better than random actions (" in said.err and "animat validate" not in said.err


@pytest.mark.oracle
def test_what_is_warned_of_is_in_the_json_too(
    recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(policies), "--recordings", str(recordings), "--episodes", "2"]
    assert main([*command, "--range-hz", "5", "--json"]) == 0
    said = capsys.readouterr()
    warned = set(re.findall(r"^warning: ([a-z-]+): ", said.err, re.MULTILINE))
    assert "binning" in warned
    assert warned <= {finding["name"] for finding in last_json(said.out)["findings"]}


@pytest.mark.oracle
def test_what_training_warns_of_is_in_the_json_too(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--policies", "1", "--iterations", "480", "--range-hz", "5"]
    command = ["train", "cartpole", "--recordings", str(recordings), *few, "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 0
    said = capsys.readouterr()
    warned = set(re.findall(r"^warning: ([a-z-]+): ", said.err, re.MULTILINE))
    assert "binning" in warned
    assert warned <= {finding["name"] for finding in last_json(said.out)["findings"]}


@pytest.mark.oracle
def test_policies_of_a_training_that_is_not_finished_are_counted(
    recordings: Path, policies: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "policies"
    shutil.copytree(policies, folder)
    command = ["evaluate", str(folder), "--recordings", str(recordings), "--episodes", "2"]
    whole = len([*folder.glob("p*.safetensors")])
    (folder / "p1.safetensors").unlink()
    assert main(command) == 0
    counted = f"{folder}: 1 of the {whole} policies of its training are missing; the others are used"
    assert f"warning: {counted}" in capsys.readouterr().err
    for file in folder.glob("*.safetensors"):
        file.unlink()
    assert main(command) == 1
    again = f"animat: {folder}: {whole} of the {whole} policies of its training are missing: run animat train again"
    assert capsys.readouterr().err.startswith(again)


@pytest.mark.oracle
def test_evaluate_says_whose_work_it_is(recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", str(policies), "--recordings", str(recordings), "--episodes", "3"]
    assert main([*command, "--interventions", "--json"]) == 0
    said = capsys.readouterr().out
    results: dict[str, Any] = last_json(said)["whose_work"]  # type: ignore[assignment]
    names = [row["name"] for row in results["rows"]]
    changed = ["ideal actuator", "random spikes", "silent", "shuffled", "yoked", "turned round"]
    assert names == ["as they are", *changed]
    of_each = last_json(said)["policies"].values()  # type: ignore[attr-defined]
    assert results["rows"][0]["mean_return"] == pytest.approx(np.mean(list(of_each)))
    assert "whose work is it: the same policies" in said and "the robot has only one goal" in said
    assert not any("bits" in line for line in said.splitlines() if "95 % interval" in line)
    assert main([*command[:2], "--episodes", "2", "--interventions"]) == 1


@pytest.mark.oracle
def test_evaluate_reports_the_optimum_of_the_recording_it_evaluates_on(
    recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = with_a_coarse_optimum(monkeypatch)
    command = ["evaluate", str(policies), "--recordings", str(recordings), "--at-min", "0"]
    assert main([*command, "--optimum", "--json"]) == 0
    said = capsys.readouterr().out
    results: dict[str, Any] = last_json(said)
    assert asked == [1.0]
    simulator = fit_timeline(extract_series(read_recordings([recordings]))).at(0.0)
    direct = best_return(Animat(Cartpole(), Thresholds(9), 5), simulator, resolution=0.25, episodes=0)
    interval = results["optimum"].pop("interval")
    assert interval["low"] <= interval["value"] == direct.value <= interval["high"]
    assert results["optimum"] == {k: v for k, v in direct.to_dict().items() if k != "interval"} | {"left_out": []}
    assert f"optimal return {direct.value:.1f}, 95 % interval {interval['low']:.1f} to" in said
    means = {row["name"]: row["mean_return"] for row in results["rows"]}
    score = (means["policies"] - means["random"]) / (direct.value - means["random"])
    assert results["rows"][0]["normalised_score"] == pytest.approx(score)


@pytest.mark.oracle
def test_one_of_several_recordings_in_a_file_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = (("well000", "rec0000"), ("well001", "rec0000"))
    table = mapping_table([3, 9], [100, 200])
    events = event_table([0.1, 0.6, 1.1], ["", "", ""])
    spikes = spike_table([0.105, 0.5, 0.606, 1.104], [9, 3, 9, 9])
    file = write_maxwell(tmp_path / "a.h5", mapping=table, spikes=spikes, events=events, parts=parts, recorded=[3, 9])
    assert main(["inspect", str(file), "--part", "well001/rec0000", "--out", str(tmp_path / "f"), "--json"]) == 0
    assert Path(last_json(capsys.readouterr().out)["figures"][0]).is_file()  # type: ignore[index]


@pytest.mark.parametrize("names", [("a.npz", "a.nwb"), ("series.npz",)])
def test_figures_that_would_overwrite_each_other_are_refused(
    names: tuple[str, ...], recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in names:
        shutil.copy(next(recordings.glob("*.nwb")), tmp_path / name)
    assert main(["inspect", *(str(tmp_path / name) for name in names), "--out", str(tmp_path / "figures")]) == 1
    assert "would all be called" in capsys.readouterr().err
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes")])
def test_too_little_memory_is_one_line(
    error: Exception,
    policies: Path,
    recordings: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def roll_out(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("animat.evaluation.controls.roll_out", roll_out)
    assert main(["evaluate", str(policies), "--recordings", str(recordings), "--episodes", "2"]) == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("animat: out of memory") and message.endswith(": ask for fewer episodes (--episodes 2)")
    assert ("9 bytes" in message) == bool(str(error))


def nothing(folder: Path, recordings: Path, policies: Path) -> None:
    """No preparation."""


def truncated(folder: Path, recordings: Path, policies: Path) -> None:
    whole = next(recordings.glob("*.nwb")).read_bytes()
    (folder / "bad.nwb").write_bytes(whole[: len(whole) // 2])


def arrays(**changed: object) -> Callable[[Path, Path, Path], None]:
    """A small NPZ recording with some of its arrays changed (None: left out)."""

    def prepare(folder: Path, recordings: Path, policies: Path) -> None:
        good: dict[str, object] = {
            "spike_time_s": [0.1, 0.2, 0.3],
            "spike_channel": ["a", "b", "a"],
            "channel_label": ["a", "b"],
            "stimulus_time_s": [0.05, 0.15],
            "stimulus_frequency_hz": [5.0, 10.0],
        }
        kept = {name: np.array(value) for name, value in (good | changed).items() if value is not None}
        np.savez(folder / "bad.npz", **kept)

    return prepare


def other_robot(folder: Path, recordings: Path, policies: Path) -> None:
    shutil.copytree(policies, folder / "policies")


def pipe(folder: Path, recordings: Path, policies: Path) -> None:
    os.mkfifo(folder / "pipe")


TRAIN = ["train", "cartpole", *QUICK, "--out", "{folder}/out", "--recordings"]

BAD = {
    "missing file": (nothing, [*TRAIN, "{folder}/none.nwb"], ["none.nwb"]),
    "empty folder": (nothing, [*TRAIN, "{folder}"], ["{folder}"]),
    "no recordings given": (nothing, TRAIN[:-1], ["--recordings"]),
    "truncated NWB": (truncated, [*TRAIN, "{folder}/bad.nwb"], ["bad.nwb"]),
    "wrong keys": (arrays(spike_time_s=None, times=[0.1]), [*TRAIN, "{folder}/bad.npz"], ["bad.npz", "spike_time_s"]),
    "NaN times": (arrays(spike_time_s=[0.1, np.nan, 0.3]), [*TRAIN, "{folder}/bad.npz"], ["bad.npz", "1 of 3", "NaN"]),
    "spikes without stimuli": (
        arrays(stimulus_time_s=np.zeros(0), stimulus_frequency_hz=None),
        [*TRAIN, "{folder}/bad.npz"],
        ["stimuli"],
    ),
    "channels that no table names": (
        arrays(spike_channel=["a", "b", "z"]),
        [*TRAIN, "{folder}/bad.npz"],
        ["bad.npz", "'z'"],
    ),
    "negative frequency": (
        arrays(stimulus_frequency_hz=[5.0, -10.0]),
        [*TRAIN, "{folder}/bad.npz"],
        ["bad.npz", "frequency", "-10"],
    ),
    "one condition": (
        nothing,
        [*TRAIN, "{recordings}", "--conditions", "all"],
        ["--conditions", "sort the stimuli by frequency, interval:5,10,", "one-condition"],
    ),
    "unknown conditions": (nothing, [*TRAIN, "{recordings}", "--conditions", "colour"], ["conditions", "colour"]),
    "window backwards": (nothing, [*TRAIN, "{recordings}", "--window-ms", "10", "2"], ["--window-ms: expected"]),
    "zero policies": (nothing, ["train", "cartpole", "--recordings", "{recordings}", "--policies", "0"], ["policies"]),
    "unknown parameter": (
        nothing,
        [*TRAIN, "{recordings}", "--parameters", "wheels=3"],
        ["--parameters: cartpole: expected", "wheels"],
    ),
    "a parameter called name": (nothing, [*TRAIN, "{recordings}", "--parameters", "name=3"], ["cartpole", "'name'"]),
    "no channels": (
        arrays(spike_time_s=np.zeros(0), spike_channel=np.zeros(0, np.int64), channel_label=None),
        ["inspect", "{folder}/bad.npz"],
        ["bad.npz", "channels: expected at least one"],
    ),
    "a parameter out of range": (
        nothing,
        [*TRAIN, "{recordings}", "--parameters", "pole_mass_kg=-1"],
        ["animat: --parameters: cartpole: pole_mass_kg: expected at least 1e-09, got -1"],
    ),
    "readouts of no name": (
        nothing,
        [*TRAIN, "{recordings}", "--readouts", "thirds"],
        ["animat: --readouts: expected all, halves, quadrants or a file of groups", "got thirds, which is not a file"],
    ),
    "places of no name": (
        nothing,
        ["record", "--places", "middle"],
        [
            "animat: --places: expected halves, quadrants, corners or a file of groups",
            "got middle, which is not a file",
        ],
    ),
    "a condition below 0": (
        nothing,
        ["inspect", "{recordings}", "--conditions", "interval:-5"],
        ["animat: --conditions: interval: expected positive frequencies in Hz, got -5"],
    ),
    "no recordings": (nothing, ["inspect"], ["animat: recordings: expected at least one file or folder"]),
    "a band from high to low": (
        nothing,
        ["convert", "{recordings}/recording_0_min.nwb", "--out", "{folder}/a.nwb", "--raw", "--band-hz", "3000", "100"],
        ["animat: --band-hz: expected 0 < low < high in Hz, got 3000 to 100"],
    ),
    "a threshold below 0": (
        nothing,
        ["convert", "{recordings}/recording_0_min.nwb", "--out", "{folder}/a.nwb", "--raw", "--threshold", "-1"],
        ["animat: --threshold: expected more than 0, got -1"],
    ),
    "a cluster elsewhere": (nothing, ["cluster", "remote"], ["animat: where: expected local, got 'remote'; see"]),
    "two protocols": (
        nothing,
        ["record", "--protocol", "{folder}/a.json", "--paper"],
        ["animat: --protocol, --paper: expected one of them, as each is a protocol, got both"],
    ),
    "a file for the folder of figures": (
        lambda folder, *_: (folder / "taken").write_text("x"),
        ["inspect", "{recordings}", "--out", "{folder}/taken"],
        ["taken: expected a folder, got a file; choose another --out"],
    ),
    "parameter without a number": (nothing, [*TRAIN, "{recordings}", "--parameters", "force_n"], ["--parameters"]),
    "a misspelt setting": (
        nothing,
        [*TRAIN, "{folder}/none", "--sac", "tau=0.01", "discuont=0.98"],
        ["--sac: discuont: no such setting; expected", "did you mean discount?"],
    ),
    "a setting of no name": (
        nothing,
        [*TRAIN, "{folder}/none", "--sac", "x=1"],
        ["--sac: x: no such", "learning_rate"],
    ),
    "a setting out of bounds": (nothing, [*TRAIN, "{folder}/none", "--sac", "discount=2"], ["--sac: discount", "1"]),
    "a setting of another kind": (nothing, [*TRAIN, "{folder}/none", "--sac", "batch=1.5"], ["--sac: batch", "whole"]),
    "a setting twice": (nothing, [*TRAIN, "{folder}/none", "--sac", "tau=0.1", "tau=0.2"], ["--sac", "tau once"]),
    "a misspelt setting of a live run": (
        nothing,
        ["live", "cartpole", "--culture", "virtual", "--out", "{folder}/out", "--sac", "taus=0.01"],
        ["--sac", "did you mean tau?"],
    ),
    "a seed beyond 32 bits": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--seed", "99999999999999999999"],
        ["seed", "4294967295"],
    ),
    "a minute that is none": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--at-min", "nan"],
        ["--at-min: expected"],
    ),
    "a minute before the first recording": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--at-min", "-20"],
        ["--at-min: expected", "0 min", "-20"],
    ),
    "a finding of another name": (
        nothing,
        [*TRAIN, "{recordings}", "--allow", "dead-windows"],
        ["allow", "dead-window,", "'dead-windows'; did you mean dead-window?"],
    ),
    "no workers, before recordings are read": (nothing, [*TRAIN, "{folder}/none", "--workers", "-2"], ["--workers"]),
    "no iterations, before recordings are read": (
        nothing,
        ["train", "cartpole", "--iterations", "0", "--recordings", "{folder}/none"],
        ["iterations"],
    ),
    "bins without end": (nothing, [*TRAIN, "{recordings}", "--bins", "100000000"], ["bins", "10000"]),
    "zero episodes": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--episodes", "0"],
        ["episodes"],
    ),
    "a policy for another robot": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--robot", "navigation"],
        ["{policies}, p0: expected a policy for navigation, got one for cartpole; give others, or no --robot"],
    ),
    "no policies": (nothing, ["evaluate", "{folder}", "--recordings", "{recordings}"], ["{folder}", "policies"]),
    "no recordings to run by": (
        nothing,
        ["run", "{policies}", "--out", "{folder}/session"],
        ["animat: --recordings: expected those that the policies were trained on, got none: make some with"],
    ),
    "another training's folder": (
        other_robot,
        ["train", "navigation", *QUICK, "--recordings", "{recordings}", "--out", "{folder}/policies"],
        ["{folder}/policies", "another"],
    ),
    "a word for a number": (nothing, ["run", "--at-min", "x"], ["animat: --at-min: expected a number, got 'x'; see"]),
    "recordings that are not there": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{folder}/nowhere"],
        ["{folder}/nowhere: no such file or folder of recordings; animat record makes them"],
    ),
    "a table in place of a policy": (
        lambda folder, *_: (folder / "p0.csv").write_text("time_s,rate_hz\n0.1,20\n"),
        ["evaluate", "{folder}/p0.csv", "--recordings", "{recordings}"],
        ["p0.csv: expected a policy, as animat train writes it"],
    ),
    "nothing to replay": (
        nothing,
        ["replay", "{folder}/nowhere"],
        ["{folder}/nowhere: expected a session, a policy or a folder of policies, got no such file"],
    ),
    "a part of a pulse": (
        nothing,
        ["run", "--budget-pulses", "1.5"],
        ["animat: --budget-pulses: expected a whole number, got '1.5'; see animat run"],
    ),
    "a word for a seed": (nothing, ["train", "--seed", "y"], ["animat: --seed: expected a whole number, got 'y'; see"]),
    "a word for a pause": (nothing, ["run", "--pause-s", "z"], ["animat: --pause-s: expected a number, got 'z'; see"]),
    "a simulator of another name": (
        nothing,
        ["run", "--simulator", "foo"],
        ["animat: --simulator: expected one of empirical, histogram, memory, got 'foo'; see"],
    ),
    **{
        f"10^9 {command} {option}": (
            nothing,
            [command, *more, option, str(10**9), "--out", "{folder}/out"],
            [option.removeprefix("--").split("-")[0], "1000000000"],
        )
        for command, more, option in (
            ("record", [], "--sessions"),
            ("record", [], "--trials"),
            ("record", [], "--pulses"),
            ("train", ["cartpole", "--recordings", "{recordings}"], "--policies"),
            ("run", ["{policies}", "--culture", "replay", "--recordings", "{recordings}"], "--episodes"),
        )
    },
    "10^12 iterations": (
        nothing,
        ["train", "cartpole", "--recordings", "{recordings}", "--iterations", "1000000000000"],
        ["iterations", "2,000,000,000"],
    ),
    "10^9 episodes": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--episodes", "1000000000"],
        ["--episodes", "side by side"],
    ),
    **{
        f"{command} of a device": (nothing, [command, *arguments], ["/dev/zero: expected a file, got a device"])
        for command, arguments in (
            ("inspect", ["/dev/zero"]),
            ("convert", ["/dev/zero", "--out", "{folder}/c.nwb"]),
            ("evaluate", ["/dev/zero", "--recordings", "{recordings}"]),
            ("study", ["/dev/zero", "--out", "{folder}/out"]),
            ("record", ["--protocol", "/dev/zero", "--out", "{folder}/out"]),
            ("record", ["--culture", "maxone", "--selection", "/dev/zero", "--out", "{folder}/out"]),
        )
    },
    "a pipe": (pipe, ["inspect", "{folder}/pipe"], ["pipe: expected a file, got a device or a pipe"]),
    "a protocol that is a pipe": (pipe, ["record", "--protocol", "{folder}/pipe"], ["expected a file"]),
    "a name that is too long": (nothing, ["inspect", "a" * 5000], ["File name too long"]),
    **{
        f"a name that is too long for {command}": (nothing, [command, *arguments, "a" * 300], ["File name too long"])
        for command, arguments in (
            ("replay", []),
            ("record", ["--out"]),
            ("train", ["cartpole", "--recordings", "{recordings}", "--out"]),
        )
    },
    "an empty text for a folder": (
        nothing,
        ["record", "--out", ""],
        ["--out: expected a value after it, got an empty text"],
    ),
    "a folder of others' recordings": (
        lambda folder, *_: (folder / "mine.nwb").write_text("x"),
        ["record", "--out", "{folder}"],
        ["expected only recordings of this series, got mine.nwb; choose another --out"],
    ),
    "a file for a folder": (
        lambda folder, *_: (folder / "taken").write_text("x"),
        ["record", "--out", "{folder}/taken"],
        ["taken: expected a folder, got a file; choose another --out"],
    ),
    "a file for the folder of a cluster's address": (
        lambda folder, *_: (folder / "taken").write_text("x"),
        ["cluster", "local", "--file", "{folder}/taken/cluster.json"],
        ["taken: expected a folder, got a file; choose another --file"],
    ),
    "a training's description that somebody edited": (
        lambda folder, *_: (folder / "training.json").write_text('{"training": [1], "fingerprint": "x"}'),
        ["train", "cartpole", "--mapping", "none", "--iterations", "6000", "--out", "{folder}"],
        ["expected a folder of this training, got one of another (training: [1] there, {{'"],
    ),
    "a closed loop of policies without neurons": (
        lambda folder, *_: WITHOUT_NEURONS.save(folder / "p0.safetensors"),
        ["run", "{folder}", "--out", "{folder}/session"],
        ["animat: policies: expected some that act through neurons, got some that were trained without"],
    ),
    **{
        f"{option} for a robot stepped outside JAX": (
            lambda folder, *_: PENDULUM.save(folder / "p0.safetensors"),
            ["run", "{folder}", "--recordings", "{recordings}", *option.split(), "--out", "{folder}/session"],
            [f"animat: {option}: expected a robot in JAX, got gymnasium:Pendulum-v1; leave it out"],
        )
        for option in ("--interventions", "--controls coupling")
    },
    **{
        f"{option} with a seed of more than 32 bits": (
            lambda folder, *_: None,
            # Before a culture is opened: with `--state` that would fail in another way.
            [
                "run",
                "{policies}",
                "--recordings",
                "{recordings}",
                *option.split(),
                "--seed",
                str(2**32),
                "--state",
                "no",
            ],
            ["animat: --seed: expected a whole number from 0 to 4294967295, got 4294967296"],
        )
        for option in ("--interventions", "--controls coupling")
    },
    "recordings for policies without neurons": (
        lambda folder, *_: WITHOUT_NEURONS.save(folder / "p0.safetensors"),
        ["evaluate", "{folder}", "--recordings", "{recordings}"],
        ["--recordings: expected none for policies without neurons, got {recordings}"],
    ),
    **{
        f"{option} for policies without neurons, {command}": (
            lambda folder, *_: WITHOUT_NEURONS.save(folder / "p0.safetensors"),
            [command, "{folder}", option, value],
            [f"{option}: expected none for policies without neurons, got {value}"],
        )
        for command in ("evaluate", "replay")
        for option, value in (("--at-min", "3"), ("--conditions", "pattern"), ("--burst-threshold", "0.5"))
    },
    "zero sessions": (
        nothing,
        ["record", "--sessions", "0", "--out", "{folder}/r"],
        ["sessions"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_line_and_leaves_nothing_behind(
    case: str, tmp_path: Path, recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    prepare, arguments, words = BAD[case]
    prepare(tmp_path, recordings, policies)
    places = {"folder": str(tmp_path), "recordings": str(recordings), "policies": str(policies)}
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    assert main([argument.format(**places) for argument in arguments]) != 0
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1
    assert lines[0].startswith("animat: ")
    for word in words:
        assert word.format(**places) in lines[0]
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before


WRITING = [
    ["inspect", "{recordings}"],
    ["convert", "{recordings}/none.nwb"],
    ["record", "--culture", "virtual"],
    ["reproduce", "--quick"],
    ["live", "cartpole"],
    ["run", "{policies}", "--recordings", "{recordings}", "--culture", "replay"],
    ["train", "cartpole", "--recordings", "{recordings}/none"],
]


@pytest.mark.parametrize(
    ("where", "arguments"),
    # A folder that is there may hold a finished training: it is tried after the recordings are read.
    [("under a file", given) for given in WRITING] + [("read only", given) for given in WRITING[:-1]],
)
def test_a_place_that_cannot_be_written_is_refused_before_the_work(
    where: str,
    arguments: list[str],
    recordings: Path,
    policies: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "taken").write_text("")
    out = tmp_path / "taken" / "out" if where == "under a file" else tmp_path / "empty"
    if where == "read only":
        out.mkdir()
        # Root may write everywhere: a file system that is read only answers like this.
        real, refused = tempfile.TemporaryFile, out
        refusal = OSError(errno.EROFS, "Read-only file system")

        def refusing(*given: Any, dir: Any = None, **named: Any) -> Any:
            if dir is not None and Path(dir) == refused:
                raise refusal
            return real(*given, dir=dir, **named)

        monkeypatch.setattr(tempfile, "TemporaryFile", refusing)
    if arguments[0] == "convert":
        out = out / "a.nwb"
    places = {"recordings": str(recordings), "policies": str(policies)}
    assert main([*(argument.format(**places) for argument in arguments), "--out", str(out)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1 and lines[0].startswith(f"animat: {out.parent if arguments[0] == 'convert' else out}")
    assert "cannot be" in lines[0]
    assert {file.name for file in tmp_path.iterdir()} == {"taken"} | ({"empty"} if where == "read only" else set())


def test_inspect_goes_on_after_a_file_that_cannot_be_read(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mixed"
    shutil.copytree(recordings, folder)
    (folder / "a.nwb").write_bytes(b"\x89HDF\r\n\x1a\n no more")
    (folder / "z_spikes.csv").write_text("time,channel\n1,2,3\n")
    assert main(["inspect", str(folder)]) == 1
    said = capsys.readouterr()
    lines = said.err.splitlines()
    assert len(lines) == 3
    assert "a.nwb: " in lines[0] and "z_spikes.csv, line 2: " in lines[1]
    assert "2 of 4 files could not be inspected" in lines[2]
    assert said.out.count("usable") == 2
    assert main(["inspect", str(folder), "--json"]) == 1
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(results["recordings"]) == 2
    assert results["unreadable"] == [str(folder / "a.nwb"), str(folder / "z_spikes.csv")]


def test_inspect_that_can_read_none_says_nothing_of_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in "ab":
        (tmp_path / f"{name}_spikes.csv").write_text("time,channel\n1,2,3\n")
    assert main(["inspect", str(tmp_path)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[2:] == ["animat: 2 of 2 files could not be inspected"]


@pytest.mark.parametrize(
    ("options", "name"),
    [(["--window-ms", "10", "2"], "--window-ms"), (["--burst-threshold", "7"], "--burst-threshold")],
)
def test_inspect_refuses_its_options_before_the_files(
    options: list[str], name: str, recordings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", str(recordings), *options]) == 1
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.splitlines()) == 1
    assert said.err.startswith(f"animat: {name}: expected ")


@pytest.mark.parametrize(
    ("arguments", "begins"),
    [
        ("train --iterations -5", "--iterations: expected at least 1, got -5"),
        ("train --duration-min -1", "--duration-min: expected more than 0, got -1"),
        ("train --pulse-cost -1", "--pulse-cost: expected at least 0, got -1"),
        ("train --pulse-cost 1 --mapping none", "--pulse-cost: expected 0 without neurons, got 1"),
        ("train --pulse-cost 1 --assess 3", "--pulse-cost: expected 0 with assessments"),
        ("train --neural-observation --mapping none", "--neural-observation: expected only with a mapping"),
        ("train --mapping none --delivery shuffled", "--delivery: expected none without neurons"),
        ("train --mapping none --recordings .", "--recordings: expected none without neurons, got ."),
        ("train --mapping none --recordings recordings", "--recordings: expected none without neurons, got recordings"),
        ("train --mapping none --bins 5", "--bins: expected none without neurons, got 5"),
        ("train --mapping none --window-ms 2 20.5", "--window-ms: expected none without neurons, got 2 20.5"),
        ("train --mapping none --percentiles first", "--percentiles: expected none without neurons, got first"),
        ("train --mapping none --duration-min 5", "--duration-min: expected none without neurons, got 5"),
        ("train --mapping none --simulator memory", "--simulator: expected none without neurons, got memory"),
        ("record --culture replay", "--recordings: expected some for --culture replay, got none"),
        ("record --recordings .", "--recordings: expected none for --culture virtual, got 1"),
        ("train --shadowing drawn --mapping none", "--shadowing: expected a mapping with 'drawn', got none"),
        ("train --goal higher", "--goal: 'higher': expected avoid"),
        ("inspect --optimum unicycle .", "--optimum: expected one of arm, cartpole"),
        ("record --interval-min -1", "--interval-min: expected more than 0 minutes"),
        ("reproduce --culture-seed 5-1", "--culture-seed: expected numbers and ranges, such as '1-5, 8', got '5-1'"),
        ("reproduce --workers 0", "--workers: expected at least 1, got 0"),
        ("reproduce --seed -1", "--seed: expected at least 0, got -1"),
        ("live --policies 0", "--policies: expected at least 1, got 0"),
        ("train unicycle", "robot: expected one of arm"),  # No option: it has its place.
        (
            "train --out policies --mapping none",
            "policies: expected a folder, got a file; choose another --out",
        ),  # A file, not the option.
    ],
)
def test_an_error_of_an_argument_begins_with_its_option(
    arguments: str, begins: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    if "--out" in arguments:
        (tmp_path / "policies").write_text("")
    assert main(arguments.split()) == 1
    assert capsys.readouterr().err.startswith(f"animat: {begins}")


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["train", "cartpole", "--policies", "many"], 2, ["--policies", "many", "animat train --help"]),
        (
            ["train", "unicycle"],
            1,
            [
                "robot: expected one of arm, cartpole, detour, navigation, shuttle, swing-up, wheels, got 'unicycle'",
                "module:Class",
                "and those of Gymnasium by gymnasium:ID",
            ],
        ),
        (["train", "cartpole", "--polices", "3"], 2, ["animat: unknown option --polices; did you mean --policies?"]),
        (["record", "--sesions=2"], 2, ["animat: unknown option --sesions=2; did you mean --sessions?"]),
        (["record", "--culture-seed", "7"], 2, ["animat: unknown option --culture-seed; did you mean --seed?"]),
        (["record", "--zzz"], 2, ["animat: unknown option --zzz; see animat record --help"]),
        (["convert", "a.csv", "--uot", "b.nwb"], 2, ["animat: unknown option --uot; did you mean --out?"]),
        (["--hepl"], 2, ["animat: unknown option --hepl; did you mean --help?"]),
        (["--versoin"], 2, ["animat: unknown option --versoin; did you mean --version?"]),
        (
            ["train", "cartpole", "pole"],
            2,
            ["animat: unexpected argument 'pole'; recordings are named after --recordings; see animat train --help"],
        ),
        (["train", "--robot", "pole"], 2, ["animat: robot: expected only its value, got --robot before it; see"]),
        (["train", "--seed=3", "--policies"], 2, ["animat: --policies: expected a value after it, got none; see"]),
        (
            ["record", "--out", "-a"],
            2,
            ["--out: expected a value after it, got one that begins with a dash: write --out="],
        ),
        (["convert", "a.csv"], 2, ["animat: --out: expected a value, got none; see animat convert --help"]),
        (["convert"], 2, ["animat: recording: expected a value, got none; see animat convert --help"]),
        (["cluster"], 2, ["animat: where: expected a value, got none; see animat cluster --help"]),
        (["cluster", "all"], 2, ["animat: where: expected local, got 'all'; see animat cluster --help"]),
        (["convert", "a", "--blank-ms", "2"], 2, ["animat: --blank-ms: expected two numbers, got one; see animat"]),
        (["train", "--shared-folder"], 2, ["animat: unknown option --shared-folder; did you mean --no-shared-folder?"]),
        (["train", "--window-ms", "2"], 2, ["animat: --window-ms: expected two numbers, got '2'; see animat train"]),
        (["trian"], 2, ["train, evaluate", "got 'trian'; did you mean train?"]),
        (["help"], 2, ["got 'help'; see animat --help"]),
        ([], 2, ["record, inspect", "got none; see animat --help"]),
    ],
)
def test_usage_errors_come_in_one_line(
    arguments: list[str], status: int, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == status
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert all(word in lines[0] for word in words)


def test_without_stimuli_nothing_is_said_about_allowing_that(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # No simulator could be fitted anyway.
    (tmp_path / "a_spikes.csv").write_text("time_s,channel\n0.1,1\n")
    assert main(["train", "cartpole", "--recordings", str(tmp_path), "--out", str(tmp_path / "policies")]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "no stimuli" in line and "--allow" not in line


@pytest.mark.oracle
def test_a_dead_window_is_refused_unless_allowed(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spikes = str(real_data / "brainoware_spikes.csv.gz")
    assert main(["inspect", spikes]) == 1
    assert "the window from 2 to 10 ms is dead" in capsys.readouterr().out
    train = ["train", "cartpole", "--recordings", spikes, *QUICK, "--out", str(tmp_path / "policies")]
    assert main(train) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "--allow dead-window" in lines[0]
    assert not (tmp_path / "policies").exists()
    assert main([*train, "--allow", "dead-window", "one-condition"]) == 0


@pytest.mark.oracle
def test_a_real_culture_trains_a_controller_of_two_conditions(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    organoid = str(real_data / "organoid_cartpole_maxone.npz")
    choice = ["--recordings", organoid, "--conditions", "interval:5,10+-25%"]
    assert main(["train", "cartpole", *choice, *QUICK, "--out", str(tmp_path)]) == 0
    assert "the conditions differ by 0.16 at most" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path), *choice, "--json"]) == 0
    rows = last_json(capsys.readouterr().out)["rows"]
    assert [row["name"] for row in rows][2:4] == ["constant 5 Hz", "constant 10 Hz"]  # type: ignore[attr-defined, index]


LITTLE_ROOM = """
import resource, signal, sys
from animat.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (8_192, 8_192))
sys.exit(main())
"""


@pytest.mark.oracle
def test_a_full_disk_while_training_leaves_what_was_there_whole(recordings: Path, tmp_path: Path) -> None:
    """For real: the process may write files of 8 kB and no more."""

    ran = subprocess.run(
        [sys.executable, "-c", LITTLE_ROOM, *(part.format(folder=tmp_path) for part in TRAIN), str(recordings)],
        capture_output=True,
        text=True,
        # Python would keep compiled modules cut off at the limit.
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert ran.returncode == 1
    lines = [line for line in ran.stderr.splitlines() if line.startswith("animat: ")]
    assert len(lines) == 1
    assert "cannot be written" in lines[0]
    assert "Traceback" not in ran.stderr
    assert not list((tmp_path / "out").rglob("*.partial*"))
    assert not list((tmp_path / "out").glob("*.safetensors"))


@pytest.mark.parametrize(("kind", "status"), [(InvalidArgument, 1), (KeyboardInterrupt, 130)])
def test_other_faults_are_reported_too(
    kind: type[BaseException], status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(command: Train) -> None:
        error = kind("it went wrong")
        error.add_note("and then: the device could not be\nswitched off")
        raise error

    monkeypatch.setattr(Train, "run", run)
    assert main(["train", "cartpole"]) == status
    assert capsys.readouterr().err.splitlines()[1:] == ["animat: and then: the device could not be switched off"]


def test_a_warning_about_many_recordings_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    found = [Finding("binning", "warning", f"at {m} min: lost", m / 100) for m in (0, 20, 10)]
    print_warnings([*found, Finding("bursts", "note", "a few"), Finding("few-samples", "warning", "12 only", 12.0)])
    assert capsys.readouterr().err.splitlines() == [
        "warning: binning: at 20 min: lost (and 2 more like it)",
        "warning: few-samples: 12 only",
    ]


@pytest.mark.parametrize(
    ("name", "values", "worst"),
    [("few-samples", (29.0, 1.0, 12.0), 1.0), ("no-difference", (0.06, 0.01), 0.01), ("drift", (0.3, -0.6, 0.4), -0.6)],
)
def test_the_worst_of_several_warnings_is_printed(
    name: str, values: tuple[float, ...], worst: float, capsys: pytest.CaptureFixture[str]
) -> None:
    print_warnings([Finding(name, "warning", f"it is {value}", value) for value in values])
    assert capsys.readouterr().err.startswith(f"warning: {name}: it is {worst} (and ")


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"animat {version('animat')}\n"
    assert animat.__version__ == version("animat")
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "animat --version" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_no_none_and_no_false(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    assert "options" in said
    assert "None" not in said
    assert "False" not in said
    assert "(default: )" not in said
    assert "{FLOAT" not in said


@pytest.mark.parametrize("command", COMMANDS)
def test_what_help_says_of_an_option_is_one_paragraph(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    kinds = [kind for kind in reversed(COMMANDS[command].__mro__) if is_dataclass(kind)]
    said_of = {o.arg_name: o.description for kind in kinds for o in docstring_parser.parse_from_object(kind).params}
    for option in fields(COMMANDS[command]):
        said = " ".join((said_of[option.name] or "").split())
        assert said and any(said in line for line in lines), option.name


def test_a_terminal_without_utf_8_gets_question_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Train, "run", lambda command: print("97.1 ± 0.5 of Müller's") or {})
    for arguments, line in ((["train"], "97.1 ? 0.5 of M?ller's\n"), (["--help"], "? record ")):
        written = io.BytesIO()
        monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding="ascii"))
        with contextlib.suppress(SystemExit):
            assert main(arguments) == 0
        assert line in written.getvalue().decode("ascii")


@pytest.mark.oracle
@pytest.mark.parametrize("arguments", [["live", "--help"], ["--version"]])
def test_a_reader_that_closes_early_is_no_error(arguments: list[str]) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "animat", *arguments], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.oracle
@pytest.mark.parametrize("arguments", [["live", "--help"], ["--version"]])
def test_output_that_is_closed_is_no_error_and_a_full_disk_is_reported_in_a_line(arguments: list[str]) -> None:
    closed = subprocess.run(
        ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "animat", *arguments], capture_output=True, text=True
    )
    assert (closed.returncode, closed.stderr) == (0, "")
    if not (disk := Path("/dev/full")).exists():
        pytest.skip("no /dev/full here")
    with disk.open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "animat", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    message = "animat: standard output: cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, message)


@pytest.mark.oracle
@pytest.mark.parametrize("is_disk", [True, False])
def test_a_log_on_a_full_disk_or_that_nobody_reads_ends_no_command(is_disk: bool) -> None:
    if is_disk and not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    read, write = os.pipe()
    os.close(read)
    with open("/dev/full" if is_disk else write, "w") as log:  # noqa: PTH123 - a pipe has no path
        # An error of the log would have another status.
        assert subprocess.run([sys.executable, "-m", "animat", "trian"], stderr=log).returncode == 2
    if is_disk:
        os.close(write)


def test_a_working_folder_that_is_gone_is_named_and_not_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "a.npz", spike_time_s=[0.5, 2.5], spike_channel=[0, 1], stimulus_time_s=[])
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(["inspect", str(tmp_path / "a.npz")]) == 1
    assert capsys.readouterr().err == (
        "animat: working folder: expected one, got none (No such file or directory): cd to one that exists\n"
    )
