"""A series of recordings, interrupted at any moment, is the undisturbed one. Oracle: the undisturbed run itself."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from animat.cultures.kinds import culture_arguments
from animat.cultures.same_culture import other_culture
from animat.cultures.series import LONGEST_MIN, STATE_FILE, _read_expected, check_interval, minutes_of, record_series
from animat.cultures.under_way import UNDER_WAY, PartialRecording
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidArgument, InvalidFile, Mismatch, UnsafeStimulus
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording, read_recordings
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import Phase, Pulse
from animat.stimulation.selection import Selection
from animat.writing import exclusive_lock
from cultures import small_culture

SHORT = Protocol((20.0, 80.0), patterns=5, trials=10, setup_s=0.5, pause_s=0.2)
PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from cultures import small_culture
from test_culture_series import record
record(sys.argv[2], sessions=int(sys.argv[3]))
"""


def record(folder: str | Path, *, sessions: int = 3, seed: int = 1, protocol: Protocol = SHORT) -> list[Path]:
    # Its orders are of the culture's own seed.
    return record_series(lambda: small_culture(seed), protocol, folder, sessions=sessions, interval_min=1.0).files


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return record(tmp_path_factory.mktemp("undisturbed"))


def same(files: list[Path], others: list[Path]) -> bool:
    return len(files) == len(others) and all(
        a.name == b.name and read_recording(a).equals(read_recording(b)) for a, b in zip(files, others, strict=True)
    )


@pytest.mark.oracle
def test_the_orders_of_stimuli_are_of_the_culture_s_own_seed(undisturbed: list[Path], tmp_path: Path) -> None:
    files = [*undisturbed[:2], *record(tmp_path, sessions=1, seed=2)]
    assert [read_recording(file).provenance["protocol_seed"] for file in files] == ["10000", "10001", "20000"]


def copied(files: list[Path], to: Path) -> Path:
    shutil.copytree(files[0].parent, to)
    return to


def test_there_are_two_recordings_by_default(tmp_path: Path) -> None:
    assert len(record_series(lambda: small_culture(), SHORT, tmp_path, interval_min=1.0).files) == 2


def test_a_series_has_its_recordings_at_their_minutes(undisturbed: list[Path]) -> None:
    folder = undisturbed[0].parent
    assert [file.name for file in undisturbed] == [f"recording_{m:04}_min.nwb" for m in (0, 1, 2)]
    recordings = read_recordings(folder)
    assert [recording.start_min for recording in recordings] == [0.0, 1.0, 2.0]
    assert len({tuple(recording.stimuli.pattern.tolist()) for recording in recordings}) == 3
    selection = Selection.load(folder / "selection.json")
    assert selection.recording.tolist() == recordings[0].channels.electrode.tolist()
    assert sorted(p.name for p in folder.iterdir() if p.suffix != ".nwb") == [STATE_FILE, "selection.json"]


@pytest.mark.oracle
def test_it_is_longer_when_asked_again_for_more(undisturbed: list[Path], tmp_path: Path) -> None:
    record(tmp_path / "a", sessions=1)
    record(tmp_path / "a", sessions=2)
    assert same(record(tmp_path / "a"), undisturbed)


def test_what_is_there_is_kept_and_nothing_is_done_again(
    undisturbed: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    times = [file.stat().st_mtime_ns for file in undisturbed]
    monkeypatch.setattr(VirtualCulture, "_open", lambda self: pytest.fail("opened in vain"))
    assert record(undisturbed[0].parent) == undisturbed
    assert record(undisturbed[0].parent, sessions=2) == undisturbed[:2]
    assert [file.stat().st_mtime_ns for file in undisturbed] == times


@pytest.mark.oracle
@pytest.mark.parametrize(
    "lost",
    [
        [STATE_FILE],
        ["recording_0002_min.nwb"],
        ["recording_0001_min.nwb"],
        ["recording_0000_min.nwb", STATE_FILE],
        ["recording_0001_min.nwb", "recording_0002_min.nwb", "selection.json"],
    ],
)
def test_whatever_is_lost_comes_back_the_same(undisturbed: list[Path], tmp_path: Path, lost: list[str]) -> None:
    folder = copied(undisturbed, tmp_path / "series")
    for name in lost:
        (folder / name).unlink()
    assert same(record(folder), undisturbed)


@pytest.mark.oracle
def test_a_state_that_is_behind_its_recordings_catches_up(undisturbed: list[Path], tmp_path: Path) -> None:
    # As if killed between a recording and the state after it.
    record(tmp_path / "behind", sessions=1)
    for file in undisturbed[1:2]:
        shutil.copy(file, tmp_path / "behind")
    assert same(record(tmp_path / "behind"), undisturbed)


@pytest.mark.oracle
def test_killed_after_the_last_recording_its_state_is_made_too(
    undisturbed: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_state = VirtualCulture.save_state

    def killed_at_the_last(self: VirtualCulture, path: Path, *, sessions: int) -> None:
        if sessions == 3:
            raise KeyboardInterrupt
        save_state(self, path, sessions=sessions)

    with monkeypatch.context() as patched:
        patched.setattr(VirtualCulture, "save_state", killed_at_the_last)
        with pytest.raises(KeyboardInterrupt):
            record(tmp_path / "series")
    assert len(list((tmp_path / "series").glob("*.nwb"))) == 3
    (tmp_path / "series" / "selection.json").unlink()
    assert same(record(tmp_path / "series"), undisturbed)
    for name in (STATE_FILE, "selection.json"):
        assert (tmp_path / "series" / name).read_bytes() == (undisturbed[0].parent / name).read_bytes()


def test_a_complete_series_gets_its_selection_back(
    undisturbed: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copied(undisturbed, tmp_path / "series")
    selection = (folder / "selection.json").read_bytes()
    (folder / "selection.json").unlink()
    monkeypatch.setattr(VirtualCulture, "_open", lambda self: pytest.fail("opened in vain"))
    record(folder)
    assert (folder / "selection.json").read_bytes() == selection


@pytest.mark.oracle
def test_a_series_whose_state_is_lost_is_recorded_again_to_have_it(undisturbed: list[Path], tmp_path: Path) -> None:
    folder = copied(undisturbed[:2], tmp_path / "series")
    state = (folder / STATE_FILE).read_bytes()
    (folder / STATE_FILE).unlink()
    assert same(record(folder), undisturbed)
    assert (folder / STATE_FILE).read_bytes() == state
    (folder / STATE_FILE).write_bytes(b"damaged")
    with pytest.raises(InvalidFile, match=r"culture.state: expected the whole state"):
        record(folder)


def test_a_state_after_something_else_is_not_gone_on_from(undisturbed: list[Path], tmp_path: Path) -> None:
    folder = copied(undisturbed, tmp_path / "series")
    culture = small_culture(1)
    culture.restore_state(folder / STATE_FILE)
    with culture:
        culture.save_state(folder / STATE_FILE)
    for sessions in (3, 4):
        with pytest.raises(Mismatch, match=r"culture.state: expected the state of a series .* choose another folder"):
            record(folder, sessions=sessions)
    assert same(sorted(folder.glob("*.nwb")), undisturbed)


def test_a_second_run_in_a_folder_at_work_is_refused(undisturbed: list[Path]) -> None:
    folder = undisturbed[0].parent
    with exclusive_lock(folder), pytest.raises(Mismatch, match="another run is at work in this folder"):
        record(folder)
    record(folder)


def test_what_another_run_left_at_the_last_moment_is_checked_too(
    undisturbed: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "series"

    @contextmanager
    def ended_in_between(path: Path) -> Iterator[None]:
        copied(undisturbed, path)
        with exclusive_lock(path):
            yield

    monkeypatch.setattr("animat.cultures.series.exclusive_lock", ended_in_between)
    with pytest.raises(Mismatch, match=r"_0000_min.nwb: expected .* same culture .*\(seed: 1 there, 2 now\)"):
        record(folder, seed=2)


def test_a_leftover_that_cannot_be_removed_stays(
    undisturbed: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copied(undisturbed, tmp_path / "series")
    leftover = folder / ".culture.state.abcd1234.partial.state"
    leftover.write_text("half")

    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refused)
        record(folder)
    assert leftover.exists()
    record(folder)
    assert not leftover.exists()


def test_a_recording_that_is_another_is_not_taken_for_it(undisturbed: list[Path], tmp_path: Path) -> None:
    folder = undisturbed[0].parent
    with pytest.raises(Mismatch, match=r"_0000_min.nwb: expected .* same culture .*\(seed: 1 there, 2 now\)"):
        record(folder, seed=2)
    with pytest.raises(Mismatch, match="protocol"):
        record(folder, protocol=Protocol((20.0, 80.0), patterns=5, trials=9, setup_s=0.5, pause_s=0.2))
    other = copied(undisturbed, tmp_path / "other")
    shutil.copy(other / "recording_0001_min.nwb", other / "recording_0002_min.nwb")
    with pytest.raises(Mismatch, match=r"recording_0002_min.nwb: expected"):
        record(other)
    (other / "recording_0002_min.nwb").unlink()
    (other / STATE_FILE).write_bytes(b"damaged")
    with pytest.raises(InvalidFile, match=r"culture.state: expected the whole state"):
        record(other)


def test_a_number_that_is_written_differently_is_the_same(undisturbed: list[Path]) -> None:
    """As another version of a device's package may write its sampling rate."""
    assert _read_expected(undisturbed[0], {"seed": "1.0"}, SHORT).equals(read_recording(undisturbed[0]))
    with pytest.raises(Mismatch, match=r"\(seed: 1 there, 1.5 now\)"):
        _read_expected(undisturbed[0], {"seed": "1.5"}, SHORT)


@pytest.mark.parametrize("is_stated", [True, False])
def test_what_another_revision_of_the_tissue_made_is_not_gone_on_with(
    is_stated: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = VirtualCulture.settings

    def before(self: VirtualCulture) -> dict[str, str]:
        # The first revision did not state itself.
        named = settings.__get__(self)
        return {key: words for key, words in named.items() if is_stated or key != "tissue_revision"}

    with monkeypatch.context() as patched:
        patched.setattr("animat.cultures.tissue.parameters.REVISION", 1)
        patched.setattr(VirtualCulture, "settings", property(before))
        (file,) = record(tmp_path, sessions=1)
    there = "1" if is_stated else "nothing"
    with pytest.raises(Mismatch, match=rf"_0000_min.nwb: expected .*\(tissue_revision: {there} there, 6 now\)"):
        record(tmp_path, sessions=2)
    with pytest.raises(Mismatch, match=r"culture.state: .* which differs in tissue_revision"):
        small_culture().restore_state(tmp_path / STATE_FILE)
    with small_culture() as culture:
        found = other_culture(read_recording(file), culture)
    assert found is not None
    assert "of virtual culture 1 with a different tissue_revision, but this is virtual culture 1" in found.message
    file.unlink()
    with pytest.raises(Mismatch, match=r"culture.state: .* which differs in tissue_revision"):
        record(tmp_path, sessions=2)


@pytest.mark.parametrize(
    ("interval_min", "words"),
    [
        (2.0, r"recording_0001_min\.nwb: expected a recording at a multiple of the interval, 2 min, got one"),
        # The order of its stimuli is that of another place in the series.
        (0.5, r"recording_0001_min\.nwb: .* got another \(protocol_seed: 10001 there, 10002 now\)"),
    ],
)
def test_a_series_of_another_interval_is_not_mixed_with_it(
    undisturbed: list[Path], tmp_path: Path, interval_min: float, words: str
) -> None:
    folder = copied(undisturbed, tmp_path / "copy")
    with pytest.raises(Mismatch, match=words):
        record_series(lambda: small_culture(), SHORT, folder, sessions=2, interval_min=interval_min)
    assert sorted(folder.glob("*.nwb")) == [folder / file.name for file in undisturbed]


def test_an_interval_must_hold_a_recording(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"interval_min: expected at least the 0\.04 min"):
        record_series(lambda: small_culture(), SHORT, tmp_path, sessions=2, interval_min=0.01)
    with pytest.raises(InvalidArgument, match="sessions: expected at least 1"):
        record_series(lambda: small_culture(), SHORT, tmp_path, sessions=0)
    with pytest.raises(InvalidArgument, match="make_culture: expected a function that returns a culture, such as"):
        record_series(small_culture(), SHORT, tmp_path)  # type: ignore[arg-type]
    assert not list(tmp_path.glob("*.nwb"))
    # A single one has no next.
    check_interval(SHORT, 1, 0.01)
    check_interval(SHORT, 1, 2 * LONGEST_MIN)
    check_interval(SHORT, 2, minutes_of(SHORT))


def test_a_pulse_beyond_the_limits_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    strong = Pulse((Phase(200, amplitude_mv=-2000), Phase(200, amplitude_mv=2000)))
    with pytest.raises(UnsafeStimulus, match="amplitude: expected -400 to 400 mV, got -2000"):
        record(tmp_path / "recordings", protocol=replace(SHORT, pulse=strong))
    assert not (tmp_path / "recordings").exists()


def test_electrodes_that_do_not_stimulate_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    elsewhere = replace(SHORT, places=((0, 1), (99_999,)))
    with pytest.raises(InvalidArgument, match=r"places: expected .* the 16 that stimulate .*, got 0, 1, 99999$"):
        record(tmp_path / "recordings", protocol=elsewhere)
    assert not (tmp_path / "recordings").exists()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_killed_at_any_moment_it_goes_on_to_the_same_bits(undisturbed: list[Path], tmp_path: Path, seed: int) -> None:
    folder, rng, kills = tmp_path / "series", random.Random(seed), 0
    command = [sys.executable, "-B", "-c", PROGRAM, str(Path(__file__).parent), str(folder), "3"]
    for _ in range(40):
        process = subprocess.Popen(command, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"})
        try:
            # First before it can be done, then ever later, so that it comes to an end on a slow machine too.
            process.wait(rng.uniform(0.2, 0.5 + 0.3 * kills))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
            for file in folder.glob("[!.]*.nwb"):  # without the one that was being written
                read_recording(file)
            continue
        assert process.returncode == 0
        break
    assert kills >= 1
    assert same(sorted(folder.glob("*.nwb")), undisturbed)
    assert not list(folder.glob(".*"))


def test_the_file_for_those_who_watch_leaves_its_room_to_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    during, before, follow = [], [], PartialRecording.__call__

    def followed(partial: PartialRecording, so_far: Callable[[], Recording]) -> None:
        follow(partial, so_far)
        during.append((tmp_path / UNDER_WAY).exists())
        # Killed now, it would need no second scan.
        during.append((tmp_path / STATE_FILE).exists())

    def written(recording: Recording, file: Path) -> None:
        before.append(list(tmp_path.glob(f"*{UNDER_WAY}*")))
        write_nwb(recording, file)

    monkeypatch.setattr(PartialRecording, "__call__", followed)
    monkeypatch.setattr("animat.cultures.series.write_nwb", written)
    record(tmp_path, sessions=1)
    assert before == [[]] and during and all(during)


def test_one_folder_in_two_spellings_has_one_state(
    undisturbed: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(undisturbed[0].parent, tmp_path / "rec")
    monkeypatch.chdir(tmp_path)
    files = [Path("rec") / undisturbed[0].name, tmp_path / "rec" / undisturbed[1].name]
    recordings = read_recordings(files)
    state = culture_arguments("virtual", recordings, files)["state"]
    assert state.samefile(tmp_path / "rec" / STATE_FILE)
