"""A session of the closed loop as it was written down: its ticks, its episodes, and the recording it became."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.log import Log, read_log
from animat.closed_loop.tick import Ending, Tick
from animat.closed_loop.tick_table import write_ticks
from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.protocol import Presentation
from animat.recordings.recording import UNKNOWN, Channels, Recording, Stimuli
from animat.robots.registry import robot_from_dict
from animat.writing import alone_in

LOG_FILE = "session.log"
RECORDING_FILE = "session.nwb"
TICKS_FILE = "ticks.csv"
FORMAT = "animat closed-loop session 1"


@dataclass(frozen=True)
class Episode:
    """One episode of a contender.

    Attributes:
        number: in the session, from 0.
        contender: who acted.
        total: the sum of rewards, in the task's own units.
        iterations: of the robot.
        terminated: whether it ended by itself and not at the limit.
        is_whole: whether it came to its end; what the session broke off has no return.
        pulses: that the culture was given, what led in among them.
        bursts: responses that were bursts, also of what led in.
        late: pulses that came late, also of what led in.
    """

    number: int
    contender: str
    total: float
    iterations: int
    terminated: bool
    is_whole: bool
    pulses: int
    bursts: int
    late: int


@dataclass(frozen=True, eq=False)
class Session:
    """What a log file says of a session.

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

    @cached_property
    def ticks(self) -> tuple[Tick, ...]:
        """Every tick, in the order of time."""
        return tuple(Tick.from_dict(r.words["tick"]) for r in self.log.records if r.words.get("tick"))

    @cached_property
    def episodes(self) -> tuple[Episode, ...]:
        """Every episode that was begun, in the order of time."""
        by_number: dict[int, list[Tick]] = {}
        for tick in self.ticks:
            by_number.setdefault(tick.episode, []).append(tick)
        return tuple(_episode(number, ticks) for number, ticks in sorted(by_number.items()))

    @cached_property
    def unanswered(self) -> tuple[dict[str, Any], ...]:
        """What was asked of the culture and never answered in a way that can be used: whether its pulses came is not
        known, and they are in no recording. The words of its record: when, which stimuli."""
        answered = {r.words.get("stretch") for r in self.log.records if r.words["kind"] == "seen"}
        found = {
            r.words["stretch"]: r.words
            for r in self.log.records
            # Sessions that were logged before this was have events without.
            if r.words["kind"] in ("asked", "event") and r.words.get("stretch") not in answered | {None}
        }
        return tuple(words for words in found.values() if words["stimuli"] and words.get("is_admitted", True))

    @cached_property
    def left_out(self) -> dict[str, int]:
        """What the culture's device reported and the session does not have, by what it is; known once it has ended."""
        return next((r.words.get("left_out", {}) for r in self.log.records if r.words["kind"] == "end"), {})

    def recording(self) -> Recording:
        """The session as a recording: all that was seen, and every pulse as a stimulus of its presentation.

        The responses that are extracted from it are, bit for bit, those that the loop acted on.

        Raises:
            InvalidFile: if the log does not fit together.
        """
        header, seen = self.log.header, [r for r in self.log.records if r.words["kind"] == "seen"]
        try:
            channels = Channels(**{name: np.array(column) for name, column in header["channels"].items()})
            rows = [row for r in seen for row in r.words["stimuli"]]
            pulse_s = [t for r in seen if r.words["tick"] for t in r.words["tick"]["pulse_time_s"]]
            electrodes = np.full((len(rows), max((len(row[3]) for row in rows), default=1)), UNKNOWN)
            for place, row in zip(electrodes, rows, strict=True):
                place[: len(row[3])] = row[3]
            times_s = np.concatenate([np.empty(0), *(r.spike_times_s for r in seen)])
            spike_channels = np.concatenate([np.empty(0, np.int64), *(r.spike_channels for r in seen)])
            # Stretches may touch, and times on samples then overlap by one.
            order = np.argsort(times_s, kind="stable")
            ends_s = [r.words["start_s"] + r.words["duration_s"] for r in seen]
            watched_s = sum(r.words["duration_s"] for r in seen)
            duration_s = max([0.0, *ends_s, *times_s[order[-1:]].tolist(), *pulse_s[-1:]])
            return Recording(
                spike_times_s=times_s[order],
                spike_channels=spike_channels[order],
                channels=channels,
                stimuli=Stimuli(
                    time_s=np.array(pulse_s, np.float64),
                    frequency_hz=np.array([row[0] for row in rows], np.float64),
                    pattern=np.array([row[1] for row in rows], np.int64),
                    electrodes=electrodes,
                    presentation=np.array([row[2] for row in rows], np.int64),
                ),
                sampling_rate_hz=header["sampling_rate_hz"],
                start_s=0.0,
                duration_s=duration_s,
                start_min=header["start_min"],
                presentation=Presentation("mixed", header["loop"]["pulses"]),
                provenance={
                    **header["provenance"],
                    "session_description": _described([each["name"] for each in header["contenders"]]),
                    "recorded_at": header["recorded_at"],
                    "closed_loop": json.dumps(header["loop"]),
                    "closed_loop_ended": f"{self.ending.by}: {self.ending.sentence}",
                    "closed_loop_unwatched_s": f"{max(0.0, duration_s - watched_s):.6f}",
                    **({"left_out": told_left_out(self)} if self.left_out else {}),
                    "closed_loop_unanswered_pulses": str(_pulses(self.unanswered)),
                },
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InvalidFile(f"{self.folder / LOG_FILE}: expected a session's log, got {error!r}") from error

    def write(self) -> None:
        """Write the ticks as a table, and the recording after it: once it is there, so are both.

        Raises:
            InvalidFile: if the log does not fit together, or a file cannot be written.
        """
        try:
            loop = self.log.header["loop"]
            conditions, quantities = loop["conditions"], robot_from_dict(loop["robot"]).quantities
            write_ticks(self.ticks_file, self.ticks, conditions, quantities)
        except (KeyError, TypeError, IndexError, InvalidArgument) as error:
            raise InvalidFile(f"{self.folder / LOG_FILE}: expected a session's log, got {error!r}") from error
        self.recording().save(self.recording_file)

    def to_dict(self) -> dict[str, Any]:
        """The outline as plain data."""
        late_ms = [1000 * tick.late_s for tick in self.ticks]
        return {
            "ended_by": self.ending.by,
            "ended": self.ending.sentence,
            "episodes": len(self.episodes),
            "ticks": len(self.ticks),
            "pulses": sum(len(tick.pulse_time_s) for tick in self.ticks),
            "bursts": sum(tick.is_burst for tick in self.ticks),
            "late_pulses": sum(ms > 0 for ms in late_ms),
            "latest_ms": max(late_ms, default=0.0),
            "unanswered_pulses": _pulses(self.unanswered),
            "left_out": self.left_out,
            "lost_bytes": self.log.lost_bytes,
        }


def read_session(path: str | os.PathLike[str]) -> Session:
    """Read a session from its folder or its log, whatever ended it.

    Raises:
        InvalidFile: if the log is missing, or something else.
    """
    path = Path(path)
    file = path / LOG_FILE if path.is_dir() else path
    log = read_log(file)
    if log.header.get("format") != FORMAT:
        raise InvalidFile(f"{file}: expected {FORMAT!r}, got {log.header.get('format')!r}")
    ending = Ending("crash", "nothing was written about its end: the program was killed, or still runs")
    for record in log.records:
        if record.words["kind"] == "end":
            ending = Ending(record.words["by"], record.words["sentence"])
    return Session(file.parent, log, ending)


def expect_no_file(folder: Path, what: str) -> None:
    """Raise InvalidArgument if a file is in the place of a folder for something."""
    if folder.exists() and not folder.is_dir():
        raise InvalidArgument(f"{folder}: expected a folder for {what}, got a file")


def expect_no_session(folder: str | os.PathLike[str]) -> None:
    """Raise unless a folder can take a new session; says what can be done with one that is there. Makes the folder.

    Raises:
        InvalidArgument: if a session is there, or a file in the folder's place.
        InvalidFile: if the folder cannot be made or written to.
    """
    folder = Path(folder)
    expect_no_file(folder, "the session")
    if (folder / LOG_FILE).exists():
        told = (
            ""
            if (folder / RECORDING_FILE).exists()
            else (f" that was killed or still runs: its recording was not written, `animat recover {folder}` does it")
        )
        raise InvalidArgument(f"{folder / LOG_FILE}: a session is there already{told}; choose another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidFile(f"{folder}: cannot be made: {error.strerror or error}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidFile(f"{folder}: cannot be written to: permission denied")


def recover_session(path: str | os.PathLike[str]) -> Session:
    """Read a session whose program was killed, and write the recording and the table that it did not come to write.

    Raises:
        InvalidFile: if the log cannot be read or the recording not written.
        Mismatch: if the session still runs.
    """
    # What is no session is told before its folder is held.
    with alone_in(read_session(path).folder):
        session = read_session(path)
        session.write()
    return session


def told_unanswered(session: Session) -> str:
    """What is to be known of pulses that were never answered, in a sentence."""
    return (
        f"{_pulses(session.unanswered)} pulses were asked for and never answered: whether they came is not known; "
        f"{LOG_FILE} has their times and electrodes"
    )


def told_left_out(session: Session) -> str:
    """What the session does not have, in words."""
    return ", ".join(f"{count} {what}" for what, count in session.left_out.items())


def _described(contenders: Sequence[str]) -> str:
    return (
        "A closed loop of a neuronal culture on a multi-electrode array with a robot. Who chose the stimuli changes "
        f"from episode to episode ({', '.join(contenders)}): {TICKS_FILE} beside this file tells whose each stimulus "
        "was, and what came of it."
    )


def _pulses(asked: Sequence[dict[str, Any]]) -> int:
    return sum(len(words["stimuli"]) for words in asked)


def _episode(number: int, ticks: list[Tick]) -> Episode:
    return Episode(
        number=number,
        contender=ticks[0].contender,
        total=sum(tick.reward for tick in ticks if tick.reward is not None),
        iterations=sum(tick.reward is not None for tick in ticks),
        terminated=ticks[-1].terminated,
        is_whole=ticks[-1].terminated or ticks[-1].truncated,
        pulses=sum(len(tick.pulse_time_s) for tick in ticks),
        bursts=sum(tick.is_burst for tick in ticks),
        late=sum(tick.late_s > 0 for tick in ticks),
    )
