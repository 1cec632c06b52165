"""The log of a closed loop, followed and counted while another process writes it, without locking it."""

from __future__ import annotations

import math
import os
import time
from array import array
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.log import HEAD, MAGIC, RECORD, LogRecord, end_of_intact, parse_fields, parse_record
from animat.closed_loop.outline import Episode, Outline
from animat.errors import InvalidFile
from animat.evaluation.statistics import interval_of_mean
from animat.watch.files import mapped, number, numbers, text

_KEPT = 4096
"""Number of records kept in memory: those of the last seconds are requested again and again."""
_MOST_BYTES = 2**26
"""Most bytes of a record: one that seems to be longer has a damaged length."""
_BLOCK_BYTES = 2**20
_LOOKS = 64
"""Records between two looks at the clock."""
_MOST_FAULTS = 50
_MOST_THRESHOLDS = 20_000
"""Most changes of thresholds kept; beyond it every second one is dropped, repeatedly."""
_MOST_RETURNS = 200
"""Most returns drawn per agent: the last ones."""

PercentilesSince = tuple[float, list[float | None]]
"""When thresholds changed, on the session's clock, and the percentiles in Hz since then."""


class Tail:
    """A log that may grow; a truncated record may be one that is just being written, and is checked again each time.

    Attributes:
        generation: changes when the file is replaced or becomes shorter.
        damage: a message on unreadable bytes after the last whole record; empty if there are none.
        record: gives a record by its place, and keeps the last ones.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.generation = -1
        self.damage = ""
        self._file: int | None = None
        self._begin()

    def _begin(self) -> None:
        self._places = array("Q", [len(MAGIC)])
        # The file's size when its records were last searched for.
        self._size = 0
        self.record = lru_cache(_KEPT)(self._record)

    def __len__(self) -> int:
        return len(self._places) - 1

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def grow(self, within_s: float) -> bool:
        """Find the records that were added; False if time ran out; raises InvalidFile if the file is not a log."""
        size = self._open()
        if size == self._size and not self.damage:
            return True
        assert self._file is not None
        self.damage, until_s = "", time.monotonic() + within_s
        with os.fdopen(self._file, "rb", _BLOCK_BYTES, closefd=False) as file:
            file.seek(self._places[-1])
            while (end := end_of_intact(file, at := self._places[-1], min(size, at + _MOST_BYTES))) is not None:
                self._places.append(end)
                if len(self) % _LOOKS == 0 and time.monotonic() > until_s:
                    return False
        self._size = size
        if left := size - self._places[-1]:
            head, is_truncated = os.pread(self._file, HEAD.size, self._places[-1]), True
            if len(head) == HEAD.size:
                mark, n_fields, n_spikes, _ = HEAD.unpack(head)
                is_truncated = mark == RECORD and left < HEAD.size + n_fields + 12 * n_spikes <= _MOST_BYTES
            what = "of a truncated one" if is_truncated else "damaged"
            self.damage = f"{left:,} bytes after the last whole record are {what}"
        return True

    def _record(self, at: int) -> LogRecord:
        return parse_record(self.path, self._data(at))

    def peek(self, at: int) -> dict[str, Any]:
        """The fields of a record, without keeping it."""
        return parse_fields(self.path, self._data(at))

    def _data(self, at: int) -> bytes:
        assert self._file is not None
        return os.pread(self._file, self._places[at + 1] - self._places[at], self._places[at])

    def _open(self) -> int:
        """Open the file, or reopen it if it was replaced; returns its size."""
        try:
            status = self.path.stat()
            if self._file is not None:
                ours = os.fstat(self._file)
                if (ours.st_ino, ours.st_dev) != (status.st_ino, status.st_dev) or status.st_size < self._places[-1]:
                    self.close()
            if self._file is None:
                # Without blocking or following links: it may be a pipe, or a link to any place.
                self._file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
                if os.pread(self._file, len(MAGIC), 0) != MAGIC:
                    self.close()
                    raise InvalidFile(f"{self.path}: expected the log of a closed-loop session, got something else")
                self._begin()
                self.generation += 1
        except OSError as error:
            self.close()
            raise InvalidFile(f"{self.path}: cannot be read: {error.strerror or error}") from error
        return status.st_size


class Sums:
    """The totals of a log's records counted so far; `strange` are those that are not understood.

    Attributes:
        totals: for each record counted the return of its episode so far; NaN without a tick.
        wall_s: of the last tick, on the program's clock; None before the first.
        faults: the last ones: when, on the session's clock, and what happened.
    """

    def __init__(self, tail: Tail) -> None:
        self._tail = tail
        self.outline = Outline()
        self.strange = self.n_faults = 0
        self.totals = array("d")
        self.wall_s: float | None = None
        self.on_electrode: Counter[int] = Counter()
        self.faults: list[tuple[float | None, str]] = []
        self.percentiles: list[PercentilesSince] = []
        self._end_s = 0.0

    def go_on(self, within_s: float) -> None:
        """Count the records that were added, for at most `within_s`."""
        until_s = time.monotonic() + within_s
        while len(self.totals) < len(self._tail):
            try:
                self.totals.append(self._add(self._tail.peek(len(self.totals))))
            except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError):
                self.totals.append(math.nan)
                self.strange += 1
            if len(self.totals) % _LOOKS == 0 and time.monotonic() > until_s:
                return

    @property
    def share(self) -> float:
        """The share of the log's records that are counted."""
        return len(self.totals) / max(1, len(self._tail))

    def _add(self, fields: dict[str, Any]) -> float:
        """Count a record; returns the total of its episode."""
        episode = self.outline.add(fields)
        if (kind := fields["kind"]) == "seen":
            self._end_s = float(fields["start_s"]) + float(fields["duration_s"])
            for _, _, _, electrodes in fields["stimuli"]:
                self.on_electrode.update(electrodes)
        elif kind == "event":
            self.n_faults += 1
            fault = number(fields.get("asked_at_s")), f"{text(fields['what'])}: {text(fields['message'])}"
            self.faults = [*self.faults, fault][-_MOST_FAULTS:]
        # Older sessions have separate records for them.
        if "percentiles_hz" in fields:
            self.percentiles.append((self._end_s, first_readout(fields["percentiles_hz"])))
            if len(self.percentiles) > _MOST_THRESHOLDS:
                del self.percentiles[1::2]
        if episode is None:
            return math.nan
        self.wall_s = number(fields["tick"].get("wall_s"))
        return episode.total


def first_readout(percentiles: Any) -> list[float | None]:
    """The percentiles of the first or only readout."""
    return numbers(percentiles[0] if percentiles and isinstance(percentiles[0], list) else percentiles)


def by_agent(names: Sequence[str], episodes: Sequence[Episode], predictions: Any) -> list[dict[str, Any]]:
    """For each agent: the number of whole episodes, their returns, and the mean with its 95 % interval.

    The names of the agents and the predictions are those of the session's header; what is no prediction is left out.
    """
    predicted = {}
    for name, row in mapped(predictions).items():
        values = [number(mapped(row).get(key)) for key in ("mean", "low", "high")]
        if None not in values:
            predicted[text(name)] = values
    returns_of: dict[str, list[float]] = {text(name): [] for name in names}
    for episode in episodes:
        returns = returns_of.setdefault(text(episode.agent), [])
        if episode.is_whole and number(episode.total) is not None:
            returns.append(episode.total)
    rows = []
    for name, returns in returns_of.items():
        mean = interval_of_mean(np.array(returns)) if returns else None
        # Equal returns do not show how they vary.
        half = None if mean is None or len(set(returns)) < 2 else number(mean.high - mean.value)
        known = {"mean": mean and number(mean.value), "half": half, "predicted": predicted.get(name)}
        rows.append({"name": name, "n": len(returns), "returns": returns[-_MOST_RETURNS:], **known})
    return rows
