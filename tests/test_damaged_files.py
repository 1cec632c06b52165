"""Damaged and hostile files: read, or refused in one line. Oracle: the operating system's limits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from animat.errors import InvalidFile
from animat.recordings import hdf5_subprocess
from animat.recordings.formats.hdf5_formats import read_hdf5
from animat.recordings.formats.nwb import write_nwb
from damaging import KINDS
from synthetic_recordings import synthetic_recording


def damage(kind: str, seed: int, count: int, folder: Path) -> None:
    """Damage and read `count` files in a separate process."""
    done = subprocess.run(
        [
            sys.executable,
            "-W",
            "ignore",
            str(Path(__file__).parent / "damaging.py"),
            kind,
            str(seed),
            str(count),
            folder,
        ],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parent)},
    )
    last = folder / "last"
    where = last.read_text() if last.exists() else "before the first file"
    assert done.returncode == 0, f"{where}: status {done.returncode}\n{done.stdout}{done.stderr[-3000:]}"
    print(done.stdout)


# One library reads those of HDF5, in another process, whose crashes have tests of their own (`test_hdf5_subprocess`).
HDF5 = ("nwb", "other-nwb", "maxwell", "old-maxwell", "cl1")


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.oracle] * (k in HDF5)) for k in KINDS])
def test_a_hundred_damaged_files_are_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    damage(kind, 1, 100, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_two_thousand_damaged_files_are_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    damage(kind, 2, 2000, tmp_path)


@pytest.mark.parametrize("where", ["processing", "processing/ecephys/animat_recording", "units/spike_times"])
def test_a_damaged_part_is_not_reported_as_missing(where: str, tmp_path: Path) -> None:
    path = tmp_path / "recording.nwb"
    write_nwb(synthetic_recording(0, patterns=1, channels=20), path)
    with h5py.File(path) as file:
        begins = h5py.h5o.get_info(file[where].id).addr
    with path.open("r+b") as file:
        file.seek(begins)
        file.write(b"\xff" * 8)
    with pytest.raises(InvalidFile, match=r"recording\.nwb: expected a complete HDF5 recording, but it is .*damaged"):
        read_hdf5(path)


@pytest.mark.oracle
def test_a_reader_that_is_not_ready_in_time_does_not_blame_the_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5_subprocess, "START_S", 0.0)
    with pytest.raises(InvalidFile, match=r"not ready after 0 s, is the machine busy\?"):
        hdf5_subprocess._start()
