"""A series of recordings of one culture over time, one NWB file each, which resumes where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from animat.arguments import checked_arguments
from animat.cultures.base import Culture
from animat.cultures.same_culture import other_patterns
from animat.cultures.under_way import PartialRecording
from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidArgument, Mismatch, expect_at_least, expect_kind, shown
from animat.folders import first_difference
from animat.progress import Part, Progress, Silent
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.placing import RESTARTED_MIN
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule
from animat.writing import clear_leftovers, exclusive_lock, expect_writable

STATE_FILE = "culture.state"
SELECTION_FILE = "selection.json"
LONGEST_MIN = 365 * 24 * 60.0
"""Longest series: a virtual culture's clock goes no further."""
_BYTES_PER_MIN, _BYTES_PER_FILE = 2e6, 1e6
"""Disk space that 1,024 channels fill in a minute, and any recording; required for fewer channels too."""
_MAY_DIFFER = ("stimulation_units",)
"""Entries of a device's provenance that may change when it is reopened with the same culture."""


class Series(NamedTuple):
    """The result of a series."""

    files: list[Path]
    missed_min: list[float]
    """Minutes of the series without a recording, as the next one was already due."""


@checked_arguments
def record_series(
    make_culture: Callable[[], Culture],
    protocol: Protocol | Callable[[Culture], Protocol],
    folder: str | os.PathLike[str],
    *,
    sessions: int = 2,
    interval_min: float = 10.0,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Series:
    """Record a culture every `interval_min`, into files `recording_0000_min.nwb` and so on.

    The names count from the first recording; `start_min` in the file is on the culture's own clock. Every file is
    complete or absent, and none is overwritten. A repeated call continues with the next recording due, if the culture's
    clock has kept running; a recording whose successor is already due is missed.

    A closed `VirtualCulture` misses none: its electrodes (`selection.json`) and, after each recording, its state
    (`culture.state`) are written, and after any interruption a repeated call makes exactly the files of an undisturbed
    run. Existing recordings that the state does not cover are recorded again and compared.

    Args:
        make_culture: returns the culture, either closed, to be opened and closed here, or open, to stay open. Opening a
            device acts on it, so the folder is locked first (`animat.writing.exclusive_lock`).
        protocol: of every recording, or a function that returns it for the culture, which is not yet open; the order of
            stimuli differs from recording to recording.
        folder: where the files go; created if it is missing.
        sessions: number of recordings; by default two, as `animat record` makes.
        interval_min: minutes between the starts of two recordings.
        seed: of the orders of stimuli; zero or more. None: a virtual culture's own, 1 for any other.
        progress: updated after each block.

    Raises:
        InvalidArgument: for a culture in place of a function, no sessions, an interval shorter than a recording, a seed
            below 0, or a protocol with patterns or electrodes that the culture lacks.
        Mismatch: if the folder has recordings that another culture, protocol, interval or version made, or that lie
            ahead of the culture's clock, or another run is at work in the folder.
        InvalidFile: if the folder cannot be written to or the disk lacks room for a recording, before it is made; if a
            file cannot be written, or the state or an existing recording is damaged.
        UnsafeStimulus, DeviceFailed: as the culture raises them; earlier recordings are kept.
    """
    expect_at_least("seed", seed, 0)
    folder, progress = Path(folder), progress or Silent()
    with exclusive_lock(folder), ExitStack() as opened:
        culture, recorded, zero_s = make_culture(), 0, 0.0
        expect_kind("make_culture", culture, Culture, "a function that returns a culture")
        if not isinstance(protocol, Protocol):
            protocol = protocol(culture)
        if seed is None:
            seed = culture.seed if isinstance(culture, VirtualCulture) else 1
        virtual = culture if isinstance(culture, VirtualCulture) and not culture.is_open else None
        n_patterns = len(culture.patterns) if virtual is None else virtual.n_patterns
        check_interval(protocol, sessions, interval_min, n_patterns)
        files, interval_s = [folder / recording_name(n * interval_min) for n in range(sessions)], 60 * interval_min
        made = _existing_recordings(folder, interval_min)
        if virtual is not None:
            virtual.limits.check_pulse(protocol.pulse)
            _check_recordings(made, virtual, protocol, interval_s, seed)
            recorded = _restore(virtual, folder / STATE_FILE)
            if not all(file.exists() for file in files[:recorded]):
                # Recordings before the state were removed: start from the beginning.
                culture, recorded = make_culture(), 0
                assert isinstance(culture, VirtualCulture)
                virtual = culture
        room_bytes = room_bytes_of(protocol, n_patterns)
        if not all(file.exists() for file in files):
            expect_writable(folder, room_bytes=room_bytes)
        if not culture.is_open and recorded < sessions:
            opened.enter_context(culture)
        if culture.is_open:
            # An impossible protocol is refused before anything is written.
            culture.schedule(protocol, seed)
        if virtual is None:
            zero_s = _start_s(made, culture, protocol, interval_s)
        clear_leftovers(folder, "recording_*_min.nwb", STATE_FILE, SELECTION_FILE)
        follow = opened.enter_context(PartialRecording(folder, culture.device is not None))
        if virtual is not None:
            _save_beginning(virtual, folder, recorded)
        for session, file in enumerate(files[recorded:], recorded):
            due_s = zero_s + session * interval_s
            if (virtual is None and file.exists()) or culture.now_s >= due_s + interval_s:
                continue
            if (left_s := due_s - culture.now_s) > 0:
                progress.update(session, sessions, "the culture rests")
                culture.rest(left_s)
            # Checked again before each recording, which is not made if it cannot be written.
            expect_writable(folder, room_bytes=room_bytes)
            part = Part(progress, session, 1, sessions, file.name)
            recording = culture.record(protocol, order_seed(seed, session), part, follow)
            _keep(recording, file, follow)
            if virtual is not None:
                # After the recording, so that the state is never ahead of a missing recording.
                virtual.save_state(folder / STATE_FILE, sessions=session + 1)
            progress.update(session + 1, sessions, file.name)
    existing = [file for file in files if file.exists()]
    progress.update(sessions, sessions, existing[-1].name if existing else "")
    return Series(existing, [session * interval_min for session, file in enumerate(files) if not file.exists()])


def _save_beginning(culture: VirtualCulture, folder: Path, recorded: int) -> None:
    """Save the electrodes and, before any recording, the state: a run killed during the first needs no second scan."""
    if not (recorded and (folder / SELECTION_FILE).exists()):
        culture.selection.save(folder / SELECTION_FILE)
    if not recorded:
        culture.save_state(folder / STATE_FILE, sessions=0)


def _keep(recording: Recording, file: Path, follow: PartialRecording) -> None:
    """Write a recording, or compare it with the file if it was recorded again."""
    if not file.exists():
        follow.finish(recording, partial(write_nwb, recording, file))
    elif not read_recording(file).equals(recording):
        remedy = "remove it, or choose another folder"
        raise Mismatch(f"{file}: expected the same as when recorded again, got another recording: {remedy}")
    else:
        follow.remove()


def order_seed(seed: int, session: int) -> int:
    """The seed of a session's schedule: orders differ between cultures and between sessions."""
    return seed * 10_000 + session


def _restore(culture: VirtualCulture, state: Path) -> int:
    """Restore the culture to the last known state, if there is one; returns after how many recordings it was."""
    if not state.exists():
        return 0
    recorded = culture.restore_state(state).get("sessions")
    if recorded is None:
        got = "one after other use (animat live): choose another folder"
        raise Mismatch(f"{state}: expected the state of a series of recordings, got {got}")
    return recorded


def check_interval(protocol: Protocol, sessions: int, interval_min: float, n_patterns: int | None = None) -> None:
    """Raise InvalidArgument for no sessions, sessions that overlap or go beyond a year, or too few patterns."""
    if sessions < 1:
        raise InvalidArgument(f"sessions: expected at least 1 recording, got {sessions}")
    if not 0 < interval_min < float("inf"):
        raise InvalidArgument(f"interval_min: expected more than 0 minutes, got {interval_min:g}")
    if sessions > 1 and sessions * interval_min > LONGEST_MIN:
        given = f"{shown(sessions)} every {interval_min:g} min"
        raise InvalidArgument(f"sessions: expected recordings within a year, got {given}")
    takes_min = minutes_of(protocol, n_patterns)
    if sessions > 1 and interval_min < takes_min:
        expected = f"at least the {takes_min:.2f} min that a recording takes"
        raise InvalidArgument(f"interval_min: expected {expected}, got {interval_min:g}")


def minutes_of(protocol: Protocol, n_patterns: int | None = None) -> float:
    """How long a recording takes, including set-up; InvalidArgument for too few patterns."""
    # It takes as long on any electrodes: no culture need be opened.
    patterns = np.zeros((protocol.patterns if n_patterns is None else n_patterns, 1), np.int64)
    return make_schedule(protocol, patterns, seed=0, places=[(0,)] * protocol.n_places).duration_s / 60


def room_bytes_of(protocol: Protocol, n_patterns: int | None = None) -> float:
    """The disk space that a recording needs."""
    return _BYTES_PER_FILE + _BYTES_PER_MIN * minutes_of(protocol, n_patterns)


def _existing_recordings(folder: Path, interval_min: float) -> dict[int, Path]:
    """The existing recordings by their place in the series; raises for one that has none, as of another interval."""
    made: dict[int, Path] = {}
    for file in folder.glob("recording_*_min.nwb"):
        place = -1
        with suppress(ValueError, OverflowError):
            place = round(float(file.name.removeprefix("recording_").removesuffix("_min.nwb")) / interval_min)
        if place < 0 or recording_name(place * interval_min) != file.name:
            raise _mismatch(file, f"at a multiple of the interval, {interval_min:g} min, got one in between")
        made[place] = file
    return dict(sorted(made.items()))


def _check_recordings(
    made: Mapping[int, Path], culture: VirtualCulture, protocol: Protocol, interval_s: float, seed: int
) -> None:
    """Raise unless the existing recordings are of a culture of these settings, each at its minute."""
    for session, file in made.items():
        provenance = culture.settings | {"protocol_seed": str(order_seed(seed, session))}
        start_min = _read_expected(file, provenance, protocol).start_min
        if abs(start_min * 60 - session * interval_s) > 1e-6:
            raise _mismatch(file, f"at {session * interval_s / 60:g} min, got one at {start_min:g} min")


def _start_s(made: Mapping[int, Path], culture: Culture, protocol: Protocol, interval_s: float) -> float:
    """When the series began or begins, on the clock of an open culture; raises if recordings are of another one."""
    zero_s = None
    provenance = {name: text for name, text in culture.provenance.items() if name not in _MAY_DIFFER}
    for session, file in made.items():
        recording = _read_expected(file, provenance, protocol)
        for name in ("label", "electrode"):
            if getattr(recording.channels, name).tolist() != getattr(culture.channels, name).tolist():
                raise _mismatch(file, f"of this culture's channels, got others ({name}s differ)")
        # Places come from the protocol, and are not patterns.
        if not protocol.places and (strange := other_patterns(recording, culture)) is not None:
            raise _mismatch(file, f"with this culture's patterns, got others ({strange.value:g} of them)")
        if zero_s is None:
            zero_s = 60 * recording.start_min - session * interval_s
        since_s = culture.now_s - 60 * recording.start_min
        if since_s < recording.duration_s:
            ended_min = recording.start_min + recording.duration_s / 60
            at = f"{culture.now_s / 60:.2f} min, got one at {recording.start_min:.2f} min, to {ended_min:.2f} min"
            raise _mismatch(file, f"before the culture's clock, which is at {at}: it was restarted, or is another's")
        if culture.device is not None and recording.recorded_at is not None:
            passed_s = (datetime.now(UTC) - recording.recorded_at).total_seconds()
            if passed_s > since_s + 60 * RESTARTED_MIN:
                passed = f"{since_s / 60:.0f} min ago by the culture's clock, got one of {passed_s / 60:.0f} min ago"
                raise _mismatch(file, f"{passed} by its date: the clock was restarted")
    return culture.now_s if zero_s is None else zero_s


def _read_expected(file: Path, provenance: Mapping[str, str], protocol: Protocol) -> Recording:
    """Read an existing recording; raises unless it was made by this protocol of a culture with this provenance."""
    recording = read_recording(file)
    used = "null" if recording.protocol is None else recording.protocol.to_json()
    recorded = {**recording.provenance, "protocol": used}
    for name, text in {**provenance, "protocol": protocol.to_json()}.items():
        found, wanted = {name: _parsed(recorded[name])} if name in recorded else {}, {name: _parsed(text)}
        # 25000 and 25000.0 are the same, as another version of a device's package may write it.
        if found != wanted and (difference := first_difference(found, wanted)):
            raise _mismatch(file, f"of the same culture and protocol, got another ({difference})")
    return recording


def _mismatch(file: Path, difference: str) -> Mismatch:
    return Mismatch(f"{file}: expected a recording {difference}: choose another folder")


def _parsed(text: str) -> Any:
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    return text
