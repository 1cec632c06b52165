"""Recordings of devices, whose clock runs on between requests; against the stand-ins of CL1 and MaxOne."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from animat.cli import main
from animat.cultures.base import Culture
from animat.cultures.budget import Account, record_within
from animat.cultures.devices.cl1 import CL1_PULSE, CL1Culture
from animat.cultures.observed import Observed, Spikes
from animat.cultures.safety import Admitted
from animat.cultures.series import record_series
from animat.cultures.shortfalls import shortfall_findings
from animat.cultures.under_way import UNDER_WAY, PartialRecording
from animat.errors import DeviceFailed, InvalidFile
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording, read_recordings
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import BALANCED_PULSE
from animat.stimulation.schedule import make_schedule
from cultures import small_culture
from stand_in_cl import Neurons
from stand_in_cl import install as install_cl
from stand_in_maxlab import Rig
from stand_in_maxlab import install as install_maxlab
from test_maxone import culture_on

MIXED = Protocol(order="mixed", trials=400, patterns=20, setup_s=0.1)


def on_cl1(patch: pytest.MonkeyPatch) -> tuple[Culture, Callable[[float], None], Callable[[], np.ndarray], int]:
    """A culture on a stand-in, what lets time pass between requests, when pulses came, and its frames a second."""
    neurons: Neurons = install_cl(patch)

    def run_on(seconds: float) -> None:
        neurons.now += round(25_000 * seconds)

    return CL1Culture(), run_on, lambda: np.array(sorted({frame for frame, *_ in neurons.pulses})), 25_000


def on_maxone(patch: pytest.MonkeyPatch) -> tuple[Culture, Callable[[float], None], Callable[[], np.ndarray], int]:
    rig: Rig = install_maxlab(patch)

    def run_on(seconds: float) -> None:
        rig.now += round(20_000 * seconds)

    return culture_on(rig), run_on, lambda: np.array(sorted({pulse.frame for pulse in rig.delivered})), 20_000


def fail_at(n: int, error: BaseException, kind: type[Culture], patch: pytest.MonkeyPatch) -> Any:
    """Let the n-th request to a kind of culture fail; returns what delivered until then."""
    deliver, requests = kind._deliver, itertools.count(1)

    def deliver_or_fail(self: Culture, admitted: Admitted, duration_s: float) -> Observed:
        if next(requests) == n:
            raise error
        return deliver(self, admitted, duration_s)

    patch.setattr(kind, "_deliver", deliver_or_fail)
    return deliver


@pytest.mark.oracle
@pytest.mark.parametrize("device", [on_cl1, on_maxone])
@pytest.mark.parametrize("between_s", [0.0, 0.03, 0.2])
def test_a_long_block_is_recorded_in_stretches_and_the_clock_keeps_count(
    device: Callable, between_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, run_on, pulsed, rate_hz = device(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": CL1_PULSE if rate_hz == 25_000 else BALANCED_PULSE})
    seen: list[Recording] = []

    def follow(so_far: Callable[[], Recording]) -> None:
        seen.append(so_far())
        run_on(between_s)

    with culture:
        (block,) = culture.schedule(protocol, 3).blocks
        recording = culture.record(protocol, 3, follow=follow)
    frames = pulsed()
    cuts = [len(part.stimuli) for part in seen]
    # 155 s in stretches of at least 60 s, cut where the next pulse is 0.1 s away or more.
    assert len(cuts) == 2 and len(frames) == len(recording.stimuli) == 2000
    assert all(np.diff(block.stimuli.time_s)[cut - 1] > 0.0999 for cut in cuts)
    # The recording's times are the device's, also across the cuts.
    since_s = (frames - frames[0]) / rate_hz
    assert np.abs(recording.stimuli.time_s - recording.stimuli.time_s[0] - since_s).max() < 1.5 / rate_hz
    # Half of the gap at a cut makes up for the time between two requests; what is more makes it longer.
    asked_s = np.diff(block.stimuli.time_s)[[cut - 1 for cut in cuts]]
    gap_s = np.diff(since_s)[[cut - 1 for cut in cuts]]
    delay_s = np.maximum(0.0, between_s - asked_s / 2)
    assert np.all(gap_s > asked_s + delay_s - 2 / rate_hz) and np.all(gap_s < asked_s + delay_s + 0.01)
    # Each pulse that the stand-in answers has its spikes where they belong.
    answer_s = 0.005 if rate_hz == 20_000 else 0.0
    answered = np.arange(2000) if answer_s else np.flatnonzero(frames % 7 == 0)
    came_s = np.unique(recording.spike_times_s)
    expected_s = recording.stimuli.time_s[answered] + answer_s
    assert np.all(np.abs(came_s[np.searchsorted(came_s, expected_s - 1e-6)] - expected_s) < 1.5 / rate_hz)
    found = {finding.name: finding for finding in recording.findings}
    assert ("left-out" in found) == (between_s > 0)
    if between_s:
        assert found["left-out"].severity == "note"
        assert f"lacks: {2000 * between_s:.0f} ms between stretches" in found["left-out"].message


@pytest.mark.parametrize("device", [on_cl1, pytest.param(on_maxone, marks=pytest.mark.oracle)])
@pytest.mark.parametrize(
    "error", [KeyboardInterrupt, pytest.param(RuntimeError("a broken cable"), marks=pytest.mark.oracle)]
)
def test_what_was_recorded_before_an_error_is_kept(
    device: Callable, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, _, pulsed, rate_hz = device(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": CL1_PULSE if rate_hz == 25_000 else BALANCED_PULSE, "trials": 40})
    # A tenth of the time, and as many stretches.
    monkeypatch.setattr(type(culture), "stretch_s", 6.0)
    deliver = fail_at(3, error, type(culture), monkeypatch)
    with pytest.raises((KeyboardInterrupt, DeviceFailed)) as raised:
        record_series(lambda: culture, protocol, tmp_path, sessions=2, interval_min=5.0)
    (file,) = (tmp_path / "interrupted").iterdir()
    kept = read_recording(file)
    assert any("0.2 min with 1" in note and str(file) in note for note in raised.value.__notes__)
    assert len(kept.stimuli) == len(pulsed()) and 12 <= kept.duration_s < 13
    assert json.loads(kept.protocol.to_json())["trials"] == 40  # type: ignore[union-attr]
    # On another day the clock begins at 0 again: that one has another name.
    before = file.read_bytes()
    monkeypatch.setattr(type(culture), "_deliver", deliver)
    fail_at(3, error, type(culture), monkeypatch)
    culture = device(monkeypatch)[0]
    with pytest.raises((KeyboardInterrupt, DeviceFailed)):
        record_series(lambda: culture, protocol, tmp_path, sessions=2, interval_min=5.0)
    assert len(list((tmp_path / "interrupted").iterdir())) == 2 and file.read_bytes() == before
    # The series goes on without them.
    monkeypatch.setattr(type(culture), "_deliver", deliver)
    culture = device(monkeypatch)[0]
    series = record_series(lambda: culture, protocol, tmp_path, sessions=1, interval_min=5.0)
    assert [len(recording.stimuli) for recording in read_recordings([tmp_path])] == [200]
    assert len(series.files) == 1 and not list(tmp_path.glob(".*"))


def test_a_recording_whose_file_cannot_be_written_is_kept_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, *_ = on_maxone(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    (tmp_path / "elsewhere").mkdir()

    def fill(recording: Recording, file: Path) -> None:
        raise InvalidFile(f"{file}: No space left on device")

    def full(recording: Recording, file: Path) -> None:
        # Elsewhere there is room.
        (fill if tmp_path / "elsewhere" not in file.parents else write_nwb)(recording, file)

    monkeypatch.setattr("animat.cultures.series.write_nwb", fill)
    monkeypatch.setattr("animat.cultures.under_way.write_nwb", full)
    monkeypatch.setattr("animat.cultures.under_way.mkdtemp", lambda prefix: str(tmp_path / "elsewhere"))
    with pytest.raises(InvalidFile, match="No space") as raised:
        record_series(lambda: culture, protocol, tmp_path / "recordings", sessions=1)
    (file,) = (tmp_path / "elsewhere").rglob("*.nwb")
    assert str(file) in raised.value.__notes__[0] and len(read_recording(file).stimuli) == 100
    assert not (tmp_path / "recordings" / "interrupted").exists()


def test_a_recording_for_which_there_is_no_room_stays_as_it_is_until_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, *_ = on_maxone(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})

    def full(recording: Recording, file: Path) -> None:
        raise InvalidFile(f"{file}: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("animat.cultures.series.write_nwb", full)
        patch.setattr("animat.cultures.under_way.write_nwb", full)
        with pytest.raises(InvalidFile, match="No space") as raised:
            record_series(lambda: culture, protocol, tmp_path, sessions=1)
    assert raised.value.__notes__[0] == (
        f"what was recorded so far is in {tmp_path / UNDER_WAY}: make room, and animat recover keeps it"
    )
    assert main(["recover", str(tmp_path)]) == 0
    (file,) = (tmp_path / "interrupted").iterdir()
    assert len(read_recording(file).stimuli) == 100 and not (tmp_path / UNDER_WAY).exists()


def test_record_says_what_it_will_deliver_and_what_came_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    neurons = install_cl(monkeypatch)
    protocol = tmp_path / "few.json"
    protocol.write_text('{"trials": 10, "frequencies_hz": [10, 40]}')
    record = ["record", "--culture", "cl1", "--protocol", str(protocol), "--sessions", "1"]
    assert main([*record, "--out", str(tmp_path / "punctual")]) == 0
    said = capsys.readouterr().err
    assert "1 recording of 0.3 min, with 20 stimuli each; each pulse: -1 uA" in said and "later" not in said
    # The computer is 50 ms behind the device: of stimuli 25 ms apart each is late.
    neurons.late_frames = 1250 + 2500
    assert main([*record, "--out", str(tmp_path / "late")]) == 0
    said = capsys.readouterr().err
    (finding,) = read_recording(tmp_path / "late" / "recording_0000_min.nwb").findings
    frames = np.array(sorted({frame for frame, *_ in neurons.pulses}))[20:]
    with CL1Culture() as culture:
        (block,) = culture.schedule(Protocol(trials=10, frequencies_hz=(10, 40), order="mixed"), 10_000).blocks
    later = np.diff(frames) / 25_000 - np.diff(block.stimuli.time_s) > 0.001
    assert finding.name == "late-stimuli" and finding.value == pytest.approx((1 + later.sum()) / 20, abs=0.06)
    assert f"recording_0000_min.nwb: {finding.severity}: {finding.message}" in said


def test_frames_that_a_device_lost_are_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    culture, *_ = on_maxone(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    lost, now = {"frames lost on the way": 7}, {"loses": 0}
    deliver = type(culture)._deliver

    def lose(self: Culture, admitted: object, duration_s: float) -> object:
        lost["frames lost on the way"] += now["loses"]
        return deliver(self, admitted, duration_s)  # type: ignore[arg-type]

    monkeypatch.setattr(type(culture), "left_out", property(lambda _: dict(lost)))
    monkeypatch.setattr(type(culture), "_deliver", lose)
    for n, severity in ((0, None), (100, "note"), (30_000, "warning")):
        now["loses"] = n
        with culture:
            recording = culture.record(protocol, 1)
        found = {finding.name: finding for finding in recording.findings}
        assert (found["left-out"].severity if "left-out" in found else None) == severity
        if severity is not None:
            assert f"lacks: {n:,} frames lost on the way" in found["left-out"].message
            assert recording.provenance["left_out"] == f"{n} frames lost on the way"


def test_what_a_killed_run_left_is_kept_by_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    culture, *_ = on_maxone(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    with culture:
        recording = culture.record(protocol, 1)
    # As a killed run leaves it.
    PartialRecording(tmp_path)(lambda: recording)
    assert (tmp_path / UNDER_WAY).exists()
    record_series(lambda: on_maxone(monkeypatch)[0], protocol, tmp_path, sessions=1)
    kept = read_recording(tmp_path / "interrupted" / "recording_0000_min.nwb")
    assert kept.spike_times_s.tolist() == recording.spike_times_s.tolist()
    assert kept.stimuli.electrodes.tolist() == recording.stimuli.electrodes.tolist()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.oracle
def test_a_fast_protocol_is_cut_too_and_little_observed_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    culture, run_on, *_ = on_maxone(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "frequencies_hz": (20, 40), "trials": 2000})
    cuts = 0

    def follow(so_far: Callable[[], Recording]) -> None:
        nonlocal cuts
        cuts += 1
        run_on(3.0)

    with culture:
        recording = culture.record(protocol, 1, follow=follow)
    (finding,) = (each for each in recording.findings if each.name == "left-out")
    assert cuts == 2 and finding.severity == "warning"
    assert finding.value == pytest.approx(6 / recording.duration_s, rel=0.01)


@pytest.mark.oracle
def test_what_a_killed_run_left_stays_where_it_cannot_be_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    culture, *_ = on_maxone(monkeypatch)
    with culture:
        recording = culture.record(Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20}), 1)
    PartialRecording(tmp_path)(lambda: recording)
    (tmp_path / "interrupted").write_text("in the way")
    with pytest.raises(InvalidFile, match="interrupted: expected a folder"), PartialRecording(tmp_path, is_kept=True):
        pass
    assert (tmp_path / UNDER_WAY).exists()
    # Numbers are not used twice.
    (tmp_path / "interrupted").unlink()
    for _ in range(3):
        PartialRecording(tmp_path)(lambda: recording)
        with PartialRecording(tmp_path, is_kept=True):
            pass
    names = [file.name for file in sorted((tmp_path / "interrupted").iterdir())]
    assert names == [f"recording_0000_min{n}.nwb" for n in ("", "_2", "_3")]
    (tmp_path / "interrupted" / names[0]).unlink()
    PartialRecording(tmp_path)(lambda: recording)
    with PartialRecording(tmp_path, is_kept=True):
        pass
    assert sorted(file.name for file in (tmp_path / "interrupted").iterdir()) == names


@pytest.mark.parametrize("device", [on_cl1, on_maxone])
@pytest.mark.parametrize("fails_at", [1, 2, 3])
@pytest.mark.parametrize("is_admitted", [False, True])
def test_a_budget_counts_all_of_a_block_that_had_begun(
    device: Callable, fails_at: int, is_admitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    culture, _, pulsed, rate_hz = device(monkeypatch)
    protocol = Protocol(**vars(MIXED) | {"pulse": CL1_PULSE if rate_hz == 25_000 else BALANCED_PULSE, "trials": 40})
    monkeypatch.setattr(type(culture), "stretch_s", 6.0)
    account = Account()
    fail_at(
        fails_at, RuntimeError("a broken cable") if is_admitted else KeyboardInterrupt(), type(culture), monkeypatch
    )
    with culture:
        (block,) = culture.schedule(protocol, 1).blocks
        with pytest.raises((DeviceFailed, KeyboardInterrupt)):
            record_within(account, culture, protocol, 1)
    delivered = [len(stretch.stimuli) for stretch in block.stretches(6.0, 0.1)]
    assert len(pulsed()) == sum(delivered[: fails_at - 1])
    # No less than what came: the stretch that failed may have been delivered, too.
    assert account.pulses == len(block.stimuli) >= sum(delivered[:fails_at])


def test_record_says_where_a_killed_run_s_recording_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    culture, *_ = on_cl1(monkeypatch)
    with culture:
        recording = culture.record(Protocol(**vars(MIXED) | {"pulse": CL1_PULSE, "trials": 20}), 1)
    PartialRecording(tmp_path)(lambda: recording)
    install_cl(monkeypatch)
    protocol = tmp_path.with_suffix(".json")
    protocol.write_text('{"trials": 10, "frequencies_hz": [10, 40]}')
    record = ["record", "--culture", "cl1", "--protocol", str(protocol), "--sessions", "1", "--out", str(tmp_path)]
    assert main(record) == 0
    kept = tmp_path / "interrupted" / "recording_0000_min.nwb"
    assert f"what a run that was killed had recorded is in {kept}" in capsys.readouterr().err
    assert main(record) == 0 and "killed" not in capsys.readouterr().err


@pytest.mark.parametrize(("unobserved_s", "expected"), [(0.0, []), (0.0004, []), (0.0006, ["1 ms between stretches"])])
def test_less_than_half_a_millisecond_between_stretches_is_not_reported(
    unobserved_s: float, expected: list[str]
) -> None:
    (block,) = make_schedule(MIXED, np.arange(20)[:, None], 1).blocks
    observed = Observed(0.0, block.duration_s, Spikes(np.empty(0), np.empty(0, np.int64)), block.stimuli.time_s)
    found = shortfall_findings([(block, observed)], {}, unobserved_s, 20_000.0)
    assert [finding.message.partition("lacks: ")[2] for finding in found] == expected


def test_a_second_ctrl_c_or_a_kill_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While what was recorded is being kept, or while the recording itself is written: the next run keeps it."""
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    (made,) = record_series(lambda: on_maxone(monkeypatch)[0], protocol, whole, sessions=1).files

    def kill(recording: Recording, file: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("animat.cultures.series.write_nwb", kill)
        patch.setattr("animat.cultures.under_way.write_nwb", kill)
        with pytest.raises(KeyboardInterrupt):
            record_series(lambda: on_maxone(monkeypatch)[0], protocol, killed, sessions=1)
    assert [file.name for file in killed.iterdir()] == [UNDER_WAY]
    # Whatever is recorded there next.
    record_series(small_culture, Protocol(trials=1, patterns=8), killed, sessions=1)
    assert not (killed / UNDER_WAY).exists()
    kept, recording = read_recording(killed / "interrupted" / made.name), read_recording(made)
    for name in ("protocol", "culture", "loop_pulse", "presentation", "duration_s", "findings"):
        assert getattr(kept, name) == getattr(recording, name)
    assert kept.provenance.keys() == recording.provenance.keys() and kept.recorded_at is not None
    assert kept.spike_times_s.tolist() == recording.spike_times_s.tolist()


def test_recover_keeps_what_a_killed_recording_had_without_a_pulse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    culture, *_ = on_maxone(monkeypatch)
    with culture:
        recording = culture.record(Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20}), 1)
    live = tmp_path / "live"
    (live / "recordings").mkdir(parents=True)
    PartialRecording(live / "recordings")(lambda: recording)
    for command in (["inspect", str(live / "recordings")], ["live", "cartpole", "--out", str(live)]):
        assert main(command) == 1 and f"animat recover {live}" in capsys.readouterr().err
    assert main(["recover", str(live), "--json"]) == 0
    kept = live / "recordings" / "interrupted" / "recording_0000_min.nwb"
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"recordings": [str(kept)]}
    assert read_recording(kept).equals(recording) and not (live / "recordings" / UNDER_WAY).exists()
    # A damaged one stays as it is.
    (live / "recordings" / UNDER_WAY).write_bytes(b"PK\x03\x04 cut off")
    assert main(["recover", str(live / "recordings")]) == 0 and "it is damaged" in capsys.readouterr().out
    assert (live / "recordings" / "interrupted" / "damaged.npz").read_bytes() == b"PK\x03\x04 cut off"
    # What can be made again is not kept.
    provenance = {"source": "virtual culture: simulated", "seed": "1"}
    virtual = replace(recording, culture=RecordedCulture("virtual", 1), provenance=provenance, recorded_at=None)
    PartialRecording(live / "recordings")(lambda: virtual)
    assert main(["recover", str(live / "recordings")]) == 0
    assert "nothing to keep" in capsys.readouterr().out and not (live / "recordings" / UNDER_WAY).exists()


@pytest.mark.parametrize(("rate_hz", "least_s"), [(10.0, 0.05), (40.0, 0.0125), (80.0, 0.01), (95.0, 0.005)])
def test_a_stretch_ends_after_the_response_where_there_is_time(rate_hz: float, least_s: float) -> None:
    (block,) = make_schedule(Protocol((rate_hz,), trials=200), np.arange(100)[:, None], 1).blocks
    stretches = block.stretches(1.0, 1 / rate_hz)
    assert len(stretches) > 1
    since_s = [stretch.duration_s - stretch.stimuli.time_s[-1] for stretch in stretches[:-1]]
    np.testing.assert_allclose(since_s, least_s, atol=1e-3 if rate_hz == 95.0 else 1e-4)
    assert sum(stretch.duration_s for stretch in stretches) == pytest.approx(block.duration_s)


def test_a_disk_with_room_for_the_recording_alone_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    beside = []

    def full(recording: Recording, file: Path) -> None:
        beside.append((tmp_path / UNDER_WAY).exists())
        if beside[-1]:
            raise InvalidFile(f"{file}: No space left on device")
        write_nwb(recording, file)

    monkeypatch.setattr("animat.cultures.series.write_nwb", full)
    (file,) = record_series(lambda: on_maxone(monkeypatch)[0], protocol, tmp_path, sessions=1).files
    assert beside == [True, False] and [each.name for each in tmp_path.iterdir()] == [file.name]


@pytest.mark.oracle
def test_an_error_after_a_recording_is_in_its_file_leaves_no_second_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        def update(self, done: float, total: float, note: str = "") -> None:
            if list(tmp_path.glob("*.nwb")):
                raise RuntimeError("the terminal is gone")

    protocol = Protocol(**vars(MIXED) | {"pulse": BALANCED_PULSE, "trials": 20})
    with pytest.raises(RuntimeError, match="the terminal is gone"):
        record_series(lambda: on_maxone(monkeypatch)[0], protocol, tmp_path, sessions=1, progress=Broken())
    assert [each.name for each in tmp_path.iterdir()] == ["recording_0000_min.nwb"]
