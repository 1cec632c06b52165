"""Reads recordings in any known format, detected from the file's content, not its name."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, InvalidFile, as_invalid_file, expect_several, first_line, in_file
from animat.plain_file import expect_plain_file, is_absent, is_folder
from animat.recordings.columns import with_start
from animat.recordings.formats.csv import read_csv
from animat.recordings.formats.hdf5 import DAMAGE
from animat.recordings.formats.npz import UNDER_WAY, read_npz
from animat.recordings.formats.response_files import read_response_npz, read_response_table
from animat.recordings.formats.text_table import GZIP, read_table
from animat.recordings.hdf5_subprocess import read_hdf5_in_subprocess
from animat.recordings.placing import placed_by_date
from animat.recordings.recording import Recording, ResponseTable

S = TypeVar("S", Recording, Recording | ResponseTable)

HDF5 = b"\x89HDF\r\n\x1a\n"
ZIP = b"PK"
PICKLE = "a Python pickle, which is never read; save plain arrays with numpy.savez"
OTHERS = {
    **{bytes([0x80, protocol]): PICKLE for protocol in range(2, 6)},
    **dict.fromkeys((b"\xff\xfe", b"\xfe\xff"), "text in UTF-16; save it as CSV in UTF-8"),
    b"MATLAB": "a MATLAB file; save its columns as CSV or NPZ",
    b"\x93NUMPY": "NPY, which holds one array; save several by name with numpy.savez",
}
"""First bytes of files that are often mistaken for recordings, and what to do with them."""
HDF5_NAMES = (".nwb", ".h5", ".hdf5")
TEXT_NAMES = (".csv", ".csv.gz", ".tsv", ".txt")
IN_FOLDERS = ("*.nwb", "*.h5", "*.npz", "*_spikes.csv", "*_spikes.csv.gz", "*_responses.csv", "*_responses.csv.gz")
"""Files in a folder that are read as recordings."""


@checked_arguments
def read_recording(
    path: str | os.PathLike[str],
    *,
    stimuli_path: str | os.PathLike[str] | None = None,
    stimuli: str | None = None,
    part: str | None = None,
    start_min: float | None = None,
    start_s: float | None = None,
) -> Recording:
    """Read one recording: NWB, MaxWell, CL1 (HDF5), NPZ (zip) or CSV (text, gzipped or not), detected by its content.

    Problems noticed on the way are in its findings (see `animat.recordings.quality`).

    Args:
        path: of the recording; of a CSV recording, the file of its spikes.
        stimuli_path: the stimulus file, for CSV only; by default the one next to the spikes.
        stimuli: which of several candidates in a file are the stimuli: in NWB from other programs, the name; in
            MaxWell, the events' type.
        part: which recording of a MaxWell file with several, such as `well000/rec0000`.
        start_min: start on the culture's clock, in minutes; by default the one in the file.
        start_s: start on the recording's own clock, in seconds, for a file that does not state it.

    Raises:
        InvalidFile: naming the file, what was expected and what came.
        InvalidArgument: for a `stimuli_path` with a file that holds its own stimuli, a choice that the format does not
            offer, or a `start_min` or `start_s` that is not finite.
    """
    path = Path(path)
    for name, start, unit in (("start_min", start_min, "minutes"), ("start_s", start_s, "seconds")):
        if start is not None and not np.isfinite(start):
            raise InvalidArgument(f"{name}: expected finite {unit}, got {start:g}")
    source = read_source(path, stimuli_path=stimuli_path, stimuli=stimuli, part=part)
    if isinstance(source, ResponseTable):
        reads = "animat inspect, validate, train, evaluate and replay read, and in Python animat.read_source"
        raise InvalidFile(f"{path}: expected spikes, got a response table, which {reads}; this needs spike times")
    with in_file(path):
        source = source if start_s is None else with_start(source, start_s)
        return source if start_min is None else dataclasses.replace(source, start_min=float(start_min))


@checked_arguments
def read_source(
    path: str | os.PathLike[str],
    *,
    stimuli_path: str | os.PathLike[str] | None = None,
    stimuli: str | None = None,
    part: str | None = None,
) -> Recording | ResponseTable:
    """Read any source of responses: a recording, or a response table without spikes.

    `path`, `stimuli_path`, `stimuli` and `part` are as in `read_recording`, and so are the errors.
    """
    path = Path(path)
    begin = first_bytes(path)
    if begin.startswith((HDF5, ZIP)) and stimuli_path is not None:
        raise InvalidArgument(f"stimuli_path: expected only with CSV spikes, got {path}; put the stimuli into it")
    for name, value in (("stimuli", stimuli), ("part", part)):
        if value is not None and not begin.startswith(HDF5):
            beside = name == "stimuli" and not begin.startswith(ZIP)
            remedy = "; name the file of stimuli NAME_stimuli.csv and that of spikes NAME_spikes.csv" if beside else ""
            raise InvalidArgument(f"{name}: expected only for HDF5 files, got {value!r} for {path}{remedy}")
    try:
        # Errors in the data name the column but not the file.
        with in_file(path):
            if begin.startswith(HDF5):
                return read_hdf5_in_subprocess(path, part=part, stimuli=stimuli)
            if begin.startswith(ZIP):
                return read_response_npz(path) or read_npz(path)
            return _read_text(path, begin, stimuli_path)
    except (*DAMAGE, RecursionError, AssertionError) as error:
        # An unexpected error of a reader is also reported in one line.
        raise InvalidFile(f"{path}: expected a recording, but it cannot be read ({first_line(error)})") from error


def _read_text(path: Path, begin: bytes, stimuli_path: str | os.PathLike[str] | None) -> Recording | ResponseTable:
    # Text in UTF-16 is full of zeros, and a pickle need not have any.
    known = next((kind for magic, kind in OTHERS.items() if begin.startswith(magic)), None)
    is_binary = b"\0" in begin and not begin.startswith(GZIP)
    has_hdf5_name = path.suffix.lower() in HDF5_NAMES
    if (known or is_binary) and not has_hdf5_name:
        kind = known or "an unknown kind of file"
        raise InvalidFile(f"{path}: expected a recording (NWB, MaxWell, CL1, NPZ or CSV), got {kind}")
    try:
        table = read_table(path)
        return read_response_table(table) or read_csv(table, stimuli_path)
    except InvalidFile as error:
        if not has_hdf5_name or stimuli_path is not None:
            if path.name.lower().endswith(TEXT_NAMES):
                raise
            raise InvalidFile(f"{error} (it is read as CSV; recordings are also NWB, MaxWell, CL1 or NPZ)") from error
        what = "something else (perhaps text, or a server's error page); copy it again"
        raise InvalidFile(f"{path}: expected HDF5 in a file with this name, got {what}") from error


def read_recordings(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Recording]:
    """Read recordings from files and folders, in the order of the culture's clock.

    If some start at the same minute, as rigs' files state none, all are placed by their dates (`placed_by_date`).

    Args:
        paths: one or more files, or folders with `*.nwb`, `*.h5`, `*.npz`, `*_spikes.csv` or `*_spikes.csv.gz`.

    Raises:
        InvalidFile: for a file that cannot be read, a folder without recordings, or two recordings with the same start
            and no dates.
        InvalidArgument: if no path is given.
    """
    return _in_order(list_recordings(paths), read_recording)


def read_sources(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Recording | ResponseTable]:
    """Read recordings and response tables (in folders `*.npz` and `*_responses.csv[.gz]`) as `read_recordings` does."""
    return _in_order(list_recordings(paths), read_source)


def _in_order(files: list[Path], read_one: Callable[[Path], S]) -> list[S]:
    placed = placed_by_date([read_one(file) for file in files])
    read = sorted(zip(placed, files, strict=True), key=lambda pair: pair[0].start_min)
    for (earlier, file), (later, other) in pairwise(read):
        if file == other:
            raise InvalidFile(f"{file}: expected each recording once, got it twice")
        if earlier.start_min == later.start_min:
            raise InvalidFile(
                f"{other}: expected recordings with different starts, but this one and {file} both start at "
                f"{later.start_min:g} min; leave one out, or convert all with their starts (animat convert "
                "--start-min), or with their dates and no starts (--recorded-at)"
            )
    return [recording for recording, _ in read]


def list_recordings(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The recording files among paths: files as given, and those in folders in the order of their names."""
    listed = [paths] if isinstance(paths, str | os.PathLike) else paths
    listed = expect_several("recordings", listed, str | os.PathLike, "files or folders")
    files = [file for path in listed for file in _files(Path(path))]
    if not files:
        raise InvalidArgument("recordings: expected at least one file or folder of recordings, got none")
    return files


def _files(path: Path) -> list[Path]:
    if not is_folder(path):
        if is_absent(path):
            raise InvalidFile(f"{path}: no such file or folder of recordings; animat record makes them")
        return [expect_plain_file(path)]
    with as_invalid_file(path):
        # Hidden files are unfinished.
        listed = [file for file in path.iterdir() if not file.name.startswith(".")]
    files = sorted(file for file in listed if any(map(file.match, IN_FOLDERS)))
    if not files:
        keeps = f": animat recover {path} keeps what a killed run had recorded of a device"
        left = keeps if (path / UNDER_WAY).exists() else ""
        raise InvalidFile(f"{path}: expected a folder of recordings ({', '.join(IN_FOLDERS)}), found none in it{left}")
    return files


def first_bytes(path: Path) -> bytes:
    """A file's first bytes, which identify its format; raises InvalidFile if it is not a file, or empty."""
    if is_folder(path):
        raise InvalidFile(f"{path}: expected one recording, got a folder; read_recordings reads folders")
    with as_invalid_file(path), expect_plain_file(path).open("rb") as file:
        begin = file.read(4096)
    if not begin:
        raise InvalidFile(f"{path}: expected a recording, got an empty file")
    return begin
