"""The recording in progress: a file next to the series for those who watch it, and what is kept of one cut short."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from animat.cultures.failures import describe_error
from animat.errors import counted
from animat.recordings.columns import columns_of
from animat.recordings.formats.nwb import recording_name, write_nwb
from animat.recordings.recording import Recording
from animat.writing import atomic_write, clear_away, clear_leftovers

UNDER_WAY = ".under-way.npz"
"""Its name in the folder of the recordings; hidden, so that no reader takes it for one of them."""
EVERY_S = 3.0
"""Shortest time between two writes."""
INTERRUPTED = "interrupted"
"""The folder, in that of the series, for recordings of devices that were cut short."""


class PartialRecording:
    """A `follow` function for `Culture.record`; a context manager that removes the file at the end.

    If an error or Ctrl-C ends a recording of a device, which cannot be repeated, the part so far is written into the
    folder `interrupted`.

    Args:
        folder: of the series.
        is_kept: whether the culture is a device.
    """

    def __init__(self, folder: Path, is_kept: bool = False) -> None:
        self._path, self._is_kept = folder / UNDER_WAY, is_kept
        self._written_s = -np.inf
        self._so_far: Callable[[], Recording] | None = None

    def __enter__(self) -> Self:
        self.remove()
        return self

    def __call__(self, so_far: Callable[[], Recording]) -> None:
        """Write the recording so far, unless it was written less than `EVERY_S` ago."""
        self._so_far = so_far
        if time.monotonic() - self._written_s < EVERY_S:
            return
        # A failed write must not end the recording, which reports its own errors.
        with suppress(Exception), atomic_write(self._path) as temporary, temporary.open("wb") as file:
            np.savez(file, **columns_of(so_far()))
        self._written_s = time.monotonic()

    def __exit__(self, _: object, error: BaseException | None, *rest: object) -> None:
        so_far = self._so_far
        self.remove()
        if error is not None and so_far is not None and self._is_kept:
            try:
                error.add_note(_keep(so_far(), self._path.parent / INTERRUPTED))
            except Exception as failed:
                error.add_note(f"and then: the recording so far could not be kept: {describe_error(failed)}")

    def remove(self) -> None:
        """Remove the file, at the end of its recording, and the remains of killed runs."""
        self._so_far = None
        clear_away(self._path)
        clear_leftovers(self._path.parent, UNDER_WAY)


def _keep(recording: Recording, folder: Path) -> str:
    """Write a recording that was cut short; returns what to tell the user."""
    name = Path(recording_name(round(recording.start_min, 3)))
    taken = len(list(folder.glob(f"{name.stem}*")))
    file = folder / (f"{name.stem}_{taken + 1}{name.suffix}" if taken else name)
    folder.mkdir(exist_ok=True)
    write_nwb(recording, file)
    stimuli = counted(len(recording.stimuli), "stimulus", "stimuli")
    return f"what was recorded so far, {recording.duration_s / 60:.1f} min with {stimuli}, is in {file}"
