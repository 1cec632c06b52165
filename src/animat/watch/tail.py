"""The log of a closed loop, followed while another process writes it: where records begin, and each as it is asked for.

Nothing is locked and nothing is written. A record that is cut off may be one that is just being written: it is looked
at again each time. What is not a whole record is never shown.
"""

from __future__ import annotations

import os
import time
import zlib
from array import array
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from animat.closed_loop.log import HEAD, MAGIC, RECORD, Record, parse_fields, parse_record
from animat.errors import InvalidFile

T = TypeVar("T")

_KEPT = 4096
"""Records that are kept as they were read: those of the last seconds are asked for again and again."""
_MOST_BYTES = 2**26
"""Of one record: a damaged length must not have gigabytes read."""
_BLOCK_BYTES = 2**20
_LOOKS = 512
"""Records between two looks at the clock."""


class Tail:
    """A log that may grow.

    Attributes:
        generation: another number once another file is in its place, or it became shorter.
        damage: what follows the last whole record, in words, where nothing more can be read; empty where all is well.
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
        """Let go of the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def grow(self, within_s: float) -> bool:
        """Find the records that were added; False where time was up before the end of the file.

        Raises:
            InvalidFile: if there is no log, or something else.
        """
        size = self._opened()
        assert self._file is not None
        until_s, place = time.monotonic() + within_s, self._places[-1]
        self.damage, n_found = "", 0
        # Read a block at a time: a look at each head by itself takes three times as long.
        block, begin = b"", place
        while place + HEAD.size <= size:
            if place + HEAD.size > begin + len(block):
                begin, block = place, os.pread(self._file, _BLOCK_BYTES, place)
                if len(block) < HEAD.size:
                    break
            mark, n_words, n_spikes, _ = HEAD.unpack_from(block, place - begin)
            end = place + HEAD.size + n_words + 12 * n_spikes
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
            self.damage = f"{size - place:,} bytes after the last whole record are of one that is cut off"
        return True

    def record(self, number: int) -> Record | None:
        """A record; None where it is not whole, and the file ends before it then."""
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        found = self._read(number, parse_record)
        if found is not None:
            self._kept[number] = found
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return found

    def peek(self, number: int) -> dict[str, Any] | None:
        """The words of a record that is looked at once and not kept; None where it is not whole."""
        if (kept := self._kept.get(number)) is not None:
            return kept.fields
        return self._read(number, parse_fields)

    def _read(self, number: int, made_of: Callable[[Path, bytes], T]) -> T | None:
        """What is made of the bytes of a record, if they are those that were written."""
        if self._file is None or not 0 <= number < len(self):
            return None
        place, end = self._places[number], self._places[number + 1]
        data = os.pread(self._file, end - place, place)
        if len(data) == end - place and zlib.crc32(memoryview(data)[HEAD.size :]) == HEAD.unpack_from(data)[3]:
            with suppress(InvalidFile):
                return made_of(self.path, data)
        self._ends_before(number)
        return None

    def _ends_before(self, number: int) -> None:
        """From a damaged record on nothing is shown."""
        place = self._places[number]
        self._damaged_at = place
        self.damage = f"{self._places[-1] - place:,} bytes after the last whole record are damaged"
        del self._places[number + 1 :]
        for later in [each for each in self._kept if each >= number]:
            del self._kept[later]

    def _opened(self) -> int:
        """Open the file, anew where it is another one; returns its size."""
        try:
            there = self.path.stat()
            if self._file is not None:
                ours = os.fstat(self._file)
                if (ours.st_ino, ours.st_dev) != (there.st_ino, there.st_dev) or there.st_size < self._places[-1]:
                    self.close()
                    self._begin()
                    self.generation += 1
            if self._file is None:
                # A pipe of this name would be waited for, and a link may lead anywhere.
                self._file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
                if os.pread(self._file, len(MAGIC), 0) != MAGIC:
                    self.close()
                    raise InvalidFile(f"{self.path}: expected the log of a closed-loop session, got something else")
        except OSError as error:
            self.close()
            raise InvalidFile(f"{self.path}: cannot be read: {error.strerror or error}") from error
        return there.st_size

    def _begin(self) -> None:
        self._places = array("Q", [len(MAGIC)])
        self._kept: OrderedDict[int, Record] = OrderedDict()
        self._damaged_at = -1
