"""HDF5 files are read in a separate process. Oracles: reading in this process, and killed processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from animat.errors import InvalidArgument, InvalidFile
from animat.recordings import hdf5_subprocess
from animat.recordings.formats.hdf5_formats import read_hdf5
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from synthetic_recordings import synthetic_recording


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("apart") / "a.nwb"
    write_nwb(synthetic_recording(5, patterns=4, channels=16, start_min=20.0), file)
    return file


def test_the_recording_equals_the_one_read_in_this_process(path: Path) -> None:
    assert hdf5_subprocess.read_hdf5_in_subprocess(path).equals(read_hdf5(path))
    assert not hdf5_subprocess.read_hdf5_in_subprocess(path).spike_times_s.flags.writeable


def test_a_path_is_relative_to_the_current_folder(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = read_recording(path)
    monkeypatch.chdir(path.parent)
    assert read_recording("a.nwb").equals(before)


def test_errors_are_passed_on_unchanged(path: Path) -> None:
    with pytest.raises(InvalidArgument, match="part: expected only for MaxWell files"):
        hdf5_subprocess.read_hdf5_in_subprocess(path, part="well000")
    path.with_name("b.nwb").write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InvalidFile, match=r"b\.nwb: expected a complete HDF5 recording, but it is cut off"):
        hdf5_subprocess.read_hdf5_in_subprocess(path.with_name("b.nwb"))


def fail(*_: object) -> None:
    raise SystemError("of the library")


def test_any_error_in_reading_names_the_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5_subprocess, "_read", fail)
    with pytest.raises(
        InvalidFile, match=r"a\.nwb: expected a recording, but it cannot be read \(SystemError: of the library\)"
    ):
        hdf5_subprocess.read_hdf5_in_subprocess(path)


@pytest.mark.oracle
def test_a_dead_process_is_replaced(path: Path) -> None:
    before = read_recording(path)
    assert hdf5_subprocess._reader is not None
    process = hdf5_subprocess._reader._popen
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert read_recording(path).equals(before)


def test_a_file_that_crashes_the_library_is_reported_as_damaged(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_recording(path)
    assert hdf5_subprocess._reader is not None
    process = hdf5_subprocess._reader._popen
    os.kill(process.pid, signal.SIGSTOP)
    monkeypatch.setattr(hdf5_subprocess, "WAIT_S", 0.2)
    with pytest.raises(InvalidFile, match=r"a\.nwb: .*the HDF5 library crashed on it, or took more time or memory"):
        read_recording(path)
    assert process.poll() is not None
    monkeypatch.undo()
    assert len(read_recording(path).channels) == 16


def test_memory_and_processor_time_are_limited(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_recording(path)
    assert hdf5_subprocess._reader is not None
    process = hdf5_subprocess._reader._popen
    limits = {line[:25].strip(): line.split() for line in Path(f"/proc/{process.pid}/limits").read_text().splitlines()}
    assert int(limits["Max address space"][3]) < 4 * 2**30
    assert int(limits["Max cpu time"][3]) < 60
