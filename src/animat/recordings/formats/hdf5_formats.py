"""Detects the format of an HDF5 file by its layout, and reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from animat.errors import InvalidArgument, InvalidFile, some_of
from animat.recordings.formats.cl1 import is_cl1, read_cl1
from animat.recordings.formats.hdf5 import Hdf5File, hdf5_file
from animat.recordings.formats.maxwell import is_maxwell, read_maxwell
from animat.recordings.formats.nwb import is_nwb, read_nwb
from animat.recordings.recording import Recording


def format_of(file: Hdf5File) -> Literal["NWB", "MaxWell", "CL1"]:
    """The format of an open file; refuses an unknown one."""
    if is_nwb(file):
        return "NWB"
    if is_maxwell(file):
        return "MaxWell"
    if is_cl1(file):
        return "CL1"
    raise InvalidFile(
        f"{file.path}: expected NWB, MaxWell or CL1, got another HDF5 file (it holds: "
        f"{some_of(file.names('/'), 5) or 'nothing'}); save its columns as NPZ or CSV"
    )


def read_hdf5(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """Read a recording in any of the formats; `part`, `stimuli` and errors are those of `read_recording`."""
    with hdf5_file(path) as file:
        kind = format_of(file)
        if part is not None and kind != "MaxWell":
            raise InvalidArgument(f"part: expected only for MaxWell files, got {part!r} for one of {kind}")
        if stimuli is not None and kind == "CL1":
            raise InvalidArgument(f"stimuli: expected only for NWB and MaxWell files, got {stimuli!r} for a CL1 file")
        if kind == "NWB":
            return read_nwb(file, stimuli)
        return read_maxwell(file, part, stimuli) if kind == "MaxWell" else read_cl1(file)
