"""Commands that stimulate or record hold their folder from before a culture is opened until they end."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import Any

import pytest

from animat.cli import main
from animat.errors import DeviceFailed, Mismatch
from animat.live.plan import Timetable
from animat.live.shadowing import live
from animat.recordings.formats.nwb import write_nwb
from animat.writing import LOCK, exclusive_lock
from fake_culture import FakeCulture
from synthetic_recordings import synthetic_recording
from test_live import ONE, PROTOCOL
from test_run_on_recordings import policy_of

pytestmark = pytest.mark.usefixtures("few_bootstraps")

OPENING = ["record cl1", "record replay", "run", "live"]


def command(name: str, folder: Path) -> list[str]:
    """A command that opens a culture for the folder `out`."""
    policy_of(0).save(folder / "p0.safetensors")
    synthetic = folder / "synthetic.nwb"
    if name in ("record replay", "run"):
        write_nwb(synthetic_recording(1, patterns=40, channels=32), synthetic)
    return {
        "record cl1": ["record", "--culture", "cl1"],
        "record replay": ["record", "--culture", "replay", "--recordings", str(synthetic)],
        "run": ["run", str(folder / "p0.safetensors"), "--recordings", str(synthetic)],
        "live": ["live", "navigation"],
    }[name] + ["--out", str(folder / "in" / "out")]


@pytest.mark.parametrize("name", OPENING)
def test_a_second_run_is_refused_before_a_culture_is_opened(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("animat.cultures.kinds.culture_named", lambda *_, **__: pytest.fail("a culture was made"))
    with exclusive_lock(tmp_path / "in" / "out"):
        assert main(command(name, tmp_path)) == 1
        assert "out: another run is at work in this folder; wait for it, or stop it" in capsys.readouterr().err
        assert not list((tmp_path / "in" / "out").iterdir())


@pytest.mark.parametrize("name", OPENING)
def test_the_folder_is_held_while_a_culture_is_opened_and_taken_away_if_that_fails(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        with pytest.raises(Mismatch, match="another run is at work"), exclusive_lock(tmp_path / "in" / "out"):
            pass
        raise DeviceFailed("the device: it is off")

    monkeypatch.setattr("animat.cultures.kinds.culture_named", failing)
    assert main(command(name, tmp_path)) == 1
    assert "the device: it is off" in capsys.readouterr().err
    assert not (tmp_path / "in").exists()


@pytest.mark.oracle
def test_a_session_that_still_runs_is_not_recovered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command("run", tmp_path), "--culture", "replay", "--episodes", "1"]) == 0
    session = tmp_path / "in" / "out"
    before = (session / "session.nwb").stat().st_mtime_ns
    with exclusive_lock(session):
        assert main(["recover", str(session)]) == 1
    assert "another run is at work" in capsys.readouterr().err
    assert (session / "session.nwb").stat().st_mtime_ns == before
    assert main(["recover", str(session)]) == 0
    assert "session.nwb and ticks.csv: " in capsys.readouterr().out


@pytest.mark.oracle
def test_a_live_run_takes_a_folder_in_which_only_a_file_to_be_locked_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flock = fcntl.flock

    def files_only(descriptor: int, how: int) -> None:
        if Path(f"/proc/self/fd/{descriptor}").resolve().is_dir():
            raise OSError(9, "Bad file descriptor")
        flock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", files_only)
    with exclusive_lock(tmp_path / "live"), FakeCulture() as culture:
        assert (tmp_path / "live" / LOCK).exists()
        found = live(ONE, culture, PROTOCOL, tmp_path / "live", timetable=Timetable(10, 10, 1e6), episodes=1)
    assert len(found.recordings) == 1
