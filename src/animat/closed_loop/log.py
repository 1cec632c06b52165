"""The log of a session: an append-only file that is whole up to its last record, whatever ended the program.

    8 bytes        b"ANIMATL1"
    records        b"REC1", length of the words, number of spikes, CRC-32 of the rest (three little-endian uint32),
                   the words (JSON in UTF-8), the spikes' times (float64, s) and their channels (int32)

The first record describes the session. A record that is cut off or damaged ends the file: what comes before it is
read and what is lost is counted.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument, InvalidFile
from animat.writing import keep_name

MAGIC = b"ANIMATL1"
_RECORD = b"REC1"
_HEAD = struct.Struct("<4sIII")
_NO_TIMES, _NO_CHANNELS = np.empty(0, np.float64), np.empty(0, np.int64)


class Record(NamedTuple):
    """One record: words, and the spikes that go with them."""

    words: dict[str, Any]
    spike_times_s: Float64[np.ndarray, " spikes"] = _NO_TIMES
    spike_channels: Int64[np.ndarray, " spikes"] = _NO_CHANNELS


class LogWriter:
    """Appends records; each is with the operating system when `append` returns, so a killed program loses none.

    Args:
        path: a new file.
        header: words of the first record.

    Raises:
        InvalidArgument: if the file is there already.
        InvalidFile: if it cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_WRONLY, 0o666)
        except FileExistsError:
            raise InvalidArgument(f"{path}: a session is there already; choose another folder") from None
        except OSError as error:
            raise InvalidFile(f"{path}: cannot be written: {error.strerror or error}") from error
        self._whole = 0
        try:
            self._write(MAGIC)
            self.append(Record(dict(header)))
            self.sync()
            keep_name(path.parent)
        except OSError as error:
            self.close()
            raise InvalidFile(f"{path}: cannot be written: {error.strerror or error}") from error

    def append(self, record: Record) -> None:
        """Write a record.

        Raises:
            OSError: if it cannot be written; the file then ends with the record before it.
        """
        words = json.dumps(record.words).encode()
        spikes = record.spike_times_s.astype("<f8").tobytes() + record.spike_channels.astype("<i4").tobytes()
        body = words + spikes
        self._write(_HEAD.pack(_RECORD, len(words), len(record.spike_times_s), zlib.crc32(body)) + body)

    def sync(self) -> None:
        """Have what was written put on the disk itself, against a power cut."""
        os.fsync(self._file)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except OSError:
            # What was written of it would make a reader count a torn record; giving room back always works.
            os.ftruncate(self._file, self._whole)
            raise
        self._whole += len(data)


@dataclass(frozen=True, eq=False)
class Log:
    """What a log file holds.

    Attributes:
        header: the words of its first record.
        records: the others, in the order they were written.
        lost_bytes: at the end, that make no whole record.
    """

    header: dict[str, Any]
    records: tuple[Record, ...]
    lost_bytes: int


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a log, also one whose program was killed.

    Raises:
        InvalidFile: if it is missing, something else, or has no whole first record.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read: {error.strerror or error}") from error
    if not data.startswith(MAGIC):
        raise InvalidFile(f"{path}: expected the log of a closed-loop session, got something else")
    at, records = len(MAGIC), []
    while (record := _read_record(data, at)) is not None:
        at, found = record
        records.append(found)
    if not records:
        raise InvalidFile(f"{path}: expected the log of a closed-loop session, got one that ends in its first record")
    return Log(records[0].words, tuple(records[1:]), len(data) - at)


def _read_record(data: bytes, at: int) -> tuple[int, Record] | None:
    """The record at a place and the place after it; None where there is no whole one."""
    start = at + _HEAD.size
    if start > len(data):
        return None
    mark, n_words, n_spikes, checksum = _HEAD.unpack_from(data, at)
    end = start + n_words + 12 * n_spikes
    if mark != _RECORD or end > len(data) or zlib.crc32(memoryview(data)[start:end]) != checksum:
        return None
    times_at = start + n_words
    times_s = np.frombuffer(data, "<f8", n_spikes, times_at).astype(np.float64)
    channels = np.frombuffer(data, "<i4", n_spikes, times_at + 8 * n_spikes).astype(np.int64)
    return end, Record(json.loads(data[start:times_at]), times_s, channels)
