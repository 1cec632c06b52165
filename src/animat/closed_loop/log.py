"""The log of a session: an append-only file that is intact up to its last record, however the program ended.

    8 bytes        b"ANIMATL1"
    records        b"REC1", length of the fields, number of spikes, CRC-32 of the rest (three little-endian uint32),
                   the fields (JSON in UTF-8), the spikes' times (float64, s) and their channels (int32)

The first record describes the session. A record that is cut off or damaged ends the file: the records before it are
read, and the lost bytes are counted.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidFile, as_invalid_file
from animat.plain_file import expect_plain_file
from animat.recordings.formats.nwb_spikes import SpikeBlock
from animat.writing import sync_folder, take_lock

MAGIC = b"ANIMATL1"
RECORD = b"REC1"
"""The beginning of a record."""
HEAD = struct.Struct("<4sIII")
"""The head of each record: `RECORD`, the length of the fields, the number of spikes, the checksum of both."""
_BUFFER_BYTES = 2**18
_BLOCK_SPIKES = 2**20
"""Spikes that are read at once, some more by the last record of a block."""
_NO_TIMES, _NO_CHANNELS = np.empty(0, np.float64), np.empty(0, np.int64)


class LogRecord(NamedTuple):
    """One record: its fields and its spikes."""

    fields: dict[str, Any]
    spike_times_s: Float64[np.ndarray, " spikes"] = _NO_TIMES
    spike_channels: Int64[np.ndarray, " spikes"] = _NO_CHANNELS


class LogWriter:
    """Appends records to a new file; the operating system has each when `append` returns: a kill loses none.

    Raises InvalidFile if the file exists, or cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        self._path, self._header = path, dict(header)
        self._places, self._whole = array("Q"), 0
        with as_invalid_file(path, "cannot be written"), ExitStack() as stack:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_WRONLY, 0o666)
            # A file without its first record is not a log, and would prevent the next session.
            stack.callback(path.unlink, missing_ok=True)
            stack.callback(self.close)
            # Nobody recovers the session while it is running.
            take_lock(path.parent, self._file)
            self._write(MAGIC)
            self.append(LogRecord(self._header))
            self.sync()
            sync_folder(path.parent)
            stack.pop_all()

    def append(self, record: LogRecord) -> None:
        """Write a record; if that raises OSError, the file ends with the record before it."""
        fields = json.dumps(record.fields).encode()
        spikes = record.spike_times_s.astype("<f8").tobytes() + record.spike_channels.astype("<i4").tobytes()
        body = fields + spikes
        self._write(HEAD.pack(RECORD, len(fields), len(record.spike_times_s), zlib.crc32(body)) + body)
        self._places.append(self._whole)

    def written(self) -> Log:
        """The log as written so far, for reading."""
        return Log(self._path, self._header, self._places, 0)

    def sync(self) -> None:
        """Flush the file to disk, against a power cut; raises OSError too if it was removed, which no write would."""
        os.fsync(self._file)
        # On some file systems the number of links is always 0.
        if os.fstat(self._file).st_nlink == 0 and not self._path.exists():
            raise FileNotFoundError(errno.ENOENT, "it was removed")

    def close(self) -> None:
        os.close(self._file)

    def _write(self, data: bytes) -> None:
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except OSError:
            # Remove the part that was written, which would read as a torn record; truncating needs no space.
            os.ftruncate(self._file, self._whole)
            raise
        self._whole += len(data)


@dataclass(frozen=True, eq=False)
class Log:
    """A log's records after the first, read from its file on demand: it may be larger than memory.

    Attributes:
        header: the fields of the first record.
        places: offsets in the file where each record begins, and where the last one ends.
        lost_bytes: from the first damaged record on.
    """

    path: Path
    header: dict[str, Any]
    places: array[int]
    lost_bytes: int

    def __len__(self) -> int:
        return len(self.places) - 1

    def __getitem__(self, index: int) -> LogRecord:
        number = range(len(self))[index]
        with open_file(self.path) as file:
            file.seek(self.places[number])
            return parse_record(self.path, file.read(self.places[number + 1] - self.places[number]))

    def __iter__(self) -> Iterator[LogRecord]:
        return (parse_record(self.path, data) for data in self._data())

    def fields(self) -> Iterator[dict[str, Any]]:
        """The fields of each record, without the spikes."""
        return (parse_fields(self.path, data) for data in self._data())

    def spike_blocks(self) -> Iterator[SpikeBlock]:
        """All spikes in the order they were written: times in s and channels, about a million at a time."""
        block: list[SpikeBlock] = []
        n_spikes = 0
        for times_s, channels in map(_spikes, self._data()):
            if len(times_s):
                block.append((times_s, channels))
                n_spikes += len(times_s)
            if n_spikes >= _BLOCK_SPIKES:
                yield _joined(block)
                block, n_spikes = [], 0
        if block:
            yield _joined(block)

    def _data(self) -> Iterator[bytes]:
        with open_file(self.path) as file:
            file.seek(self.places[0])
            for place, end in itertools.pairwise(self.places):
                yield file.read(end - place)


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a log, even if its program was killed: every checksum is checked now, and the contents are read later.

    Raises InvalidFile if it is missing, not a log, or has no intact first record.
    """
    path = expect_plain_file(path)
    with open_file(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidFile(f"{path}: expected the log of a closed-loop session, got something else")
        places, n_bytes = array("Q", [len(MAGIC)]), os.fstat(file.fileno()).st_size
        while (end := end_of_intact(file, places[-1], n_bytes)) is not None:
            places.append(end)
        if len(places) < 2:
            raise InvalidFile(f"{path}: expected the log of a closed-loop session, got one cut off in its first record")
        file.seek(places[0])
        header = parse_fields(path, file.read(places[1] - places[0]))
    return Log(path, header, places[1:], n_bytes - places[-1])


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a log, or a table beside it, for reading; raises InvalidFile if it cannot be read."""
    with as_invalid_file(path), path.open("rb", buffering=_BUFFER_BYTES) as file:
        yield file


def end_of_intact(file: BinaryIO, at: int, n_bytes: int) -> int | None:
    """Where the record at the file's position `at` ends; None if it is not intact."""
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    mark, n_fields, n_spikes, checksum = HEAD.unpack(head)
    length = n_fields + 12 * n_spikes
    end = at + HEAD.size + length
    # The end is checked before reading: a damaged length must not cause gigabytes to be read.
    if mark != RECORD or end > n_bytes or zlib.crc32(file.read(length)) != checksum:
        return None
    return int(end)


def parse_record(path: Path, data: bytes) -> LogRecord:
    """A record from its bytes, which are intact; raises InvalidFile, naming `path`, if its fields are not JSON."""
    return LogRecord(parse_fields(path, data), *_spikes(data))


def _spikes(data: bytes) -> SpikeBlock:
    """The times and channels of a record's spikes."""
    _, n_fields, n_spikes, _ = HEAD.unpack_from(data)
    at = HEAD.size + n_fields
    channels = np.frombuffer(data, "<i4", n_spikes, at + 8 * n_spikes)
    return np.frombuffer(data, "<f8", n_spikes, at).astype(np.float64), channels.astype(np.int64)


def _joined(block: Sequence[SpikeBlock]) -> SpikeBlock:
    times_s, channels = zip(*block, strict=True)
    return np.concatenate(times_s), np.concatenate(channels)


def parse_fields(path: Path, data: bytes) -> dict[str, Any]:
    """The fields of a record, without its spikes; arguments and errors are those of `parse_record`."""
    _, n_fields, _, _ = HEAD.unpack_from(data)
    try:
        fields = json.loads(data[HEAD.size : HEAD.size + n_fields])
    except (ValueError, RecursionError) as error:
        raise InvalidFile(f"{path}: expected JSON in every record, got {error}") from error
    if not isinstance(fields, dict):
        raise InvalidFile(f"{path}: expected names and values in every record, got {type(fields).__name__}")
    return _with_current_names(fields)


_CURRENT = {"contenders": "agents", "sentence": "message", "contender": "agent"}
_CURRENT |= {"lead_in": "warm_up", "following": "adaptive"}
"""Names in older logs, and the current ones."""


def _with_current_names(fields: dict[str, Any]) -> dict[str, Any]:
    """A record's fields with the names of older logs replaced, also in its loop and its tick."""
    fields = {_CURRENT.get(name, name): value for name, value in fields.items()}
    for part in fields.keys() & {"loop", "tick"}:
        if isinstance(fields[part], dict):
            fields[part] = {_CURRENT.get(name, name): value for name, value in fields[part].items()}
    tick = fields.get("tick")
    if isinstance(tick, dict) and tick.get("handled") == "lead-in":
        tick["handled"] = "warm-up"
    return fields
