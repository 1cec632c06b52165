"""The recording in progress: a file next to the series for those who watch it, and what is kept of one cut short."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from tempfile import mkdtemp
from typing import Self

import numpy as np

from animat.errors import AnimatError, InvalidFile, as_invalid_file, counted
from animat.recordings.columns import columns_of
from animat.recordings.formats.npz import METADATA, UNDER_WAY
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.metadata import to_metadata
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.writing import atomic_write, clear_away, clear_leftovers

EVERY_S = 3.0
"""Shortest time between two writes."""
INTERRUPTED = "interrupted"
"""The folder, in that of the series, for recordings of devices that were cut short."""
_REPEATABLE = ("virtual", "replay")
"""The kinds of culture whose recordings need not be kept, as they can be made again."""


class PartialRecording:
    """A `follow` function for `Culture.record`; a context manager that removes the file at the end.

    What there is of a recording of a device, which cannot be repeated, when an error or Ctrl-C ends it before `finish`
    returns, goes into the folder `interrupted`, or else into a temporary one; after a kill, when the next run begins,
    whatever that one records. Until it is there, the file stays.

    Args:
        folder: of the series.
        is_kept: whether the culture is a device.
    """

    def __init__(self, folder: Path, is_kept: bool = False) -> None:
        self._path, self._is_kept = folder / UNDER_WAY, is_kept
        self._written_s = -np.inf
        self._so_far: Callable[[], Recording] | None = None

    def __enter__(self) -> Self:
        keep_interrupted(self._path.parent)
        return self

    def __call__(self, so_far: Callable[[], Recording]) -> None:
        """Write the recording so far, unless it was written less than `EVERY_S` ago."""
        self._so_far = so_far
        if time.monotonic() - self._written_s >= EVERY_S:
            self._write()

    def __exit__(self, _: object, error: BaseException | None, *rest: object) -> None:
        if error is None or self._so_far is None or not self._is_kept:
            self.remove()
            return
        # All of it, as this may be ended, too: by a second Ctrl-C or a kill.
        self._write()
        for attempt in range(3):
            with suppress(Exception):
                if attempt == 2:
                    # A full disk may be why it cannot be kept.
                    self.remove()
                folder = Path(mkdtemp(prefix="animat-")) if attempt == 1 else self._path.parent / INTERRUPTED
                error.add_note(_keep(self._so_far(), folder))
                self.remove()
                return
        # Where there is no room for a recording there may still be some for this file, which is smaller.
        self._write()
        with suppress(OSError):
            if self._path.stat().st_size:
                error.add_note(f"what was recorded so far is in {self._path}: make room, and animat recover keeps it")
                return
        error.add_note("and then: what was recorded so far could not be kept")

    def finish(self, recording: Recording, write: Callable[[], object]) -> None:
        """Write the whole recording, on a full disk in place of the file of the one in progress."""
        self._so_far = lambda: recording
        if self._is_kept:
            self._write()
        else:
            # It can be repeated: its room on the disk is for the recording's own file.
            self.remove()
        try:
            write()
        except InvalidFile:
            if not self._path.exists():
                raise
            self.remove()
            write()
        self._so_far = None
        self.remove()

    def _write(self) -> None:
        # A failed write must not end the recording, which reports its own errors.
        with suppress(Exception):
            assert self._so_far is not None
            recording = self._so_far()
            metadata = json.dumps(to_metadata(recording))
            with atomic_write(self._path) as temporary, temporary.open("wb") as file:
                np.savez(file, **{**columns_of(recording), METADATA: metadata})
        self._written_s = time.monotonic()

    def remove(self) -> None:
        """Remove the file, and the remains of killed runs."""
        clear_away(self._path)
        clear_leftovers(self._path.parent, UNDER_WAY)


def keep_interrupted(folder: Path) -> None:
    """Keep what a killed run had recorded of a device, as a recording in `interrupted`, and remove the rest.

    A damaged file goes there as it is. Raises InvalidFile if it cannot be kept; it then stays where it is.
    """
    left = folder / UNDER_WAY
    if left.exists():
        try:
            recording = read_recording(left)
        except AnimatError:
            with as_invalid_file(folder / INTERRUPTED, "cannot be written"):
                (folder / INTERRUPTED).mkdir(exist_ok=True)
                left.replace(_unused(folder / INTERRUPTED / "damaged.npz"))
        else:
            if recording.culture is None or recording.culture.kind not in _REPEATABLE:
                _keep(recording, folder / INTERRUPTED)
    PartialRecording(folder).remove()


def _unused(file: Path) -> Path:
    """The file, with a number if there is one already."""
    numbered = (file.with_name(f"{file.stem}_{number}{file.suffix}") for number in count(2))
    return next(each for each in chain([file], numbered) if not each.exists())


def _keep(recording: Recording, folder: Path) -> str:
    """Write a recording that was cut short; returns what to tell the user. Raises InvalidFile if that fails."""
    file = _unused(folder / recording_name(round(recording.start_min, 3)))
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InvalidFile(f"{folder}: expected a folder for recordings that were cut short, got {error}") from error
    try:
        write_nwb(recording, file)
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise
    stimuli = counted(len(recording.stimuli), "stimulus", "stimuli")
    return f"what was recorded so far, {recording.duration_s / 60:.1f} min with {stimuli}, is in {file}"
