"""A series of recordings of one culture over time, one NWB file each, that goes on where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.safety import Guard
from animat.cultures.same_culture import other_patterns
from animat.cultures.under_way import UnderWay
from animat.cultures.virtual import VirtualCulture
from animat.differences import first_difference
from animat.errors import InvalidArgument, Mismatch, shown
from animat.progress import Part, Progress, Silent
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule
from animat.writing import clear_away, exclusive_lock, expect_writable

STATE_FILE = "culture.state"
SELECTION_FILE = "selection.json"
LONGEST_MIN = 365 * 24 * 60.0
"""From the first recording to the last: a virtual culture's clock goes no further."""
BYTES_PER_MIN = 2e6
"""What 1,024 channels fill of the disk in a minute; a disk without that much room is as good as full for fewer too."""
_MAY_DIFFER = ("stimulation_units",)
"""What a device tells of itself that can be otherwise when it is opened anew, and makes no other culture of it."""


class Series(NamedTuple):
    """What a series has in the end.

    Attributes:
        files: the recordings, in the order of time.
        missed_min: minutes of the series at which none was made: the next was due when the culture was there again.
    """

    files: list[Path]
    missed_min: list[float]


def record_series(
    make_culture: Callable[[], Culture],
    protocol: Protocol | Callable[[Culture], Protocol],
    folder: str | os.PathLike[str],
    *,
    sessions: int = 15,
    interval_min: float = 10.0,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Series:
    """Record a culture every `interval_min`, into files `recording_0000_min.nwb` and so on.

    The names count from the first recording; `start_min` within is on the culture's own clock. Every file is complete
    or absent, and none is written over. Called again it goes on with what is due next, as long as the culture's clock
    went on; a recording whose successor is due is missed.

    A closed `VirtualCulture` misses none: its state is written after each recording (`culture.state`), and whatever
    interrupts it, calling again gives the very recordings, and state, that an undisturbed run gives. What lies between
    the state and the recordings that are there is recorded again and compared; where there is no state, that is all.
    The electrodes in use are written to `selection.json`.

    Args:
        make_culture: makes the culture, closed, to be opened and closed here; or gives an open one, which stays so. To
            open a device is to do something to it: the folder is held before (`animat.writing.exclusive_lock`).
        protocol: of every recording, or what gives it for the culture, which is not opened yet; the order of stimuli
            differs from one recording to the next.
        folder: where the files go; made if it is missing.
        sessions: number of recordings.
        interval_min: minutes between the starts of two recordings.
        seed: of the orders of stimuli; zero or more. None: a virtual culture's own, 1 for any other.
        progress: told after each block.

    Raises:
        InvalidArgument: for no sessions, an interval shorter than a recording, a seed below 0, or more patterns or
            other electrodes than the culture has.
        Mismatch: if recordings are there that another culture, protocol or version made, or that lie ahead of the
            culture's clock, or another run is at work in the folder.
        InvalidFile: if the folder cannot be written to or the disk lacks room for a recording, before it is made; if a
            file cannot be written, or the state or a recording that is there is damaged.
        UnsafeStimulus, DeviceFailed: as the culture has it; what was recorded before is kept.
    """
    if seed is not None and seed < 0:
        raise InvalidArgument(f"seed: expected 0 or more, got {seed}")
    folder, progress = Path(folder), progress or Silent()
    with exclusive_lock(folder), ExitStack() as opened:
        culture, recorded, zero_s = make_culture(), 0, 0.0
        if not isinstance(protocol, Protocol):
            protocol = protocol(culture)
        if seed is None:
            seed = culture.seed if isinstance(culture, VirtualCulture) else 1
        virtual = culture if isinstance(culture, VirtualCulture) and not culture.is_open else None
        n_patterns = len(culture.patterns) if virtual is None else virtual.n_patterns
        check_interval(protocol, sessions, interval_min, n_patterns)
        files, interval_s = series_files(folder, sessions, interval_min), 60 * interval_min
        if virtual is not None:
            Guard(virtual.limits, ()).check_pulse(protocol.pulse)
            _expect_lived(files, virtual, protocol, interval_s, seed)
            virtual, recorded = _resumed(make_culture, virtual, files)
            culture = virtual
        room_bytes = BYTES_PER_MIN * minutes_of(protocol, n_patterns)
        if not all(file.exists() for file in files):
            expect_writable(folder, room_bytes=room_bytes)
        if not culture.is_open and recorded < sessions:
            opened.enter_context(culture)
        if culture.is_open:
            # What this culture cannot be given is refused before anything is written.
            culture.schedule(protocol, seed)
        if virtual is None:
            zero_s = _beginning_s(files, culture, protocol, interval_s)
        # No reader takes what a killed run was just writing for whole files.
        for name in (".recording_*_min.nwb", f".{STATE_FILE}", f".{SELECTION_FILE}"):
            for leftover in folder.glob(f"{name}.*.partial*"):
                clear_away(leftover)
        follow = opened.enter_context(UnderWay(folder))
        if virtual is not None and not (recorded and (folder / SELECTION_FILE).exists()):
            virtual.selection.save(folder / SELECTION_FILE)
        if virtual is not None and not recorded:
            # Whatever is killed in the first recording needs no second scan.
            virtual.save_state(folder / STATE_FILE, sessions=0)
        for session, file in enumerate(files[recorded:], recorded):
            due_s = zero_s + session * interval_s
            if (virtual is None and file.exists()) or culture.now_s >= due_s + interval_s:
                continue
            culture.rest(max(0.0, due_s - culture.now_s))
            # Again before each: what cannot be written is not recorded.
            expect_writable(folder, room_bytes=room_bytes)
            part = Part(progress, session, 1, sessions, file.name)
            recording = culture.record(protocol, order_seed(seed, session), part, follow)
            if not file.exists():
                write_nwb(recording, file)
            elif not read_recording(file).equals(recording):
                raise Mismatch(
                    f"{file}: expected what recording it again gives, got another culture's, protocol's or version's "
                    "recording: remove it, or choose another folder"
                )
            if virtual is not None:
                # The recording comes first: were it the other way round, a state could be ahead of a missing recording.
                virtual.save_state(folder / STATE_FILE, sessions=session + 1)
            follow.remove()
            progress.update(session + 1, sessions, file.name)
    made = [file for file in files if file.exists()]
    progress.update(sessions, sessions, made[-1].name if made else "")
    return Series(made, [session * interval_min for session, file in enumerate(files) if not file.exists()])


def order_seed(seed: int, session: int) -> int:
    """The seed of a session's schedule: other cultures and other sessions have other orders."""
    return seed * 10_000 + session


def _resumed(
    make_culture: Callable[[], Culture], culture: VirtualCulture, files: list[Path]
) -> tuple[VirtualCulture, int]:
    """The culture after the recordings that are there, or as near before that as is known; and after how many."""
    state = files[0].with_name(STATE_FILE)
    if not state.exists():
        return culture, 0
    recorded = culture.restore_state(state).get("sessions")
    if recorded is None:
        raise Mismatch(
            f"{state}: expected the state of a series of recordings, got one after something else (animat live): "
            "choose another folder"
        )
    if all(file.exists() for file in files[:recorded]):
        return culture, recorded
    # Recordings were taken away that came before the state: only the beginning is before them.
    new = make_culture()
    assert isinstance(new, VirtualCulture)
    return new, 0


def series_files(folder: Path, sessions: int, interval_min: float) -> list[Path]:
    """Where the recordings of a series lie."""
    return [folder / recording_name(session * interval_min) for session in range(sessions)]


def check_interval(protocol: Protocol, sessions: int, interval_min: float, n_patterns: int | None = None) -> None:
    """Raise unless there are sessions, each is over when the next one is due, and there are patterns enough.

    How many patterns a culture has is None where there is no culture yet.
    """
    if sessions < 1:
        raise InvalidArgument(f"sessions: expected at least 1 recording, got {sessions}")
    if not 0 < interval_min < float("inf"):
        raise InvalidArgument(f"interval_min: expected more than 0 minutes, got {interval_min}")
    if sessions > 1 and sessions * interval_min > LONGEST_MIN:
        raise InvalidArgument(
            f"sessions, interval_min: expected recordings within a year, got {shown(sessions)} every "
            f"{interval_min:g} min"
        )
    takes_min = minutes_of(protocol, n_patterns)
    if sessions > 1 and interval_min < takes_min:
        raise InvalidArgument(
            f"interval_min: expected at least the {takes_min:.2f} min that a recording takes, got {interval_min:g}"
        )


def minutes_of(protocol: Protocol, n_patterns: int | None = None) -> float:
    """How long a recording takes, set-up included; InvalidArgument where that many patterns are too few."""
    # On whatever electrodes it takes as long: no culture need be opened.
    patterns = np.zeros((protocol.patterns if n_patterns is None else n_patterns, 1), np.int64)
    return make_schedule(protocol, patterns, seed=0, places=[(0,)] * protocol.n_places).duration_s / 60


def _expect_lived(files: list[Path], culture: VirtualCulture, protocol: Protocol, interval_s: float, seed: int) -> None:
    """Raise unless the recordings that are there are of a culture of these settings, each at its minute."""
    for session, file in enumerate(files):
        if not file.exists():
            continue
        told = culture.settings | {"protocol_seed": str(order_seed(seed, session))}
        there = _read_of(file, told, protocol)
        if abs(there.start_min * 60 - session * interval_s) > 1e-6:
            raise Mismatch(
                f"{file}: expected a recording at {session * interval_s / 60:g} min, got one at "
                f"{there.start_min:g} min: choose another folder"
            )


def _beginning_s(files: list[Path], culture: Culture, protocol: Protocol, interval_s: float) -> float:
    """When the series began or begins, on the clock of an open culture; raises where recordings are not of it."""
    zero_s = None
    told = {name: words for name, words in culture.provenance.items() if name not in _MAY_DIFFER}
    for session, file in enumerate(files):
        if not file.exists():
            continue
        there = _read_of(file, told, protocol)
        for name in ("label", "electrode"):
            if getattr(there.channels, name).tolist() != getattr(culture.channels, name).tolist():
                raise Mismatch(
                    f"{file}: expected a recording of this culture's channels, got others ({name}s differ): choose "
                    "another folder"
                )
        # Places are told by the protocol, and are no patterns.
        if not protocol.places and (strange := other_patterns(there, culture)) is not None:
            raise Mismatch(
                f"{file}: expected a recording by this culture's patterns, got others ({strange.value:g} of them): "
                "choose another folder"
            )
        if zero_s is None:
            zero_s = 60 * there.start_min - session * interval_s
        if culture.now_s < 60 * there.start_min + there.duration_s:
            raise Mismatch(
                f"{file}: expected a recording before the culture's clock, which is at {culture.now_s / 60:.2f} min, "
                f"got one at {there.start_min:.2f} min: the clock began anew, or it is another culture: choose another "
                "folder"
            )
    return culture.now_s if zero_s is None else zero_s


def _read_of(file: Path, told: Mapping[str, str], protocol: Protocol) -> Recording:
    """A recording that is there; raises unless it was made by this protocol of a culture that tells this of itself."""
    there = read_recording(file)
    if difference := _difference(told, protocol, there):
        raise Mismatch(
            f"{file}: expected a recording of the same culture and protocol, got another ({difference}): choose "
            "another folder"
        )
    return there


def _difference(expected: Mapping[str, str], protocol: Protocol, recording: Recording) -> str:
    """The first setting that a recording was not made with; nothing where there is none."""
    for name, words in expected.items():
        there = {name: _parsed(recording.provenance[name])} if name in recording.provenance else {}
        if difference := first_difference(there, {name: _parsed(words)}):
            return difference
    by = None if recording.protocol is None else json.loads(recording.protocol.to_json())
    return first_difference({"protocol": by}, {"protocol": json.loads(protocol.to_json())})


def _parsed(words: str) -> Any:
    try:
        return json.loads(words)
    except (ValueError, RecursionError):
        return words
