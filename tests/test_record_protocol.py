"""`animat record --protocol` records what the file states, and refuses an impossible file immediately."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.cli.record import Record
from animat.cultures.base import Culture
from animat.cultures.kinds import pulse_for
from animat.cultures.series import Series, check_interval
from animat.errors import InvalidArgument
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.stimulation.protocol import Protocol, read_protocol
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.schedule import make_schedule
from fake_culture import FakeCulture
from synthetic_recordings import synthetic_recording

PATTERNS = np.arange(500).reshape(100, 5)
MINE = Protocol((5.0, 40.0), "mixed", 3, patterns=4, trials=2, setup_s=1.0, pause_s=3.0, tail_s=0.5)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("synthetic") / "synthetic.nwb"
    write_nwb(synthetic_recording(1, patterns=6, channels=16), file)
    return file


@pytest.fixture
def replayed(synthetic: Path, tmp_path: Path) -> list[str]:
    """The command that records a replay of a synthetic recording, up to the protocol."""
    return ["record", "--culture", "replay", "--sessions", "1", "--recordings", str(synthetic), "--out",
            str(tmp_path / "out")]  # fmt: skip


def test_a_culture_is_recorded_by_the_file(
    replayed: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.json").write_text(MINE.to_json())
    assert main([*replayed, "--protocol", str(tmp_path / "mine.json"), "--json"]) == 0
    (file,) = json.loads(capsys.readouterr().out.splitlines()[-1])["recordings"]
    recording = read_recording(file)
    assert recording.protocol == MINE
    assert str(recording.presentation) == "mixed, 3 pulses per trial"
    frequency_hz, times = np.unique(recording.stimuli.frequency_hz, return_counts=True)
    assert (frequency_hz.tolist(), times.tolist()) == ([5.0, 40.0], [6, 6])
    assert recording.stimuli.time_s[0] == pytest.approx(3.0)
    assert set(recording.stimuli.pattern.tolist()) <= set(range(4))
    # The same command finds nothing to do; with another file it is another series.
    assert main([*replayed, "--protocol", str(tmp_path / "mine.json")]) == 1
    assert "clock" in capsys.readouterr().err
    (tmp_path / "mine.json").write_text(MINE.to_json().replace("40.0", "20.0"))
    assert main([*replayed, "--protocol", str(tmp_path / "mine.json")]) == 1
    assert "got another (protocol.frequencies_hz[1]: 40.0 there, 20.0 now)" in capsys.readouterr().err


def test_what_the_file_leaves_out_takes_the_defaults(replayed: list[str], tmp_path: Path) -> None:
    """Patterns are as many as the culture has, which a replay of six has fewer of than usual; order and pulses too."""
    (tmp_path / "mine.json").write_text('{"trials": 6}')
    assert main([*replayed, "--protocol", str(tmp_path / "mine.json")]) == 0
    recording = read_recording(tmp_path / "out" / "recording_0000_min.nwb")
    assert recording.protocol == Protocol(order="mixed", patterns=6, trials=6, pulse=pulse_for("replay"))


def test_unknown_electrodes_are_reported_with_their_file(
    replayed: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.json"
    file.write_text("[[1], [99999]]")
    assert main([*replayed, "--places", str(file), "--trials", "2"]) == 1
    expected = r"expected electrodes among the \d+ that stimulate this culture \(.*\), got .*99999\n"
    assert re.fullmatch(rf"animat: --places {re.escape(str(file))}: {expected}", capsys.readouterr().err)
    file.write_text('{"places": [[1], [99999]]}')
    assert main([*replayed, "--protocol", str(file)]) == 1
    assert re.fullmatch(rf"animat: {re.escape(str(file))}: places: {expected}", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_a_virtual_culture_gets_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def noted(make_culture: object, protocol: Protocol, *_: object, **__: object) -> Series:
        asked.append(protocol)
        return Series([], [])

    monkeypatch.setattr("animat.cultures.series.record_series", noted)
    (tmp_path / "mine.json").write_text('{"frequencies_hz": [5, 20], "setup_s": 0}')
    assert main(["record", "--protocol", str(tmp_path / "mine.json"), "--out", str(tmp_path / "out")]) == 0
    assert main(["record", "--pulses", "5", "--out", str(tmp_path / "out")]) == 0
    assert main(["record", "--out", str(tmp_path / "out")]) == 0
    assert main(["record", "--paper", "--out", str(tmp_path / "out")]) == 0
    mixed = Protocol(order="mixed", trials=1000)
    # What a file leaves out is as without one.
    assert asked == [
        replace(mixed, frequencies_hz=(5, 20), setup_s=0),
        replace(mixed, pulses=5, trials=200),
        mixed,
        Protocol(),
    ]


@pytest.mark.parametrize("culture", ["virtual", "replay"])
@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        (None, [], "no such file"),
        (
            "[5]",
            [],
            'mine.json: protocol: expected what Protocol.to_json writes, such as {"frequencies_hz": [5, 10]}, got',
        ),
        (
            '{"pulses": 2,\n"order" "mixed"}',
            [],
            "mine.json: protocol: expected JSON, got malformed text: Expecting ':' delimiter: line 2 column 9",
        ),
        (
            '{"frequency_hz": [5]}',
            [],
            "mine.json: frequency_hz: no such setting at the top; expected some of frequencies_hz",
        ),
        ('{"pulses": 0}', [], "mine.json: pulses: expected at least 1"),
        ('{"setup_s": 700}', ["--sessions", "2"], "--interval-min: expected at least"),
        (MINE.to_json(), ["--order", "mixed"], "--protocol: expected it alone, got --order too"),
        (MINE.to_json(), ["--pulses", "1", "--trials", "100"], "got --pulses, --trials too"),
    ],
)
def test_impossible_protocols_are_refused_before_a_culture_is_opened(
    culture: str,
    text: str | None,
    more: list[str],
    words: str,
    replayed: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Culture, "open", lambda self: pytest.fail("opened"))
    if text is not None:
        (tmp_path / "mine.json").write_text(text)
    command = replayed if culture == "replay" else ["record", "--out", str(tmp_path / "out")]
    assert main([*command, "--protocol", str(tmp_path / "mine.json"), *more]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("animat: ") and words in line
    assert not (tmp_path / "out").exists()


def test_more_patterns_than_a_virtual_culture_has_are_refused_before_its_array_is_scanned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Culture, "open", lambda self: pytest.fail("opened"))
    (tmp_path / "mine.json").write_text('{"patterns": 101}')
    out = tmp_path / "out"
    assert main(["record", "--protocol", str(tmp_path / "mine.json"), "--out", str(out)]) == 1
    assert "patterns: expected at most the 100 that the culture's electrode selection has" in capsys.readouterr().err
    assert not out.exists()


def test_pulses_faster_than_the_response_window_cause_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("animat.cultures.series.record_series", lambda *_, **__: Series([], []))
    (tmp_path / "mine.json").write_text('{"frequencies_hz": [80, 100, 125, 500]}')
    assert main(["record", "--protocol", str(tmp_path / "mine.json"), "--out", str(tmp_path / "out")]) == 0
    assert "warning: at 125 Hz, 500 Hz the next pulse comes before the response window ends" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "trials"),
    [
        ({}, 1000),
        ({"pulses": 5}, 200),
        ({"places": "corners"}, 1000),
        ({"places": "halves"}, 500),
        ({"places": "quadrants", "pulses": 3}, 83),
        ({"order": "blocked"}, 1000),
        ({"paper": True}, 100),
        ({"paper": True, "pulses": 5}, 100),
    ],
)
def test_the_default_recording_takes_less_than_the_interval(options: dict[str, Any], trials: int) -> None:
    record = Record(**options)
    assert record._protocol().trials == trials
    check_interval(record._protocol(), 2, record.interval_min)


def test_the_protocol_in_the_documentation_takes_as_long_as_it_says(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "recording-a-culture.md").read_text()
    (example,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (tmp_path / "mine.json").write_text(example)
    protocol = read_protocol(tmp_path / "mine.json")
    assert set(json.loads(example)) == set(json.loads(protocol.to_json()))
    assert protocol.pulse == BALANCED_PULSE
    schedule = make_schedule(protocol, PATTERNS, seed=1)
    stimulated_s = sum(protocol.pulses * protocol.trials / f for f in protocol.frequencies_hz)
    stated = re.search(r"([\d,]+)\s+pulses, ([\d.]+) s of stimulation, ([\d.]+) s with set-up and pause", page)
    assert stated is not None
    pulses, stimulated, whole = stated.groups()
    assert int(pulses.replace(",", "")) == len(schedule)
    assert float(stimulated) == pytest.approx(stimulated_s, abs=0.05)
    assert float(whole) == pytest.approx(schedule.duration_s, abs=0.06)


def test_an_invalid_protocol_is_refused_before_anything_is_delivered() -> None:
    with FakeCulture() as culture:
        for other, got in (({"trials": 5}, r"\{'trials': 5\}"), (None, "None"), (Protocol, "<class")):
            with pytest.raises(InvalidArgument, match=rf"protocol: expected a Protocol, such as .*, got {got}"):
                culture.record(other)  # type: ignore[arg-type]
        assert culture.delivered == 0
