"""A series of any culture through its contract. Oracles: the same calls by hand, and what a stand-in was given."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import stand_in_cl
import stand_in_maxlab
from animat.cli import main
from animat.ctrl_c import interruptible
from animat.cultures.base import Culture
from animat.cultures.devices.cl1 import CL1_PULSE, CL1Culture
from animat.cultures.devices.maxone import MaxOneCulture
from animat.cultures.kinds import culture_named
from animat.cultures.observed import Observed
from animat.cultures.replay import ReplayCulture
from animat.cultures.series import record_series
from animat.errors import DeviceFailed, InvalidArgument, InvalidFile, Mismatch
from animat.recordings.reading import read_recording, read_recordings
from animat.stimulation.array import MAXONE
from animat.stimulation.patterns import draw_patterns
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.selection import Selection
from animat.writing import exclusive_lock
from fake_culture import FakeCulture
from synthetic_recordings import synthetic_recording, write_synthetic_series

SHORT = Protocol((20.0, 80.0), patterns=5, trials=5, setup_s=0.5, pause_s=0.2)


def replay() -> ReplayCulture:
    return ReplayCulture([synthetic_recording(1, channels=32, start_min=30.0)], seed=3)


@pytest.mark.oracle
def test_a_replay_is_recorded_at_its_minutes(tmp_path: Path) -> None:
    with replay() as culture:
        series = record_series(
            lambda: culture, SHORT, tmp_path / "a", sessions=3, interval_min=2.0, seed=4, progress=(seen := Mock())
        )
    done = [update.args[0] for update in seen.update.mock_calls]
    # Two blocks a recording.
    assert list(dict.fromkeys(done)) == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    rests = [update.args[:2] for update in seen.update.mock_calls if update.args[2] == "the culture rests"]
    assert rests == [(1, 3), (2, 3)]
    assert [file.name for file in series.files] == [f"recording_{minute:04}_min.nwb" for minute in (0, 2, 4)]
    assert series.missed_min == []
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == [file.name for file in series.files]
    with replay() as culture:
        for session, recording in enumerate(read_recordings(tmp_path / "a")):
            culture.rest(60 * (30.0 + 2.0 * session) - culture.now_s)
            assert recording.equals(culture.record(SHORT, 40_000 + session))
            assert recording.start_min == pytest.approx(30.0 + 2.0 * session)


@pytest.mark.oracle
def test_what_is_due_next_is_recorded_and_missed_recordings_are_listed(tmp_path: Path) -> None:
    with FakeCulture() as culture:
        first = record_series(lambda: culture, SHORT, tmp_path, sessions=2, interval_min=2.0)
        # The second alone says when the series began.
        first.files[0].unlink()
        kept = first.files[1].read_bytes()
        # Sessions 2 and 3 would have begun, and 3 be over, when the next is due.
        culture.rest(300.0)
        pulses = culture.pulses
        series = record_series(lambda: culture, SHORT, tmp_path, sessions=6, interval_min=2.0)
    assert series.missed_min == [0.0, 4.0]
    assert [file.name[10:14] for file in series.files] == ["0002", "0006", "0008", "0010"]
    assert series.files[0].read_bytes() == kept
    minutes = [read_recording(file).start_min - 0.2 for file in series.files]
    assert minutes[2:] == pytest.approx([8.0, 10.0])
    assert 6.0 <= minutes[1] < 8.0
    assert culture.pulses == pulses + 3 * 10


def test_a_culture_that_fails_leaves_what_was_recorded_before(tmp_path: Path) -> None:
    def fail(*_: object) -> None:
        raise DeviceFailed("the test says so")

    # Two blocks a recording: the second recording's first.
    with FakeCulture(fault=fail, at=2) as culture:  # type: ignore[arg-type]
        with pytest.raises(DeviceFailed, match="the test says so"):
            record_series(lambda: culture, SHORT, tmp_path, sessions=3, interval_min=1.0)
        assert [file.name for file in tmp_path.iterdir()] == ["recording_0000_min.nwb"]
        series = record_series(lambda: culture, SHORT, tmp_path, sessions=3, interval_min=1.0)
        assert len(series.files) == 3


def test_a_second_run_in_a_folder_at_work_is_refused_before_any_stimulus(tmp_path: Path) -> None:
    with replay() as culture, exclusive_lock(tmp_path):
        with pytest.raises(Mismatch, match="another run is at work in this folder"):
            record_series(lambda: culture, SHORT, tmp_path, sessions=1, interval_min=2.0)
        assert culture.delivered == 0


class Unopened(FakeCulture):
    def _open(self) -> None:
        raise AssertionError("opened")


@pytest.mark.parametrize("there", ["another file", "a finished series"])
def test_a_folder_that_cannot_be_written_to_is_found_before_a_culture_is_opened(
    there: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = partial(record_series, protocol=SHORT, folder=tmp_path, interval_min=1.0)
    if there == "a finished series":
        again(FakeCulture, sessions=2)
    else:
        (tmp_path / "notes.txt").touch()
    before = sorted(tmp_path.iterdir())

    def read_only(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("animat.writing.tempfile.TemporaryFile", read_only)
    with pytest.raises(InvalidFile, match=f"{tmp_path.name}: cannot be written: Permission denied; choose another"):
        again(Unopened, sessions=3)
    assert sorted(tmp_path.iterdir()) == before
    if there == "a finished series":
        # With nothing to be written it may be read only: the clock alone says that these are not of this culture.
        with pytest.raises(Mismatch, match="before the culture's clock"):
            again(FakeCulture, sessions=2)


def test_without_room_for_a_recording_nothing_is_stimulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of 1 MB, and 2 MB a minute: two blocks of half a second of set-up, a pause and five pulses, tails included.
    takes_min = 2 * (0.5 + 0.2 + SHORT.tail_s) / 60 + (5 / 20 + 5 / 80) / 60
    needed = 1e6 + 2e6 * takes_min
    room = iter([1.01 * needed, 1.01 * needed, 0.99 * needed])
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("animat.writing.shutil.disk_usage", lambda _: usage._replace(free=next(room)))
    (tmp_path / "notes.txt").touch()
    with FakeCulture() as culture:
        with pytest.raises(InvalidFile, match=f"expected {needed / 1e6:.2f} MB free .* MB: make room, or choose"):
            record_series(lambda: culture, SHORT, tmp_path, sessions=2, interval_min=1.0)
        assert culture.pulses == 10
    assert [file.name for file in sorted(tmp_path.glob("*.nwb"))] == ["recording_0000_min.nwb"]


def test_what_another_run_left_at_the_last_moment_is_checked_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with replay() as other:
        (file,) = record_series(lambda: other, SHORT, tmp_path / "other", sessions=1, interval_min=2.0).files

    @contextmanager
    def ended_in_between(folder: Path) -> Iterator[None]:
        shutil.copytree(file.parent, folder)
        with exclusive_lock(folder):
            yield

    monkeypatch.setattr("animat.cultures.series.exclusive_lock", ended_in_between)
    with replay() as culture:
        with pytest.raises(Mismatch, match=r"recording_0000_min\.nwb: expected .* got another \(protocol\."):
            record_series(lambda: culture, replace(SHORT, pulses=2), tmp_path / "series", sessions=2, interval_min=2.0)
        assert culture.delivered == 0


def test_nothing_is_mixed_or_written_over(tmp_path: Path) -> None:
    with replay() as culture:
        record_series(lambda: culture, SHORT, tmp_path, sessions=1, interval_min=2.0)
        with pytest.raises(Mismatch, match=r"recording_0000_min\.nwb: expected .* got another \(protocol\."):
            record_series(lambda: culture, replace(SHORT, pulses=2), tmp_path, sessions=2, interval_min=2.0)
    with replay() as culture, pytest.raises(Mismatch, match=r"clock, which is at 30\.00 min, got one at 30\.00 min"):
        record_series(lambda: culture, SHORT, tmp_path, sessions=2, interval_min=2.0)
    with FakeCulture() as culture:
        with pytest.raises(Mismatch, match=r"got another \(source: .* there, .* now\): choose another folder"):
            record_series(lambda: culture, SHORT, tmp_path, sessions=2, interval_min=2.0)
        with pytest.raises(InvalidArgument, match="sessions: expected at least 1"):
            record_series(lambda: culture, SHORT, tmp_path / "b", sessions=0)
        with pytest.raises(InvalidArgument, match="interval_min: expected more than 0 minutes, got nan"):
            record_series(lambda: culture, SHORT, tmp_path / "b", interval_min=float("nan"))
        with pytest.raises(InvalidArgument, match="interval_min: expected at least the"):
            record_series(lambda: culture, SHORT, tmp_path / "b", sessions=2, interval_min=0.01)
    assert not (tmp_path / "b").exists()
    assert len(list(tmp_path.iterdir())) == 1


def cl1(patch: pytest.MonkeyPatch) -> tuple[Culture, Callable[[], list[float]]]:
    neurons = stand_in_cl.install(patch)
    neurons.now = 1_000_000  # the device was started before
    return CL1Culture(), lambda: sorted({frame / 25_000 for frame, *_ in neurons.pulses})


def maxone(patch: pytest.MonkeyPatch) -> tuple[Culture, Callable[[], list[float]]]:
    rig = stand_in_maxlab.install(patch)
    sites = np.array([(20 + 25 * (i // 8)) * 220 + 15 + 25 * (i % 8) for i in range(32)])
    selection = Selection(MAXONE, np.arange(13_000, 13_050), sites, draw_patterns(MAXONE, sites, seed=1))
    culture = MaxOneCulture(selection, stream=stand_in_maxlab.Stream(rig), settle=False)
    return culture, lambda: sorted({pulse.frame / 20_000 for pulse in rig.delivered})


@pytest.mark.oracle
@pytest.mark.parametrize("make", [cl1, maxone])
def test_devices_are_recorded_by_the_same_calls(
    make: Callable[[pytest.MonkeyPatch], tuple[AbstractContextManager[Culture], Callable[[], list[float]]]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    device, pulses_s = make(monkeypatch)
    protocol = replace(SHORT, pulse=CL1_PULSE if make is cl1 else BALANCED_PULSE)
    began = datetime.now(UTC).replace(microsecond=0)
    with device as culture:
        zero_s = culture.now_s
        first = record_series(lambda: culture, protocol, tmp_path, sessions=2, interval_min=0.5)
    with device as culture:
        series = record_series(lambda: culture, protocol, tmp_path, sessions=3, interval_min=0.5)
    assert series.files[:2] == first.files
    recordings = read_recordings(tmp_path)
    assert [r.start_min - zero_s / 60 for r in recordings] == pytest.approx([0, 0.5, 1.0], abs=0.01)
    dates = [datetime.fromisoformat(recording.provenance["recorded_at"]) for recording in recordings]
    assert [recording.recorded_at for recording in recordings] == dates
    assert [began, *dates] == sorted([began, *dates]) and dates[-1] <= datetime.now(UTC)
    assert len(pulses_s()) == 3 * 10


def test_another_chip_or_other_patterns_of_a_cl1_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    culture, pulses_s = cl1(monkeypatch)
    protocol = replace(SHORT, pulse=CL1_PULSE)
    with culture:
        record_series(lambda: culture, protocol, tmp_path, sessions=1, interval_min=0.5)
    with CL1Culture(culture.patterns) as given:
        record_series(lambda: given, protocol, tmp_path / "given", sessions=1, interval_min=0.5)
    chip = {"system_id": "stand-in", "chip_id": "another"}
    for make, folder, words in (
        (partial(CL1Culture, seed=2), tmp_path, r"pattern_seed: 0 there, 2 now"),
        (partial(CL1Culture, culture.patterns[10:]), tmp_path / "given", r"patterns, got others \(\d+ of them\)"),
        (CL1Culture, tmp_path, r"chip_id: 'none' there, 'another' now"),
    ):
        if "chip_id" in words:
            monkeypatch.setattr(sys.modules["cl"], "get_system_attributes", lambda: chip)
        with pytest.raises(Mismatch, match=words):
            record_series(make, protocol, folder, sessions=2, interval_min=0.5)
    assert len(pulses_s()) == 2 * 10


def test_other_electrodes_of_a_maxone_are_refused_and_other_units_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, _ = maxone(monkeypatch)
    assert isinstance(culture, MaxOneCulture)
    protocol = replace(SHORT, pulse=BALANCED_PULSE)
    with culture:
        record_series(lambda: culture, protocol, tmp_path, sessions=1, interval_min=0.5)
        units = culture.provenance["stimulation_units"]
    rig, chosen = culture._given_stream.rig, culture.selection  # type: ignore[union-attr]
    again = Selection(MAXONE, chosen.recording, chosen.stimulation[::-1], chosen.patterns)
    with MaxOneCulture(again, stream=stand_in_maxlab.Stream(rig), settle=False) as rewired:
        assert rewired.provenance["stimulation_units"] != units
        rewired.rest(20.0)
        record_series(lambda: rewired, protocol, tmp_path, sessions=2, interval_min=0.5)
    moved = Selection(MAXONE, chosen.recording + 1, chosen.stimulation, chosen.patterns)
    with MaxOneCulture(moved, stream=stand_in_maxlab.Stream(rig), settle=False) as other:
        assert other.channels.label.tolist() == culture.channels.label.tolist()
        with pytest.raises(Mismatch, match=r"channels, got others \(electrodes differ\)"):
            record_series(lambda: other, protocol, tmp_path, sessions=3, interval_min=0.5)


def test_a_replay_of_other_recordings_is_refused(tmp_path: Path) -> None:
    with replay() as culture:
        record_series(lambda: culture, SHORT, tmp_path, sessions=1, interval_min=2.0)
        now_s = culture.now_s
    with ReplayCulture([synthetic_recording(2, channels=32, start_min=30.0)], seed=3) as other:
        other.rest(now_s - other.now_s)
        with pytest.raises(Mismatch, match="replayed seed: 1 there, 2 now"):
            record_series(lambda: other, SHORT, tmp_path, sessions=2, interval_min=2.0)


def test_the_command_records_a_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_synthetic_series(1, tmp_path / "synthetic", sessions=1)
    command = [
        "record",
        "--culture",
        "replay",
        "--sessions",
        "2",
        "--trials",
        "2",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--recordings", str(tmp_path / "synthetic"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert [Path(file).name for file in data["recordings"]] == ["recording_0000_min.nwb", "recording_0010_min.nwb"]
    assert read_recording(data["recordings"][1]).start_min == pytest.approx(10.0)
    for wrong in (command, ["record", "--selection", "x.json"], ["record", "--culture", "maxone"]):
        assert main(wrong) != 0
        error = capsys.readouterr().err.strip()
        assert "\n" not in error
        assert error.startswith("animat: --recordings" if wrong is command else "animat: --selection")


@pytest.mark.usefixtures("in_the_foreground")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_kill_while_it_is_recorded_closes_the_culture(
    tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(culture: FakeCulture, observed: Observed) -> Observed:
        os.kill(os.getpid(), number)
        time.sleep(0.2)
        return observed

    culture = FakeCulture(fault=kill, at=1)
    monkeypatch.setattr("animat.cultures.kinds.culture_named", lambda *_, **__: culture)
    before = signal.getsignal(number)
    given = ["--culture", "maxone", "--selection", "x.json", "--trials", "2", "--out", str(tmp_path)]
    assert main(["record", *given]) == 130
    assert not culture.is_open
    assert culture.deliveries == 2
    assert signal.getsignal(number) is before


def test_a_hang_up_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible():
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(0.01)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_arguments_of_the_wrong_kind_are_refused_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match="make_culture: expected a function that returns a culture, got None"):
        record_series(lambda: None, SHORT, tmp_path)  # type: ignore[arg-type, return-value]
    with FakeCulture() as culture:
        with pytest.raises(InvalidArgument, match="seed: expected a whole number, got 'a'"):
            culture.record(SHORT, seed="a")  # type: ignore[arg-type]
        with pytest.raises(InvalidArgument, match="electrodes: expected a list of electrodes, got 5"):
            culture.stimulate(5, SHORT.pulse)  # type: ignore[arg-type]
        assert culture.pulses == 0


def test_a_seed_below_0_is_refused_before_a_device_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in_cl.install(monkeypatch)
    with FakeCulture() as culture, pytest.raises(InvalidArgument, match="seed: expected 0 or more, got -1"):
        record_series(lambda: culture, SHORT, tmp_path / "a", sessions=1, seed=-1)
    assert culture.pulses == 0
    for make in (
        lambda: CL1Culture(seed=-1),
        lambda: ReplayCulture([synthetic_recording(1, channels=32)], seed=-1),
        lambda: culture_named("maxone", seed=-1, selection="x.json"),
        lambda: culture_named("virtual", seed=-1),
    ):
        with pytest.raises(InvalidArgument, match="seed: expected 0 or more, got -1"):
            make()
    for more in (["--culture", "cl1"], ["--culture", "maxone", "--selection", "x.json"], []):
        assert main(["record", *more, "--seed", "-1", "--out", str(tmp_path / "a")]) == 1
        assert capsys.readouterr().err == "animat: --seed: expected 0 or more, got -1\n"
    assert not (tmp_path / "a").exists()
