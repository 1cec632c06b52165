"""Read recordings in any known format; the format is known by a file's content, not by its name."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.plain_file import expect_plain_file, is_absent, is_folder
from animat.recordings.apart import read_hdf5_apart
from animat.recordings.columns import started_at
from animat.recordings.formats.csv import read_csv
from animat.recordings.formats.hdf5 import DAMAGE, first_line
from animat.recordings.formats.npz import read_npz
from animat.recordings.formats.responses_plain import (
    is_response_csv,
    is_response_npz,
    read_response_csv,
    read_response_npz,
)
from animat.recordings.recording import Recording
from animat.recordings.response_table import ResponseTable

S = TypeVar("S", Recording, Recording | ResponseTable)

HDF5 = b"\x89HDF\r\n\x1a\n"
ZIP = b"PK"
NPY = b"\x93NUMPY"
PICKLE = "a Python pickle, which is never read; save plain arrays with numpy.savez"
OTHERS = {
    **{bytes([0x80, protocol]): PICKLE for protocol in range(2, 6)},
    b"\xff\xfe": "text in UTF-16; save it as CSV in UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as CSV in UTF-8",
    b"MATLAB": "a MATLAB file; save its columns as CSV or NPZ",
}
"""How files begin that are often given for recordings and are none, and what to do with them."""
HDF5_NAMES = (".nwb", ".h5", ".hdf5")
TEXT_NAMES = (".csv", ".csv.gz", ".tsv", ".txt")
IN_FOLDERS = ("*.nwb", "*.h5", "*.npz", "*_spikes.csv", "*_spikes.csv.gz", "*_responses.csv", "*_responses.csv.gz")
"""Names that are taken from a folder for recordings."""


def read_recording(
    path: str | os.PathLike[str],
    *,
    stimuli_path: str | os.PathLike[str] | None = None,
    stimuli: str | None = None,
    part: str | None = None,
    start_min: float | None = None,
    start_s: float | None = None,
) -> Recording:
    """Read one recording: NWB, MaxWell, CL1 (HDF5), NPZ (zip) or CSV (text, gzipped or not), known by its content.

    Args:
        stimuli_path: the file of stimuli, for CSV only; by default the one beside the spikes.
        stimuli: which of several things in a file are the stimuli: NWB of other programs, the name; MaxWell, the
            events' type.
        part: which recording of a MaxWell file that holds several, such as `well000/rec0000`.
        start_min: when the recording started on the culture's clock, in minutes; by default what the file says.
        start_s: when it started on the clock of its own times, in seconds, for a file that does not say so.

    Returns:
        The recording, sorted and checked; what was noticed on the way is in its provenance (see
        `animat.recordings.noticed`).

    Raises:
        InvalidFile: naming the file, what was expected and what came.
        InvalidArgument: for a `stimuli_path` beside a file that holds its own stimuli, a choice that the format does
            not offer, or a `start_min` or `start_s` not finite.
    """
    path = Path(path)
    if start_min is not None and not np.isfinite(start_min):
        raise InvalidArgument(f"start_min: expected finite minutes, got {start_min:g}")
    if start_s is not None and not np.isfinite(start_s):
        raise InvalidArgument(f"start_s: expected finite seconds, got {start_s:g}")
    source = _read(path, stimuli_path, stimuli, part)
    if isinstance(source, ResponseTable):
        raise InvalidFile(
            f"{path}: expected spikes, got a table of responses, which animat inspect, train and evaluate read; "
            "this needs the times of spikes"
        )
    if start_s is not None:
        try:
            source = started_at(source, start_s)
        except UnusableData as error:
            raise InvalidFile(f"{path}: {error}") from error
    return source if start_min is None else dataclasses.replace(source, start_min=float(start_min))


def read_source(
    path: str | os.PathLike[str], *, stimuli: str | None = None, part: str | None = None
) -> Recording | ResponseTable:
    """Read what responses can be had from: a recording, or a table of responses without spikes.

    Args:
        stimuli, part: as in `read_recording`.

    Raises:
        InvalidFile, InvalidArgument: as in `read_recording`.
    """
    return _read(Path(path), None, stimuli, part)


def _read(
    path: Path, stimuli_path: str | os.PathLike[str] | None, stimuli: str | None, part: str | None
) -> Recording | ResponseTable:
    magic = first_bytes(path)
    if magic.startswith((HDF5, ZIP)) and stimuli_path is not None:
        raise InvalidArgument(
            f"stimuli_path: expected only beside CSV spikes, got {stimuli_path}, but {path} holds its own stimuli"
        )
    if (stimuli is not None or part is not None) and not magic.startswith(HDF5):
        raise InvalidArgument(f"stimuli, part: expected only for HDF5 files, got {stimuli or part!r} for {path}")
    try:
        if magic.startswith(HDF5):
            return read_hdf5_apart(path, part=part, stimuli=stimuli)
        if read_table := _response_reader(path, magic):
            return read_table(path)
        if magic.startswith(ZIP):
            return read_npz(path)
        if magic.startswith(NPY):
            raise InvalidFile(f"{path}: expected NPZ (several arrays by name), got NPY (one array)")
        if kind := _other_kind(path, magic):
            raise InvalidFile(f"{path}: expected a recording (NWB, MaxWell, CL1, NPZ or CSV), got {kind}")
        return _read_text(path, stimuli_path)
    except (UnusableData, InvalidArgument) as error:
        # These name the column at fault but not the file.
        raise InvalidFile(f"{path}: {error}") from error
    except (*DAMAGE, RecursionError, AssertionError) as error:
        # What no reader foresaw: still a file that cannot be read, and one line.
        raise InvalidFile(f"{path}: expected a recording, but it cannot be read ({first_line(error)})") from error


def _response_reader(path: Path, magic: bytes) -> Callable[[Path], ResponseTable] | None:
    """What reads a table of responses; None for any other file."""
    if magic.startswith(ZIP):
        return read_response_npz if is_response_npz(path) else None
    is_text = not magic.startswith((HDF5, NPY)) and not _other_kind(path, magic)
    if not is_text or path.suffix.lower() in HDF5_NAMES:
        return None
    try:
        return read_response_csv if is_response_csv(path) else None
    except InvalidFile:
        # Whoever reads it in full says better what is wrong with it.
        return None


def _read_text(path: Path, stimuli_path: str | os.PathLike[str] | None) -> Recording:
    try:
        return read_csv(path, stimuli_path=stimuli_path)
    except InvalidFile as error:
        if path.suffix.lower() not in HDF5_NAMES or stimuli_path is not None:
            raise
        raise InvalidFile(
            f"{path}: expected HDF5 in a file of this name, got something else (text, perhaps, or the answer of a "
            "server in its place); copy it again"
        ) from error


def read_recordings(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Recording]:
    """Read recordings from files and folders, in the order of the culture's clock.

    Args:
        paths: files, or folders that hold `*.nwb`, `*.h5`, `*.npz`, `*_spikes.csv` or `*_spikes.csv.gz`; one or more.

    Returns:
        The recordings, sorted by `start_min`.

    Raises:
        InvalidFile: for a file that cannot be read, a folder without recordings, or two recordings of one time.
        InvalidArgument: if no path is given.
    """
    return _in_order(list_recordings(paths), read_recording)


def read_sources(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Recording | ResponseTable]:
    """Read recordings, and tables of responses without spikes, in the order of the culture's clock.

    Args and errors are those of `read_recordings`; tables in folders are `*.npz`, `*_responses.csv` and
    `*_responses.csv.gz`.
    """
    return _in_order(list_recordings(paths), read_source)


def _in_order(files: list[Path], read_one: Callable[[Path], S]) -> list[S]:
    read = sorted(((read_one(file), file) for file in files), key=lambda pair: pair[0].start_min)
    for (earlier, file), (later, other) in pairwise(read):
        if earlier.start_min == later.start_min:
            raise InvalidFile(
                f"{other}: expected recordings of different times, but this one and {file} both start at "
                f"{later.start_min:g} min; leave one out, or give it another time (animat convert --start-min)"
            )
    return [recording for recording, _ in read]


def list_recordings(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The files of recordings among paths: files themselves, and the recordings in folders, in the order of names.

    Raises:
        InvalidFile: for a folder without recordings.
        InvalidArgument: if no path is given.
    """
    given = [paths] if isinstance(paths, str | os.PathLike) else paths
    files = [file for path in given for file in _files(Path(path))]
    if not files:
        raise InvalidArgument("paths: expected at least one file or folder of recordings, got none")
    return files


def _files(path: Path) -> list[Path]:
    if not is_folder(path):
        if is_absent(path):
            raise InvalidFile(f"{path}: no such file or folder of recordings; animat record makes them")
        return [expect_plain_file(path)]
    try:
        # A folder that cannot be read looks empty to glob.
        next(path.iterdir(), None)
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read: {error.strerror or error}") from error
    # Hidden files are unfinished ones.
    found = sorted({f for pattern in IN_FOLDERS for f in path.glob(pattern) if not f.name.startswith(".")})
    if not found:
        raise InvalidFile(f"{path}: expected a folder of recordings ({', '.join(IN_FOLDERS)}), found none in it")
    return found


def _other_kind(path: Path, magic: bytes) -> str | None:
    """What a file is that is no text, neither gzipped nor under a name of HDF5, which has an error of its own."""
    if path.suffix.lower() in HDF5_NAMES or magic.startswith(b"\x1f\x8b"):
        return None
    with path.open("rb") as file:
        is_binary = b"\0" in file.read(4096)
    # Text in UTF-16 is full of zeros, and a pickle need not have any.
    known = next((kind for begin, kind in OTHERS.items() if magic.startswith(begin)), None)
    return known or ("a file of another kind" if is_binary else None)


def first_bytes(path: Path) -> bytes:
    """How a file begins, which tells its kind; raises InvalidFile for what is no file, or empty."""
    if is_folder(path):
        raise InvalidFile(f"{path}: expected one recording, got a folder; read_recordings reads folders")
    try:
        with expect_plain_file(path).open("rb") as file:
            magic = file.read(len(HDF5))
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read: {error.strerror or error}") from error
    if not magic:
        raise InvalidFile(f"{path}: expected a recording (NWB, NPZ or CSV), got an empty file")
    return magic
