"""A logged session of the closed loop: its ticks, its episodes, its recording, and the names of its files."""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from animat.arguments import checked_arguments
from animat.closed_loop.header import Header, read_header
from animat.closed_loop.log import Log, open_file, read_log
from animat.closed_loop.outline import Episode, Outline, count_electrode_pulses
from animat.closed_loop.tick import STOP_FILE, Ending, Tick, TickTable
from animat.errors import AnimatError, InvalidArgument, InvalidFile, Mismatch
from animat.folders import expect_no_other
from animat.plain_file import is_absent, is_folder
from animat.progress import Progress
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.formats.nwb_spikes import SpikeCounts
from animat.recordings.metadata import from_metadata
from animat.recordings.recording import Recording
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN
from animat.writing import atomic_write, clear_leftovers, exclusive_lock, expect_writable, take_lock

_OR_RUNNING = ", or it is still running"
LOG_FILE = "session.log"
RECORDING_FILE = "session.nwb"
TICKS_FILE = "ticks.csv"
_UPDATE_EVERY = 1000


@dataclass(frozen=True, eq=False)
class Ticks(Iterable[Tick]):
    """Every tick of a log, in order of time, read again on each iteration."""

    log: Log

    def __iter__(self) -> Iterator[Tick]:
        return (Tick.from_dict(fields["tick"]) for fields in self.log.fields() if fields.get("tick"))


class SessionData:
    """What a session's files need from its records, except the spikes, which stay in the log."""

    def __init__(self, header: Header) -> None:
        self.outline = Outline()
        self.spike_counts = SpikeCounts(len(header.channels))
        self._header = header
        # One entry per pulse, in columns: half a million take 50 MB instead of a gigabyte.
        kinds = {"frequency_hz": "d", "pattern": "q", "presentation": "q", "time_s": "d"}
        self._columns = {name: array(kind) for name, kind in kinds.items()}
        self._electrodes, self._widths = array("q"), array("q")
        self._watched_s = self._end_s = 0.0

    def add(self, fields: Mapping[str, Any]) -> None:
        self.outline.add(fields)
        if fields["kind"] != "seen":
            return
        for *values, electrodes in fields["stimuli"]:
            for name, value in zip(("frequency_hz", "pattern", "presentation"), values, strict=True):
                self._columns[name].append(value)
            self._electrodes.extend(electrodes)
            self._widths.append(len(electrodes))
        if fields["tick"]:
            self._columns["time_s"].extend(fields["tick"]["pulse_time_s"])
        self._watched_s += fields["duration_s"]
        self._end_s = max(self._end_s, fields["start_s"] + fields["duration_s"])

    def recording_without_spikes(self, ending: Ending) -> Recording:
        """The session as a recording, without its spikes; raises UnusableData for inconsistent records."""
        header, outline = self._header, self.outline
        metadata = {
            **header.provenance,
            "session_description": "A closed loop of a neuronal culture on a multi-electrode array with a robot. The "
            f"agent that chooses the stimuli changes between episodes ({', '.join(header.agents)}): {TICKS_FILE} next "
            "to this file states the agent of each stimulus, and the result.",
            "recorded_at": header.recorded_at,
            "closed_loop": header.loop,
            "closed_loop_ended": f"{ending.by}: {ending.message}",
            "closed_loop_unanswered_pulses": str(outline.unanswered_pulses),
        }
        if outline.left_out:
            metadata["left_out"] = describe_left_out(outline.left_out)
        duration_s = max(self._end_s, self.spike_counts.span_s[1], *self._columns["time_s"][-1:])
        metadata["closed_loop_unwatched_s"] = f"{max(0.0, duration_s - self._watched_s):.6f}"
        return Recording(
            spike_times_s=[],  # type: ignore[arg-type]
            spike_channels=[],  # type: ignore[arg-type]
            channels=header.channels,
            stimuli=self._stimuli(),
            sampling_rate_hz=header.sampling_rate_hz,
            start_s=0.0,
            duration_s=duration_s,
            start_min=header.start_min,
            presentation=header.presentation,
            **from_metadata(metadata) | {"loop_pulse": header.pulse},
        )

    def _stimuli(self) -> Stimuli:
        widths = np.array(self._widths, np.int64)
        electrodes = np.full((len(widths), int(np.max(widths)) if len(widths) else 1), UNKNOWN)
        electrodes[np.arange(electrodes.shape[1])[None, :] < widths[:, None]] = self._electrodes
        return Stimuli(electrodes=electrodes, **{name: np.array(values) for name, values in self._columns.items()})


@dataclass(frozen=True, eq=False)
class Session:
    """A session as its log describes it; long parts are read on demand."""

    folder: Path
    log: Log
    ending: Ending

    @property
    def recording_file(self) -> Path:
        """The file of its recording, once written."""
        return self.folder / RECORDING_FILE

    @property
    def ticks_file(self) -> Path:
        """The table of its ticks, once written."""
        return self.folder / TICKS_FILE

    @property
    def ticks(self) -> Ticks:
        """Every tick, in order of time."""
        return Ticks(self.log)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Every episode that began, in order of time."""
        return self.outline.episodes

    @property
    def outline(self) -> Outline:
        """The session in numbers."""
        return self._data.outline

    def recording(self) -> Recording:
        """The session as a recording: everything that was observed, and every pulse as a stimulus of its presentation.

        The responses that are extracted from it are, bit for bit, those that the loop acted on, unless a device
        reported a pulse late: the loop then read a window that ended up to 1 ms early. All spikes are read into memory;
        for a long session read `recording_file` instead. Raises InvalidFile for an inconsistent log.
        """
        with expect_session_log(self.folder / LOG_FILE):
            blocks = [(np.empty(0), np.empty(0, np.int64)), *self.log.spike_blocks()]
            times_s, channels = (np.concatenate(column) for column in zip(*blocks, strict=True))
            # Stretches may touch, and times rounded to samples then overlap by one.
            order = np.argsort(times_s, kind="stable")
            empty = self._data.recording_without_spikes(self.ending)
            return replace(empty, spike_times_s=times_s[order], spike_channels=channels[order])

    def write(self, progress: Progress | None = None) -> None:
        """Write the ticks as a table, and then the recording: if the recording exists, both do.

        Raises InvalidFile for an inconsistent log, or if a file cannot be written.
        """
        with expect_session_log(self.folder / LOG_FILE):
            with atomic_write(self.ticks_file) as partial, partial.open("w", newline="", encoding="utf-8") as file:
                table = TickTable(file, self._header)
                # Keep what was read, for `outline` and `recording`.
                vars(self)["_data"] = data = self._collect(table, progress)
            recording = data.recording_without_spikes(self.ending)
            write_nwb(recording, self.recording_file, self.log.spike_blocks(), data.spike_counts)

    def to_dict(self) -> dict[str, Any]:
        """The outline as plain data."""
        outline = self.outline
        return {
            "ended_by": self.ending.by,
            "ended": self.ending.message,
            "episodes": len(outline.episodes),
            "whole_episodes": sum(episode.is_whole for episode in outline.episodes),
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
    def _data(self) -> SessionData:
        with expect_session_log(self.folder / LOG_FILE):
            return self._collect()

    def _collect(self, table: TickTable | None = None, progress: Progress | None = None) -> SessionData:
        """Read all records once, and write their ticks into a table."""
        data = SessionData(self._header)
        for number, fields in enumerate(self.log.fields()):
            data.add(fields)
            if table is not None and fields["kind"] == "seen" and fields["tick"]:
                table.add({**fields["tick"], "electrode_pulses": count_electrode_pulses(fields)})
            if progress is not None and number % _UPDATE_EVERY == 0:
                progress.update(number, len(self.log))
        for block in self.log.spike_blocks():
            data.spike_counts.add(*block)
        return data


@contextmanager
def expect_session_log(file: Path) -> Iterator[None]:
    """Raise InvalidFile where the records of an intact log are not those of a session."""
    try:
        yield
    except InvalidFile:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError, AnimatError) as error:
        raise InvalidFile(f"{file}: expected a session's log, got {error!r}") from error


def describe_left_out(left_out: Mapping[str, int]) -> str:
    """What is missing from a session, as text."""
    return ", ".join(f"{count} {what}" for what, count in left_out.items())


@checked_arguments
def read_session(path: str | os.PathLike[str]) -> Session:
    """Read a session, whatever ended it; `path`: its folder or its log; InvalidFile if that is missing or damaged."""
    path = Path(path)
    file = path / LOG_FILE if is_folder(path) else path
    if is_absent(file):
        found = f"a folder without {LOG_FILE}" if file != path else "no such file or folder"
        raise InvalidFile(f"{path}: expected the folder of a session, got {found}")
    log = read_log(file)
    read_header(file, log.header)
    ending = Ending("crash", f"no ending was written: the program was killed, or its disk was full{_OR_RUNNING}")
    # The ending is the last record.
    last = log[-1].fields if len(log) else {}
    with expect_session_log(file):
        if last.get("kind") == "end":
            ending = Ending(last["by"], last["message"])
    return Session(file.parent, log, ending)


def expect_no_session(folder: str | os.PathLike[str]) -> None:
    """Check the folder of a new session, which may be missing.

    Raises InvalidArgument or Mismatch if it holds a session, saying what to do with it, a file `STOP`, or other work,
    and InvalidFile if it is a file, or cannot be written to.
    """
    folder = Path(folder)
    if (folder / LOG_FILE).exists():
        state = f" that was killed or is still running: to write its recording, use `animat recover {folder}`"
        state = "" if (folder / RECORDING_FILE).exists() else state
        raise InvalidArgument(f"{folder / LOG_FILE}: expected no session, got one{state}; choose another folder")
    if (folder / STOP_FILE).exists():
        raise InvalidArgument(f"{folder / STOP_FILE}: expected none yet, as it ends a session: remove it first")
    expect_no_other(folder, "session")
    expect_writable(folder)


def recover_session(path: str | os.PathLike[str], progress: Progress | None = None) -> Session:
    """Read a session, from its folder or its log, whose program was killed, and write its missing recording and table.

    Raises:
        InvalidFile: if the log cannot be read or the recording not written.
        Mismatch: if the session is still running, or its table has more ticks than are left in a damaged log.
    """
    # Read before locking, so that the error for a folder without a session comes first.
    folder = read_session(path).folder
    with exclusive_lock(folder), open_file(folder / LOG_FILE) as log:
        # A running session holds it.
        take_lock(folder, log.fileno())
        session = read_session(path)
        ended = session.ending.message.removesuffix(_OR_RUNNING)
        session = replace(session, ending=replace(session.ending, message=ended))
        _expect_no_loss(session)
        clear_leftovers(session.folder, RECORDING_FILE, TICKS_FILE)
        session.write(progress)
    return session


def _expect_no_loss(session: Session) -> None:
    """Raise if the existing table has more ticks than a damaged log: overwriting it would lose ticks."""
    if not session.log.lost_bytes or not session.ticks_file.exists():
        return
    with open_file(session.ticks_file) as table:
        written = sum(1 for _ in table) - 1
    if written > session.outline.ticks:
        files = " and ".join(file.name for file in (session.recording_file, session.ticks_file) if file.exists())
        remedy = f"move {files} away to recover what the log has"
        expected = f"no more ticks than the log has, which is damaged after {session.outline.ticks}"
        raise Mismatch(f"{session.ticks_file}: expected {expected}, got {written}; {remedy}")


def lost_message(lost_bytes: int) -> str:
    """A sentence about what is missing from a torn or damaged log."""
    return f"{lost_bytes} bytes of the log, from where it is torn or damaged, are lost"


def unanswered_message(session: Session) -> str:
    """A sentence about pulses that were never answered."""
    n = session.outline.unanswered_pulses
    pulses, they = ("1 pulse was", "it was") if n == 1 else (f"{n} pulses were", "they were")
    asked = f"{pulses} requested and never answered: whether {they} delivered is not known"
    return f"{asked}; times and electrodes are in {LOG_FILE}"
