"""The log of a session: an append-only file that is whole up to its last record, whatever ended the program.

    8 bytes        b"ANIMATL1"
    records        b"REC1", length of the words, number of spikes, CRC-32 of the rest (three little-endian uint32),
                   the words (JSON in UTF-8), the spikes' times (float64, s) and their channels (int32)

The first record describes the session. A record that is cut off or damaged ends the file: what comes before it is
read and what is lost is counted.
"""

from __future__ import annotations

import itertools
import json
import os
import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float64, Int, Int64

from animat.errors import InvalidArgument, InvalidFile
from animat.plain_file import expect_plain_file
from animat.writing import sync_folder

MAGIC = b"ANIMATL1"
RECORD = b"REC1"
"""What a record begins with."""
HEAD = struct.Struct("<4sIII")
"""Before each record: that, the length of the words, the number of spikes, the checksum of both."""
_BUFFER_BYTES = 2**18
_BLOCK_BYTES = 2**23
"""Of the log, that spikes are read from in one go."""
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
        self._header, self._places = dict(header), array("Q")
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
            self.append(Record(self._header))
            self.sync()
            sync_folder(path.parent)
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
        self._write(HEAD.pack(RECORD, len(words), len(record.spike_times_s), zlib.crc32(body)) + body)
        self._places.append(self._whole)

    def written(self) -> Log:
        """What was written up to now, to be read."""
        return Log(self._header, Records(self.path, self._places), 0)

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


class Records:
    """The records of a log but the first, read from its file as they are asked for: memory may be smaller than it.

    Args:
        path: of the log.
        places: in the file, where each record begins, and where the last one ends.
    """

    def __init__(self, path: Path, places: array[int]) -> None:
        self._path, self._places = path, places

    def __len__(self) -> int:
        return len(self._places) - 1

    def __getitem__(self, index: int) -> Record:
        number = range(len(self))[index]
        with opened_log(self._path) as file:
            file.seek(self._places[number])
            return record_of(self._path, file.read(self._places[number + 1] - self._places[number]))

    def __iter__(self) -> Iterator[Record]:
        return (record_of(self._path, data) for data in self._data())

    def words(self) -> Iterator[dict[str, Any]]:
        """The words of each record, without the spikes."""
        return (words_of(self._path, data) for data in self._data())

    def spike_blocks(self) -> Iterator[tuple[Float64[np.ndarray, " spikes"], Int[np.ndarray, " spikes"]]]:
        """All spikes, their times in s and their channels, some million at a time, in the order they were written."""
        places = np.frombuffer(self._places, np.uint64).astype(np.int64)
        with opened_log(self._path) as file:
            first = 0
            while first < len(self):
                last = max(first + 1, int(np.searchsorted(places, places[first] + _BLOCK_BYTES)) - 1)
                file.seek(places[first])
                data = memoryview(file.read(places[last] - places[first]))
                times, channels = [], []
                for at in (places[first:last] - places[first]).tolist():
                    _, n_words, n_spikes, _ = HEAD.unpack_from(data, at)
                    if n_spikes:
                        at += HEAD.size + n_words
                        times.append(data[at : at + 8 * n_spikes])
                        channels.append(data[at + 8 * n_spikes : at + 12 * n_spikes])
                first = last
                if times:
                    times_s = np.frombuffer(b"".join(times), "<f8").astype(np.float64, copy=False)
                    yield times_s, np.frombuffer(b"".join(channels), "<i4")

    def _data(self) -> Iterator[bytes]:
        with opened_log(self._path) as file:
            file.seek(self._places[0])
            for place, end in itertools.pairwise(self._places):
                yield file.read(end - place)


@dataclass(frozen=True, eq=False)
class Log:
    """What a log file holds.

    Attributes:
        header: the words of its first record.
        records: the others, in the order they were written.
        lost_bytes: from the first record on that is not whole.
    """

    header: dict[str, Any]
    records: Records
    lost_bytes: int


def read_log(path: str | os.PathLike[str]) -> Log:
    """Read a log, also one whose program was killed: every checksum is looked at, and what it holds is read later.

    Raises:
        InvalidFile: if it is missing, something else, or has no whole first record.
    """
    path = expect_plain_file(path)
    with opened_log(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidFile(f"{path}: expected the log of a closed-loop session, got something else")
        places, n_bytes = array("Q", [len(MAGIC)]), os.fstat(file.fileno()).st_size
        while (end := _end_of_whole(file, places[-1], n_bytes)) is not None:
            places.append(end)
        if len(places) < 2:
            raise InvalidFile(
                f"{path}: expected the log of a closed-loop session, got one that ends in its first record"
            )
        file.seek(places[0])
        header = words_of(path, file.read(places[1] - places[0]))
    return Log(header, Records(path, places[1:]), n_bytes - places[-1])


@contextmanager
def opened_log(path: Path) -> Iterator[BinaryIO]:
    """A log file, open for reading.

    Raises:
        InvalidFile: if it cannot be read.
    """
    try:
        with path.open("rb", buffering=_BUFFER_BYTES) as file:
            yield file
    except OSError as error:
        raise InvalidFile(f"{path}: cannot be read: {error.strerror or error}") from error


def _end_of_whole(file: BinaryIO, at: int, n_bytes: int) -> int | None:
    """Where the record ends that begins at a place, which the file stands at; None where there is no whole one."""
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    mark, n_words, n_spikes, checksum = HEAD.unpack(head)
    length = n_words + 12 * n_spikes
    end = at + HEAD.size + length
    # Looked at first: a damaged length must not have gigabytes read.
    if mark != RECORD or end > n_bytes or zlib.crc32(file.read(length)) != checksum:
        return None
    return int(end)


def record_of(path: Path, data: bytes) -> Record:
    """A record of all its bytes, which are whole.

    Raises:
        InvalidFile: if its words are not JSON.
    """
    _, n_words, n_spikes, _ = HEAD.unpack_from(data)
    times_at = HEAD.size + n_words
    times_s = np.frombuffer(data, "<f8", n_spikes, times_at).astype(np.float64)
    channels = np.frombuffer(data, "<i4", n_spikes, times_at + 8 * n_spikes).astype(np.int64)
    return Record(words_of(path, data), times_s, channels)


def words_of(path: Path, data: bytes) -> dict[str, Any]:
    """The words of a record of all its bytes, without its spikes; errors as those of `record_of`."""
    _, n_words, _, _ = HEAD.unpack_from(data)
    try:
        words = json.loads(data[HEAD.size : HEAD.size + n_words])
    except (ValueError, RecursionError) as error:
        raise InvalidFile(f"{path}: expected JSON in every record, got {error}") from error
    if not isinstance(words, dict):
        raise InvalidFile(f"{path}: expected names and values in every record, got {type(words).__name__}")
    return in_todays_words(words)


_RECORD = {"contenders": "agents", "sentence": "message"}
_LOOP = {"lead_in": "warm_up", "following": "adaptive"}
_TICK = {"contender": "agent"}
_HANDLED = {"lead-in": "warm-up"}


def in_todays_words(words: dict[str, Any]) -> dict[str, Any]:
    """A record's words by the names of today."""
    words = _renamed(words, _RECORD)
    if isinstance(loop := words.get("loop"), dict):
        words["loop"] = _renamed(loop, _LOOP)
    if isinstance(tick := words.get("tick"), dict):
        words["tick"] = tick = _renamed(tick, _TICK)
        if isinstance(handled := tick.get("handled"), str):
            tick["handled"] = _HANDLED.get(handled, handled)
    return words


def _renamed(words: dict[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    if names.keys().isdisjoint(words):
        return words
    return {names.get(name, name): value for name, value in words.items()}
