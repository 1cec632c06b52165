"""A series of recordings of a culture that cannot be brought back: what is missed is missed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from animat.cultures.base import Culture
from animat.cultures.same_culture import other_patterns
from animat.cultures.series import check_interval, difference_from, record_when_due, series_files
from animat.errors import InvalidArgument, Mismatch
from animat.progress import Progress, Silent
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol
from animat.writing import exclusive_lock

_MAY_DIFFER = ("stimulation_units",)
"""What a device tells of itself that can be otherwise when it is opened anew, and makes no other culture of it."""


class LivingSeries(NamedTuple):
    """What a series has in the end.

    Attributes:
        files: the recordings, in the order of time.
        missed_min: minutes of the series at which none was made: the next was due when the culture was there again.
    """

    files: list[Path]
    missed_min: list[float]


def record_living_series(
    culture: Culture,
    protocol: Protocol,
    folder: str | os.PathLike[str],
    *,
    sessions: int = 15,
    interval_min: float = 10.0,
    seed: int = 1,
    progress: Progress | None = None,
) -> LivingSeries:
    """Record any culture every `interval_min`, into files `recording_0000_min.nwb` and so on, by its contract alone.

    The names count from the first recording; `start_min` within is on the culture's own clock. Every file is complete
    or absent, and none is written over. Called again it goes on with what is due next, as long as the culture's clock
    went on; a recording whose successor is due is missed. A virtual culture can do better: `record_virtual_series`.

    Args:
        culture: open; it stays so.
        protocol: of every recording; the order of stimuli differs from one to the next.
        folder: where the files go; made if it is missing.
        sessions: number of recordings.
        interval_min: minutes between the starts of two recordings.
        seed: of the orders of stimuli; zero or more.
        progress: told after each block.

    Raises:
        InvalidArgument: for no sessions, an interval shorter than a recording, or a seed below 0.
        Mismatch: if recordings are there that another culture or protocol made, or that lie ahead of its clock, or
            another run is at work in the folder.
        InvalidFile: if a file cannot be written, or one that is there is damaged.
        UnsafeStimulus, DeviceFailed: as the culture has it; what was recorded before is kept.
    """
    _check(protocol, sessions, interval_min, seed)
    folder, progress = Path(folder), progress or Silent()
    # Seen before it is touched: somebody else's folder stays as it is.
    _beginning_s(culture, protocol, series_files(folder, sessions, interval_min), 60 * interval_min)
    with exclusive_lock(folder):
        return record_in_held_folder(culture, protocol, folder, sessions, interval_min, seed, progress)


def record_in_held_folder(
    culture: Culture,
    protocol: Protocol,
    folder: Path,
    sessions: int,
    interval_min: float,
    seed: int,
    progress: Progress,
) -> LivingSeries:
    """Do as `record_living_series` does, in a folder that the caller holds (`animat.writing.exclusive_lock`).

    To open a device is to do something to it: whoever opens one for a folder holds that before. Arguments and errors
    are those of `record_living_series`.
    """
    _check(protocol, sessions, interval_min, seed)
    files = series_files(folder, sessions, interval_min)
    # Now that nobody writes: another run may have ended just before the folder was held.
    zero_s = _beginning_s(culture, protocol, files, 60 * interval_min)
    left = [session for session, file in enumerate(files) if not file.exists()]
    for session, recording in record_when_due(
        culture, protocol, files, left, zero_s, 60 * interval_min, seed, progress
    ):
        write_nwb(recording, files[session])
    made = [file for file in files if file.exists()]
    progress.update(sessions, sessions, made[-1].name if made else "")
    return LivingSeries(made, [session * interval_min for session, file in enumerate(files) if not file.exists()])


def _check(protocol: Protocol, sessions: int, interval_min: float, seed: int) -> None:
    check_interval(protocol, sessions, interval_min)
    if seed < 0:
        raise InvalidArgument(f"seed: expected 0 or more, got {seed}")


def _beginning_s(culture: Culture, protocol: Protocol, files: list[Path], interval_s: float) -> float:
    """When the series began or begins, on the culture's clock."""
    zero_s = None
    for session, file in enumerate(files):
        if not file.exists():
            continue
        there = read_recording(file)
        _expect_of(file, there, culture, protocol)
        if zero_s is None:
            zero_s = 60 * there.start_min - session * interval_s
        if culture.now_s < 60 * there.start_min + there.duration_s:
            raise Mismatch(
                f"{file}: expected a recording before the culture's clock, which is at {culture.now_s / 60:.2f} min, "
                f"got one at {there.start_min:.2f} min: the clock began anew, or it is another culture: choose another "
                "folder"
            )
    return culture.now_s if zero_s is None else zero_s


def _expect_of(file: Path, there: Recording, culture: Culture, protocol: Protocol) -> None:
    told = {name: words for name, words in culture.provenance.items() if name not in _MAY_DIFFER}
    if difference := difference_from(told, protocol, there):
        raise Mismatch(
            f"{file}: expected a recording of this culture by this protocol, got another ({difference}): choose "
            "another folder"
        )
    for name in ("label", "electrode"):
        if getattr(there.channels, name).tolist() != getattr(culture.channels, name).tolist():
            raise Mismatch(
                f"{file}: expected a recording of this culture's channels, got others ({name}s differ): choose another "
                "folder"
            )
    # Places are told by the protocol, and are no patterns.
    if not protocol.places and (strange := other_patterns(there, culture)) is not None:
        raise Mismatch(
            f"{file}: expected a recording by this culture's patterns, got others ({strange.value:g} of them): choose "
            "another folder"
        )
