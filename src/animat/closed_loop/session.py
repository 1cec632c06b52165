"""A session of the closed loop as it was written down: its ticks, its episodes, and the recording it became."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.gathering import (
    LOG_FILE,
    RECORDING_FILE,
    TICKS_FILE,
    Gathered,
    expecting_a_session,
)
from animat.closed_loop.header import Header, read_header
from animat.closed_loop.log import Log, Records, read_log
from animat.closed_loop.outline import Episode, Outline, electrode_pulses_of
from animat.closed_loop.tick import Ending, Tick, TickTable
from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.folder_kinds import expect_no_other
from animat.plain_file import expect_no_file
from animat.progress import Progress
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.recording import Recording
from animat.writing import atomic_write, clear_away, exclusive_lock, is_unfinished

_TOLD_EVERY = 1000


@dataclass(frozen=True, eq=False)
class Ticks(Iterable[Tick]):
    """Every tick of a log, in the order of time, read from it each time as they are asked for."""

    records: Records

    def __iter__(self) -> Iterator[Tick]:
        return (Tick.from_dict(words["tick"]) for words in self.records.words() if words.get("tick"))


@dataclass(frozen=True, eq=False)
class Session:
    """What a log file says of a session; what is long is read when it is asked for.

    Attributes:
        folder: where it is.
        log: all that was written.
        ending: how it ended.
    """

    folder: Path
    log: Log
    ending: Ending

    @property
    def recording_file(self) -> Path:
        """Where its recording is, once it was written."""
        return self.folder / RECORDING_FILE

    @property
    def ticks_file(self) -> Path:
        """Where its ticks are as a table, once it was written."""
        return self.folder / TICKS_FILE

    @property
    def ticks(self) -> Ticks:
        """Every tick, in the order of time."""
        return Ticks(self.log.records)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Every episode that was begun, in the order of time."""
        return self.outline.episodes

    @property
    def outline(self) -> Outline:
        """What it came to, in numbers."""
        return self._gathered.outline

    def recording(self) -> Recording:
        """The session as a recording: all that was seen, and every pulse as a stimulus of its presentation.

        The responses that are extracted from it are, bit for bit, those that the loop acted on. All spikes are read
        into memory; of a long session rather read `recording_file`.

        Raises:
            InvalidFile: if the log does not fit together.
        """
        with expecting_a_session(self.folder / LOG_FILE):
            blocks = [(np.empty(0), np.empty(0, np.int64)), *self.log.records.spike_blocks()]
            times_s, channels = (np.concatenate(each) for each in zip(*blocks, strict=True))
            # Stretches may touch, and times on samples then overlap by one.
            order = np.argsort(times_s, kind="stable")
            empty = self._gathered.recording_without_spikes(self.ending)
            return replace(empty, spike_times_s=times_s[order], spike_channels=channels[order])

    def write(self, progress: Progress | None = None) -> None:
        """Write the ticks as a table, and the recording after it: once it is there, so are both.

        Args:
            progress: told how many records are read.

        Raises:
            InvalidFile: if the log does not fit together, or a file cannot be written.
        """
        header = self._header
        with expecting_a_session(self.folder / LOG_FILE):
            with atomic_write(self.ticks_file) as beside, beside.open("w", newline="", encoding="utf-8") as file:
                table = TickTable(file, header.conditions, header.observed, header.readouts)
                # Read once: what is asked for next is known.
                vars(self)["_gathered"] = gathered = self._gather(table, progress)
            recording = gathered.recording_without_spikes(self.ending)
            write_nwb(recording, self.recording_file, self.log.records.spike_blocks(), gathered.spike_counts)

    def to_dict(self) -> dict[str, Any]:
        """The outline as plain data."""
        outline = self.outline
        return {
            "ended_by": self.ending.by,
            "ended": self.ending.message,
            "episodes": len(outline.episodes),
            "ticks": outline.ticks,
            "pulses": outline.pulses,
            "bursts": outline.bursts,
            "late_pulses": outline.late,
            "latest_ms": 1000 * outline.latest_s,
            "unanswered_pulses": outline.unanswered_pulses,
            "left_out": outline.left_out,
            "lost_bytes": self.log.lost_bytes,
        }

    @property
    def _header(self) -> Header:
        return read_header(self.folder / LOG_FILE, self.log.header)

    @cached_property
    def _gathered(self) -> Gathered:
        with expecting_a_session(self.folder / LOG_FILE):
            return self._gather()

    def _gather(self, table: TickTable | None = None, progress: Progress | None = None) -> Gathered:
        """Go through all records once, and write their ticks into a table."""
        gathered, records = Gathered(self._header), self.log.records
        for number, record in enumerate(records):
            gathered.add(record)
            if table is not None and record.words["kind"] == "seen" and record.words["tick"]:
                table.add({**record.words["tick"], "electrode_pulses": electrode_pulses_of(record.words)})
            if progress is not None and number % _TOLD_EVERY == 0:
                progress.update(number, len(records))
        return gathered


def read_session(path: str | os.PathLike[str]) -> Session:
    """Read a session from its folder or its log, whatever ended it.

    Raises:
        InvalidFile: if the log is missing, or something else, or its header cannot be.
    """
    path = Path(path)
    file = path / LOG_FILE if path.is_dir() else path
    log = read_log(file)
    read_header(file, log.header)
    ending = Ending("crash", "nothing was written about its end: the program was killed, or still runs")
    # Nothing is written after it.
    last = log.records[-1].words if len(log.records) else {}
    with expecting_a_session(file):
        if last.get("kind") == "end":
            ending = Ending(last["by"], last["message"])
    return Session(file.parent, log, ending)


def expect_no_session(folder: str | os.PathLike[str]) -> None:
    """Raise unless a folder can take a new session; says what can be done with one that is there. Makes the folder.

    Raises:
        InvalidArgument: if a session is there.
        Mismatch: if work of another kind is there, such as recordings.
        InvalidFile: if a file is in the folder's place, or the folder cannot be made or written to.
    """
    folder = Path(folder)
    expect_no_file(folder, "the session")
    if (folder / LOG_FILE).exists():
        told = f" that was killed or still runs: its recording was not written, `animat recover {folder}` does it"
        told = "" if (folder / RECORDING_FILE).exists() else told
        raise InvalidArgument(f"{folder / LOG_FILE}: a session is there already{told}; choose another folder")
    expect_no_other(folder, "session")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidFile(f"{folder}: cannot be made: {error.strerror or error}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidFile(f"{folder}: cannot be written to: permission denied")


def recover_session(path: str | os.PathLike[str], progress: Progress | None = None) -> Session:
    """Read a session whose program was killed, and write the recording and the table that it did not come to write.

    Args:
        path: of its folder or its log.
        progress: told how many records are read.

    Raises:
        InvalidFile: if the log cannot be read or the recording not written.
        Mismatch: if the session still runs, or its table has more ticks than are left in a damaged log.
    """
    # What is no session is told before its folder is held.
    with exclusive_lock(read_session(path).folder):
        session = read_session(path)
        _expect_no_less(session)
        for leftover in session.folder.glob(".*"):
            # What the killed program was just writing.
            if is_unfinished(leftover) and leftover.name.startswith((f".{RECORDING_FILE}.", f".{TICKS_FILE}.")):
                clear_away(leftover)
        session.write(progress)
    return session


def _expect_no_less(session: Session) -> None:
    """Raise where the table that is there has more ticks than a damaged log: it would be written over with less."""
    if not session.log.lost_bytes or not session.ticks_file.exists():
        return
    try:
        with session.ticks_file.open("rb") as table:
            written = sum(1 for _ in table) - 1
    except OSError as error:
        raise InvalidFile(f"{session.ticks_file}: cannot be read: {error.strerror or error}") from error
    if written > session.outline.ticks:
        raise Mismatch(
            f"{session.ticks_file}: expected no more ticks than the log has, which is damaged after "
            f"{session.outline.ticks}, got {written}; move {RECORDING_FILE} and {TICKS_FILE} away to recover what the "
            "log has"
        )


def told_lost(lost_bytes: int) -> str:
    """What a log that is torn or damaged lacks, in a sentence."""
    return f"{lost_bytes} bytes of the log, from where it is torn or damaged on, are lost"


def told_unanswered(session: Session) -> str:
    """What is to be known of pulses that were never answered, in a sentence."""
    n = session.outline.unanswered_pulses
    pulses, them = ("1 pulse was", "it") if n == 1 else (f"{n} pulses were", "them")
    return (
        f"{pulses} asked for and never answered: whether the culture got {them} is not known; {LOG_FILE} has times and "
        "electrodes"
    )
