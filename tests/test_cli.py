"""The commands as a user runs them, on good input and on bad: one line, an exit status, nothing half-written."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.animat import Animat
from animat.cli import main
from animat.cli_responses import say_findings
from animat.cli_train import Train
from animat.errors import InvalidArgument
from animat.evaluation.optimum import Optimum, best_return
from animat.mapping import Thresholds
from animat.neurons.series import extract_series
from animat.neurons.timeline import fit_timeline
from animat.recordings.findings import Finding
from animat.recordings.made_up import write_made_up_series
from animat.recordings.reading import read_recordings
from animat.robots import Cartpole
from rig_files import event_table, mapping_table, spike_table, write_maxwell

QUICK = ["--policies", "2", "--iterations", "2000"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("series") / "recordings"
    write_made_up_series(1, folder, sessions=2, patterns=40, channels=64)
    return folder


@pytest.fixture(scope="module")
def policies(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "policies"
    assert main(["train", "cartpole", "--recordings", str(recordings), *QUICK, "--out", str(folder)]) == 0
    return folder


def last_json(printed: str) -> dict[str, object]:
    """The last line as JSON, which has no NaN: `jq` and every other language would stumble over one."""
    return json.loads(printed.splitlines()[-1], parse_constant=pytest.fail)  # type: ignore[no-any-return]


def test_what_is_not_known_is_null_in_json(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # So short that no episode ends in the last chunk.
    short = ["train", "cartpole", "--recordings", str(recordings), "--policies", "1", "--iterations", "32"]
    assert main([*short, "--out", str(tmp_path), "--json"]) == 0
    printed = capsys.readouterr().out
    assert last_json(printed)["last_returns"] == {"p0": None}
    assert "no episode ended" in printed


def test_the_whole_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    series, trained, figures = tmp_path / "recordings", tmp_path / "policies", tmp_path / "figures"
    record = ["record", "--culture", "made-up", "--sessions", "2", "--out", str(series)]
    assert main([*record, "--json"]) == 0
    assert len(last_json(capsys.readouterr().out)["recordings"]) == 2  # type: ignore[arg-type]

    assert main(["inspect", str(series), "--out", str(figures), "--json"]) == 0
    told = last_json(capsys.readouterr().out)["recordings"]
    assert [r["stimuli"] for r in told] == [500, 500]  # type: ignore[attr-defined, index]
    assert all(Path(figure).is_file() for r in told for figure in r["figures"])  # type: ignore[attr-defined, index]

    train = ["train", "cartpole", "--recordings", str(series), *QUICK, "--out", str(trained)]
    assert main([*train, "--json"]) == 0
    assert set(last_json(capsys.readouterr().out)["last_returns"]) == {"p0", "p1"}  # type: ignore[call-overload]

    evaluate = ["evaluate", str(trained), "--recordings", str(series), "--at-min", "0", "--episodes", "10"]
    assert main([*evaluate, "--json"]) == 0
    told = last_json(capsys.readouterr().out)
    assert told["recorded_at_min"] == 0.0
    assert set(told["policies"]) == {"p0", "p1"}  # type: ignore[call-overload]


def test_evaluate_tells_the_limit_of_the_recording_it_evaluates_on(
    recordings: Path, policies: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def rough(*case: Any, resolution: float, seed: int) -> Optimum:
        asked.append(resolution)
        return best_return(*case, resolution=0.25, episodes=0, seed=seed)

    monkeypatch.setattr("animat.evaluation.table.best_return", rough)
    command = ["evaluate", str(policies), "--recordings", str(recordings), "--at-min", "0", "--episodes", "10"]
    assert main([*command, "--limit", "--json"]) == 0
    said = capsys.readouterr().out
    told: dict[str, Any] = last_json(said)
    assert asked == [1.0]
    simulator = fit_timeline(extract_series(read_recordings([recordings]))).at(0.0)
    direct = best_return(Animat(Cartpole(), Thresholds(1), 5), simulator, resolution=0.25, episodes=0)
    assert told["limit"] == direct.to_dict()
    assert direct.to_text() in said
    means = {row["name"]: row["mean_return"] for row in told["rows"]}
    score = (means["policies"] - means["random"]) / (direct.value - means["random"])
    assert told["rows"][0]["normalised_score"] == pytest.approx(score)


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

    monkeypatch.setattr("animat.evaluation.table.roll_out", roll_out)
    assert main(["evaluate", str(policies), "--recordings", str(recordings), "--episodes", "2"]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("animat: out of memory: ask for fewer episodes")


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
    "one condition": (nothing, [*TRAIN, "{recordings}", "--conditions", "all"], ["--conditions", "one-condition"]),
    "unknown conditions": (nothing, [*TRAIN, "{recordings}", "--conditions", "colour"], ["conditions", "colour"]),
    "window backwards": (nothing, [*TRAIN, "{recordings}", "--window-ms", "10", "2"], ["window_ms"]),
    "zero policies": (nothing, ["train", "cartpole", "--recordings", "{recordings}", "--policies", "0"], ["policies"]),
    "unknown parameter": (nothing, [*TRAIN, "{recordings}", "--parameters", "wheels=3"], ["cartpole", "wheels"]),
    "a parameter called name": (nothing, [*TRAIN, "{recordings}", "--parameters", "name=3"], ["cartpole", "'name'"]),
    "no channels": (
        arrays(spike_time_s=np.zeros(0), spike_channel=np.zeros(0, np.int64), channel_label=None),
        ["inspect", "{folder}/bad.npz"],
        ["bad.npz", "channels: expected at least one"],
    ),
    "parameter without a number": (nothing, [*TRAIN, "{recordings}", "--parameters", "force_n"], ["--parameters"]),
    "a seed beyond 32 bits": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--seed", "99999999999999999999"],
        ["seed", "4294967295"],
    ),
    "a minute that is none": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--at-min", "nan"],
        ["at_min"],
    ),
    "a minute before the first recording": (
        nothing,
        ["evaluate", "{policies}", "--recordings", "{recordings}", "--at-min", "-20"],
        ["at_min", "0 min", "-20"],
    ),
    "a finding of another name": (
        nothing,
        [*TRAIN, "{recordings}", "--despite", "dead-windows"],
        ["despite", "dead-window,", "'dead-windows'"],
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
        ["navigation", "cartpole"],
    ),
    "no policies": (nothing, ["evaluate", "{folder}", "--recordings", "{recordings}"], ["{folder}", "policies"]),
    "another training's folder": (
        other_robot,
        ["train", "navigation", *QUICK, "--recordings", "{recordings}", "--out", "{folder}/policies"],
        ["{folder}/policies", "another"],
    ),
    "a word for a number": (nothing, ["run", "--at-min", "x"], ["animat: --at-min: expected a number, got 'x'; see"]),
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
    "zero sessions": (
        nothing,
        ["record", "--culture", "made-up", "--sessions", "0", "--out", "{folder}/r"],
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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "cartpole", "--policies", "many"], ["--policies", "many", "animat train --help"]),
        (["train", "unicycle"], ["unicycle"]),
        (["train", "cartpole", "--polices", "3"], ["--polices"]),
        (["trian"], ["trian", "train, evaluate"]),
        ([], ["record, inspect"]),
    ],
)
def test_usage_errors_come_in_one_line(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert all(word in lines[0] for word in words)


def test_a_dead_window_is_refused_unless_told_otherwise(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spikes = str(real_data / "brainoware_spikes.csv.gz")
    assert main(["inspect", spikes]) == 0
    assert "the window from 2 to 10 ms is dead" in capsys.readouterr().out
    train = ["train", "cartpole", "--recordings", spikes, *QUICK, "--out", str(tmp_path / "policies")]
    assert main(train) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "--despite dead-window" in lines[0]
    assert not (tmp_path / "policies").exists()
    assert main([*train, "--despite", "dead-window", "one-condition"]) == 0


def test_a_real_culture_trains_a_controller_of_two_conditions(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    organoid = str(real_data / "organoid_cartpole_maxone.npz")
    choice = ["--recordings", organoid, "--conditions", "interval:5,10+-25%"]
    assert main(["train", "cartpole", *choice, *QUICK, "--out", str(tmp_path)]) == 0
    assert "the conditions differ by 0.28 at most" in capsys.readouterr().out
    assert main(["evaluate", str(tmp_path), *choice, "--episodes", "10", "--json"]) == 0
    rows = last_json(capsys.readouterr().out)["rows"]
    assert [row["name"] for row in rows][2:4] == ["constant 5 Hz", "constant 10 Hz"]  # type: ignore[attr-defined, index]


LITTLE_ROOM = """
import resource, signal, sys
from animat.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (8_192, 8_192))
sys.exit(main())
"""


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
def test_what_went_wrong_besides_is_told_too(
    kind: type[BaseException], status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(command: Train) -> None:
        error = kind("it went wrong")
        error.add_note("and then: the device could not be\nswitched off")
        raise error

    monkeypatch.setattr(Train, "run", run)
    assert main(["train", "cartpole"]) == status
    assert capsys.readouterr().err.splitlines()[1:] == ["animat: and then: the device could not be switched off"]


def test_a_warning_of_many_recordings_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    found = [Finding("binning", "warning", f"at {m} min: lost", m / 100) for m in (0, 20, 10)]
    say_findings([*found, Finding("bursts", "note", "a few"), Finding("few-samples", "warning", "12 only", 12.0)])
    assert capsys.readouterr().err.splitlines() == [
        "warning: at 20 min: lost (and 2 more like it)",
        "warning: 12 only",
    ]


@pytest.mark.parametrize(
    ("name", "values", "worst"),
    [("few-samples", (29.0, 1.0, 12.0), 1.0), ("no-difference", (0.06, 0.01), 0.01), ("drift", (0.3, -0.6, 0.4), -0.6)],
)
def test_the_worst_of_several_warnings_is_told(
    name: str, values: tuple[float, ...], worst: float, capsys: pytest.CaptureFixture[str]
) -> None:
    say_findings([Finding(name, "warning", f"it is {value}", value) for value in values])
    assert capsys.readouterr().err.startswith(f"warning: it is {worst} (and ")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"animat {version('animat')}\n"
