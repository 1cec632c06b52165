"""Reasons why a closed loop would not reach evaluated returns, and that recordings are read as in training."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.evaluation.transfer import faster_than_recorded
from animat.neurons.timeline import load_timeline
from animat.progress import Silent
from animat.recordings.findings import Finding
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Recording
from animat.responses.condition import Condition
from animat.stimulation.protocol import Order, Presentation, Protocol
from animat.stimulation.schedule import make_schedule
from animat.studies.recording import FitSimulators
from animat.studies.specification import Simulators
from animat.studies.toml import read_study
from test_responses import recording

pytestmark = pytest.mark.usefixtures("in_this_process")

TINY = Path(__file__).parent / "tiny_study.toml"
QUICK = ["--policies", "1", "--iterations", "64"]
WARNED = ("other-presentation", "other-calibration", "old-calibration", "other-recording", "no-memory")


def a_recording(start_min: float, order: str = "mixed", *, memory: bool = False) -> Recording:
    """5 and 20 Hz on 30 channels, intervals up to 18 % off; one response in ten is of all channels: a burst."""
    rng = np.random.default_rng(1)
    frequency_hz = np.repeat([5.0, 20.0], 150)
    frequency_hz = rng.permutation(frequency_hz) if order == "mixed" else frequency_hz
    time_s = 1 + np.cumsum(rng.uniform(0.85, 1.18, 300) / frequency_hz)
    spikes, was_large = [], False
    for t, f in zip(time_s, frequency_hz, strict=True):
        if rng.random() < 0.1:
            channels = np.repeat(np.arange(30), 6)
        else:
            mean = 3 + f / 5 + (6 if memory and was_large else 0)
            count = rng.poisson(mean)
            was_large = bool(count > mean)
            channels = rng.integers(0, 30, count)
        spikes += [(t + 0.003 + 0.005 * rng.random(), channel) for channel in channels]
    made = recording(spikes, time_s, 30, float(time_s[-1]) + 1, frequency_hz)
    return replace(made, start_min=start_min, presentation=Presentation(order))  # type: ignore[arg-type]


def ran(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """A command's line of JSON, which has everything that it warns of."""
    assert main([*arguments, "--json"]) == 0
    said = capsys.readouterr()
    found: dict[str, Any] = json.loads(said.out.splitlines()[-1])
    assert {*re.findall(r"^warning: ([a-z-]+): ", said.err, re.MULTILINE)} <= {f["name"] for f in found["findings"]}
    return found


def warned(reported: dict[str, Any]) -> set[str]:
    return {finding["name"] for finding in reported["findings"]} & set(WARNED)


def series(folder: Path, *recordings: Recording) -> str:
    for each in recordings:
        write_nwb(each, folder / f"recording_{each.start_min:04.0f}_min.nwb")
    return str(folder)


@pytest.mark.oracle
def test_policies_of_blocks_are_reported_by_training_and_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blocked = series(tmp_path / "blocked", a_recording(0, "blocked"), a_recording(10, "blocked"))
    trained = ran(capsys, "train", "cartpole", "--recordings", blocked, *QUICK, "--out", str(tmp_path / "b"))
    assert "other-presentation" in warned(trained)
    evaluated = ran(capsys, "evaluate", str(tmp_path / "b"), "--recordings", blocked)
    assert "other-presentation" in evaluated["not_met_in_a_closed_loop"]
    assert main(["evaluate", str(tmp_path / "b"), "--recordings", blocked]) == 0
    assert (
        "these returns cannot be expected of a closed loop on the culture: see the warnings (other-presentation)"
        in capsys.readouterr().out
    )

    mixed = series(tmp_path / "mixed", a_recording(0), a_recording(10))
    trained = ran(capsys, "train", "cartpole", "--recordings", mixed, *QUICK, "--out", str(tmp_path / "m"))
    assert not warned(trained)
    # Recordings in blocks predict as little for policies of mixed recordings as for a loop.
    assert ran(capsys, "evaluate", str(tmp_path / "m"), "--recordings", blocked)["not_met_in_a_closed_loop"] == [
        "other-calibration"
    ]


@pytest.mark.oracle
def test_an_unknown_presentation_is_not_reported_as_different(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = series(tmp_path / "r", replace(a_recording(0), presentation=None))
    train = ["train", "cartpole", "--recordings", recordings, *QUICK, "--out", str(tmp_path / "p")]
    assert {f["name"] for f in ran(capsys, *train)["findings"]} >= {"unknown-presentation"}
    assert main(["evaluate", str(tmp_path / "p"), "--recordings", recordings]) == 0
    said = "it is not known whether a closed loop on the culture would reach these returns: see the warnings (unknown-"
    assert said in capsys.readouterr().out
    # Another robot's folder is refused by the robot, not by what follows from it.
    assert main(["train", "navigation", *train[2:]]) == 1
    assert "(training.robot.name: 'cartpole' there, 'navigation' now)" in capsys.readouterr().err


@pytest.mark.oracle
def test_the_age_of_the_recording_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = series(tmp_path / "r", *(a_recording(minute) for minute in (0, 10, 90)))
    out = str(tmp_path / "p")
    trained = ran(capsys, "train", "cartpole", "--recordings", recordings, "--duration-min", "20", *QUICK, "--out", out)
    # Trained up to 10 min, and 80 min older by now.
    assert (trained["recorded_at_min"], warned(trained)) == (10.0, {"old-calibration"})
    evaluate = ["evaluate", out, "--recordings", recordings]
    assert ran(capsys, *evaluate)["not_met_in_a_closed_loop"] == ["other-recording"]
    assert ran(capsys, *evaluate, "--at-min", "10")["not_met_in_a_closed_loop"] == ["old-calibration"]
    # By default training goes through all recordings, and there is nothing to report.
    ran(capsys, "train", "cartpole", "--recordings", recordings, *QUICK, "--out", str(tmp_path / "all"))
    evaluated = ran(capsys, "evaluate", str(tmp_path / "all"), "--recordings", recordings)
    assert (evaluated["recorded_at_min"], evaluated["not_met_in_a_closed_loop"]) == (90.0, [])


@pytest.mark.oracle
def test_a_memory_that_the_simulator_lacks_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = series(tmp_path / "r", a_recording(0, memory=True))
    for simulator, found in (([], set()), (["--simulator", "histogram"], {"no-memory"})):
        out = str(tmp_path / f"p{len(simulator)}")
        train = ["train", "cartpole", "--recordings", recordings, *QUICK, *simulator, "--out", out]
        assert warned(ran(capsys, *train)) == found


@pytest.mark.parametrize(
    ("order", "kind", "found"),
    [("mixed", "histogram", True), ("mixed", "memory", False), ("blocked", "histogram", False)],
)
def test_a_study_reports_the_memory_that_its_simulators_lack(
    order: str, kind: Any, found: bool, tmp_path: Path
) -> None:
    """Not of recordings in blocks, from which nothing else can be made."""
    series(tmp_path / "recordings", a_recording(0, order, memory=True))
    study = replace(read_study(TINY), simulators=Simulators(kind=kind), comparisons=())
    kept, _ = FitSimulators(study).run(tmp_path, Silent())
    warnings = [each.message for each in load_timeline(kept).findings if each.name == "no-memory"]
    assert len(warnings) == found and all('(simulators.kind = "memory")' in message for message in warnings)


@pytest.mark.oracle
def test_recordings_are_read_as_in_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = series(tmp_path / "r", a_recording(0))
    out = str(tmp_path / "p")
    reading = ["--conditions", "interval:5,20+-10%", "--burst-threshold", "1", "--window-ms", "2", "9"]
    trained = ran(
        capsys,
        "train",
        "cartpole",
        "--recordings",
        recordings,
        "--simulator",
        "empirical",
        *reading,
        *QUICK,
        "--out",
        out,
    )
    evaluate = ["evaluate", out, "--recordings", recordings]
    # Without repeating an option, on the same simulator: 100 episodes of the same seed are the same episodes.
    alike = ran(capsys, *evaluate)
    assert alike["policies"] == trained["returns"]
    assert not {f["name"] for f in alike["findings"]} & {"other-simulator", "other-window"}
    for option, says in (
        (["--burst-threshold", "0.5"], "burst threshold 1.0, here 0.5"),
        (["--conditions", "interval:5,20+-25%"], "conditions interval:5,20+-10%, here interval:5,20+-25%"),
        (["--simulator", "histogram"], "kind empirical, here histogram"),
    ):
        (finding,) = (f for f in ran(capsys, *evaluate, *option)["findings"] if f["name"] == "other-simulator")
        assert finding["message"].endswith(says) or says in finding["message"]


@pytest.mark.oracle
def test_the_papers_setting_is_one_word(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = series(tmp_path / "r", a_recording(0), a_recording(10))
    folders = {word: tmp_path / f"p{len(word)}" for word in ("", "--paper")}
    for word, out in folders.items():
        asked = [word] if word else []
        assert main(["train", "navigation", "--recordings", recordings, *asked, *QUICK, "--out", str(out)]) == 0
    usual, paper = (json.loads((out / "training.json").read_text()) for out in folders.values())
    assert [of["training"]["mapping"] for of in (usual, paper)] == ["9-thresholds", "1-threshold"]
    assert [of["simulators"]["kind"] for of in (usual, paper)] == ["memory", "histogram"]
    assert [of["training"]["duration_min"] for of in (usual, paper)] == [20.0, 60.0]

    assert main(["record", "--paper", "--protocol", "x.json"]) == 1
    assert "--protocol, --paper: expected one of them, as each is a protocol, got both" in capsys.readouterr().err


@pytest.mark.parametrize("order", ["blocked", "mixed"])
def test_a_loop_that_is_faster_than_the_recording_is_reported(order: Order) -> None:
    protocol = Protocol(frequencies_hz=(5, 10, 40), order=order, trials=40)
    schedule = make_schedule(protocol, np.zeros((100, 1), np.int64), 1)
    tables = [block.stimuli for block in schedule.blocks]
    time_s = np.concatenate([300 * i + table.time_s for i, table in enumerate(tables)])
    recorded = recording([(1.0, 0)] * 200, time_s, 4, 1000.0)

    def reported(*frequencies_hz: float) -> list[Finding]:
        conditions = [Condition(f"{hz} Hz", hz, "Hz") for hz in frequencies_hz]
        return list(faster_than_recorded(recorded, conditions))

    assert reported(5, 10, 40) == reported(5) == list(faster_than_recorded(None, [])) == []
    (finding,) = reported(5, 200)
    assert (finding.name, finding.value) == ("faster-than-recorded", pytest.approx(5.0))
    assert "at up to 200 Hz, 5 ms apart" in finding.message and "less than 25 ms apart" in finding.message
