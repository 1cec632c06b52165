"""A series of recordings of one culture over time, one NWB file each, that goes on where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from animat.cultures.base import Culture
from animat.cultures.safety import Guard
from animat.cultures.under_way import UnderWay
from animat.cultures.virtual import VirtualCulture
from animat.differences import first_difference
from animat.errors import InvalidArgument, InvalidFile, Mismatch, shown
from animat.progress import Part, Progress, Silent
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.stimulation.schedule import make_schedule
from animat.writing import clear_away, exclusive_lock

STATE_FILE = "culture.state"
SELECTION_FILE = "selection.json"
LONGEST_MIN = 365 * 24 * 60.0
"""From the first recording to the last: a virtual culture's clock goes no further."""


def record_virtual_series(
    make_culture: Callable[[], VirtualCulture],
    protocol: Protocol,
    folder: str | os.PathLike[str],
    *,
    sessions: int = 15,
    interval_min: float = 10.0,
    needs_state: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Record a virtual culture every `interval_min`, into files `recording_0000_min.nwb` and so on.

    Whatever interrupts it, at whatever moment, calling it again gives the very recordings that an undisturbed run
    gives, and the state after the last. Every file is complete or absent. After each recording the culture's state is
    written (`culture.state`); a series goes on from it. What lies between the state and the recordings that are there
    is recorded again and compared; where there is no state, that is all of an unfinished series. The electrodes in use
    are written to `selection.json`.

    Args:
        make_culture: makes the culture, new and closed.
        protocol: of every recording; the order of stimuli differs from one to the next.
        folder: where the files go; made if it is missing.
        sessions: number of recordings.
        interval_min: minutes between the starts of two recordings.
        needs_state: whether a complete series without its state is recorded again to have it.
        progress: told about the scan and after each block.

    Returns:
        The files, in the order of time.

    Raises:
        InvalidArgument: for no sessions, an interval shorter than a recording, or more patterns than the culture has.
        UnsafeStimulus: for a pulse that the culture's limits do not allow.
        Mismatch: if a file of the series is there but from another culture, protocol or version, or another run is at
            work in the folder.
        InvalidFile: if a file cannot be written, or the state or a recording that is there is damaged.
    """
    fresh = make_culture()
    check_interval(protocol, sessions, interval_min, fresh.n_patterns)
    Guard(fresh.limits, ()).check_pulse(protocol.pulse)
    folder, progress = Path(folder), progress or Silent()
    files = series_files(folder, sessions, interval_min)
    # Seen before it is touched: somebody else's folder stays as it is.
    _expect_series(files, fresh, protocol, interval_min)
    with exclusive_lock(folder):
        # And again now that nobody writes: another run may have ended in between.
        _expect_series(files, fresh, protocol, interval_min)
        # What a killed run was just writing; no reader takes such files for whole ones.
        UnderWay(folder).remove()
        for name in (".recording_*_min.nwb", f".{STATE_FILE}", f".{SELECTION_FILE}"):
            for leftover in folder.glob(f"{name}.*.partial*"):
                clear_away(leftover)
        _record(make_culture, protocol, files, interval_min, needs_state, progress)
    return files


def _record(
    make_culture: Callable[[], VirtualCulture],
    protocol: Protocol,
    files: list[Path],
    interval_min: float,
    needs_state: bool,
    progress: Progress,
) -> None:
    """Record what is missing of a series, from the state that it came to."""
    folder, sessions = files[0].parent, len(files)
    there = next((i for i, file in enumerate(files) if not file.exists()), sessions)
    if there == sessions and not _is_behind(make_culture(), folder / STATE_FILE, sessions, needs_state):
        if not (folder / SELECTION_FILE).exists():
            with make_culture() as fresh:
                fresh.selection.save(folder / SELECTION_FILE)
        progress.update(sessions, sessions, "all there already")
        return
    culture, recorded = _resume(make_culture, folder / STATE_FILE, there)
    with culture:
        if not recorded or not (folder / SELECTION_FILE).exists():
            culture.selection.save(folder / SELECTION_FILE)
        if not recorded:
            culture.save_state(folder / STATE_FILE, sessions=0)
        left = range(recorded, sessions)
        for session, recording in record_when_due(
            culture, protocol, files, left, 0.0, 60 * interval_min, culture.seed, progress
        ):
            if not (file := files[session]).exists():
                write_nwb(recording, file)
            elif not read_recording(file).equals(recording):
                raise Mismatch(
                    f"{file}: expected what recording it again gives, got another culture's, protocol's or version's "
                    "recording: remove it, or choose another folder"
                )
            # The recording comes first: were it the other way round, a state could be ahead of a missing recording.
            culture.save_state(folder / STATE_FILE, sessions=session + 1)


def record_when_due(
    culture: Culture,
    protocol: Protocol,
    files: Sequence[Path],
    left: Iterable[int],
    zero_s: float,
    interval_s: float,
    seed: int,
    progress: Progress,
) -> Iterator[tuple[int, Recording]]:
    """Each recording of a series that is left, with its number, when it is due; one whose successor is due is missed.

    Args:
        culture: open.
        protocol: of every recording.
        files: of the whole series.
        left: numbers of the recordings to be made, rising.
        zero_s: when the first one is due, on the culture's clock.
        interval_s: from one to the next.
        seed: of the orders of stimuli.
        progress: told after each block, and when a recording is dealt with.
    """
    # Entered where nothing is left, too: a killed run may have left a file.
    with UnderWay(files[0].parent) as follow:
        for session in left:
            due_s = zero_s + session * interval_s
            if culture.now_s < due_s + interval_s:
                culture.rest(max(0.0, due_s - culture.now_s))
                part = Part(progress, session, 1, len(files), files[session].name)
                yield session, culture.record(protocol, order_seed(seed, session), part, follow)
                follow.remove()
                progress.update(session + 1, len(files), files[session].name)


def order_seed(seed: int, session: int) -> int:
    """The seed of a session's schedule: other cultures and other sessions have other orders."""
    return seed * 10_000 + session


def _is_behind(culture: VirtualCulture, state: Path, sessions: int, needs_state: bool) -> bool:
    """Whether a run was killed between the last recording and the state after it: the series is to end with both.

    A state that is missing was taken away, as one is written before the first recording; that, and one that cannot be
    read, matters to a series that goes on or needs its state, not to one that is complete.
    """
    if not state.exists():
        return needs_state
    try:
        return _recorded(culture, state) < sessions
    except (InvalidFile, Mismatch):
        if needs_state:
            raise
        return False


def _recorded(culture: VirtualCulture, state: Path) -> int:
    """Make a culture what it was when the state of its series was written; returns how many recordings came before."""
    sessions = culture.restore_state(state).get("sessions")
    if sessions is None:
        raise Mismatch(
            f"{state}: expected the state of a series of recordings, got one after something else (animat live): "
            "choose another folder"
        )
    return sessions


def _resume(make_culture: Callable[[], VirtualCulture], state: Path, there: int) -> tuple[VirtualCulture, int]:
    """The culture as it was after the recordings that are there, or as near before that as is known."""
    culture = make_culture()
    if state.exists():
        recorded = _recorded(culture, state)
        if recorded <= there:
            return culture, recorded
        # Recordings were taken away that came before the state: only the beginning is before them.
        culture = make_culture()
    return culture, 0


def series_files(folder: Path, sessions: int, interval_min: float) -> list[Path]:
    """Where the recordings of a series lie."""
    return [folder / recording_name(session * interval_min) for session in range(sessions)]


def check_interval(protocol: Protocol, sessions: int, interval_min: float, n_patterns: int | None = None) -> None:
    """Raise unless there are sessions, each is over when the next one is due, and there are patterns enough.

    How many patterns a culture has is known of some before they are opened; of others it is None.
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


def _expect_series(files: list[Path], culture: VirtualCulture, protocol: Protocol, interval_min: float) -> None:
    for session, file in enumerate(files):
        if not file.exists():
            continue
        there = read_recording(file)
        expected = culture.settings | {"protocol_seed": str(order_seed(culture.seed, session))}
        if difference := difference_from(expected, protocol, there):
            raise Mismatch(
                f"{file}: expected a recording of the same culture and protocol, got another ({difference}): remove "
                "it, or choose another folder"
            )
        start_s = 60 * session * interval_min
        if abs(there.start_min * 60 - start_s) > 1e-6:
            raise Mismatch(f"{file}: expected a recording at {start_s / 60:g} min, got one at {there.start_min:g} min")


def difference_from(expected: Mapping[str, str], protocol: Protocol, recording: Recording) -> str:
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
    except ValueError:
        return words
