"""The log of a closed loop, followed while another process writes it, without locking it."""

from __future__ import annotations

import os
import time
import zlib
from array import array
from pathlib import Path
from typing import Any

from animat.closed_loop.log import HEAD, MAGIC, RECORD, Record, parse_fields, parse_record
from animat.errors import InvalidFile

_KEPT = 4096
"""Number of records kept in memory: those of the last seconds are requested again and again."""
_MOST_BYTES = 2**26
"""Most bytes of a record: a damaged length must not cause gigabytes to be read."""
_BLOCK_BYTES = 2**20
_LOOKS = 512
"""Records between two looks at the clock."""


class Tail:
    """A log that may grow; a truncated record may be one that is just being written, and is checked again each time.

    Attributes:
        generation: changes when the file is replaced or becomes shorter.
        damage: a message on unreadable bytes after the last whole record; empty if there are none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.generation = 0
        self.damage = ""
        self._file: int | None = None
        self._begin()

    def __len__(self) -> int:
        return len(self._places) - 1

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def grow(self, within_s: float) -> bool:
        """Find the records that were added; False if time ran out; raises InvalidFile if the file is not a log."""
        size = self._open()
        assert self._file is not None
        until_s, place = time.monotonic() + within_s, self._places[-1]
        self.damage, n_found = "", 0
        # Read in blocks: reading each head by itself takes three times as long.
        block, begin = b"", place
        while place + HEAD.size <= size:
            if place + HEAD.size > begin + len(block):
                begin, block = place, os.pread(self._file, _BLOCK_BYTES, place)
                if len(block) < HEAD.size:
                    break
            mark, fields_size, n_spikes, _ = HEAD.unpack_from(block, place - begin)
            end = place + HEAD.size + fields_size + 12 * n_spikes
            if mark != RECORD or end - place > _MOST_BYTES or place == self._damaged_at:
                self.damage = f"{size - place:,} bytes after the last whole record are damaged"
                break
            if end > size:
                break
            self._places.append(end)
            place, n_found = end, n_found + 1
            if n_found % _LOOKS == 0 and time.monotonic() > until_s:
                return False
        if place < size and not self.damage:
            self.damage = f"{size - place:,} bytes after the last whole record are of a truncated one"
        return True

    def record(self, number: int) -> Record | None:
        """A record; None if it is not whole, in which case the log ends before it."""
        if number not in self._kept:
            data = self._data(number)
            if data is None:
                return None
            if len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[number] = parse_record(self.path, data)
        return self._kept[number]

    def peek(self, number: int) -> dict[str, Any] | None:
        """The fields of a record, without keeping it; None if it is not whole."""
        if number in self._kept:
            return self._kept[number].fields
        data = self._data(number)
        return None if data is None else parse_fields(self.path, data)

    def _data(self, number: int) -> bytes | None:
        """The bytes of a record, if their checksum is right; otherwise the log ends before it."""
        if self._file is None or not 0 <= number < len(self):
            return None
        place, end = self._places[number], self._places[number + 1]
        data = os.pread(self._file, end - place, place)
        if len(data) == end - place and zlib.crc32(memoryview(data)[HEAD.size :]) == HEAD.unpack_from(data)[3]:
            return data
        self._damaged_at = place
        self.damage = f"{self._places[-1] - place:,} bytes after the last whole record are damaged"
        del self._places[number + 1 :]
        self._kept.clear()
        return None

    def _open(self) -> int:
        """Open the file, or reopen it if it was replaced; returns its size."""
        try:
            status = self.path.stat()
            if self._file is not None:
                ours = os.fstat(self._file)
                if (ours.st_ino, ours.st_dev) != (status.st_ino, status.st_dev) or status.st_size < self._places[-1]:
                    self.close()
                    self._begin()
                    self.generation += 1
            if self._file is None:
                # A pipe of this name would block, and a link may lead anywhere.
                self._file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
                if os.pread(self._file, len(MAGIC), 0) != MAGIC:
                    self.close()
                    raise InvalidFile(f"{self.path}: expected the log of a closed-loop session, got something else")
        except OSError as error:
            self.close()
            raise InvalidFile(f"{self.path}: cannot be read: {error.strerror or error}") from error
        return status.st_size

    def _begin(self) -> None:
        self._places = array("Q", [len(MAGIC)])
        self._kept: dict[int, Record] = {}
        self._damaged_at = -1
