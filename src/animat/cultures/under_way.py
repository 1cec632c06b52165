"""The recording in progress, as a file next to the series for those who watch it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from animat.recordings.columns import columns_of
from animat.recordings.recording import Recording
from animat.writing import atomic_write, clear_away, clear_leftovers

UNDER_WAY = ".under-way.npz"
"""Its name in the folder of the recordings; hidden, so that no reader takes it for one of them."""
EVERY_S = 3.0
"""Shortest time between two writes."""


class PartialRecording:
    """A `follow` function for `Culture.record`; a context manager that removes the file at the end."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / UNDER_WAY
        self._written_s = -np.inf

    def __enter__(self) -> Self:
        self.remove()
        return self

    def __call__(self, so_far: Callable[[], Recording]) -> None:
        """Write the recording so far, unless it was written less than `EVERY_S` ago."""
        if time.monotonic() - self._written_s < EVERY_S:
            return
        # A failed write must not end the recording, which reports its own errors.
        with suppress(Exception), atomic_write(self._path) as temporary, temporary.open("wb") as file:
            np.savez(file, **columns_of(so_far()))
        self._written_s = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the file, and the remains of killed runs."""
        clear_away(self._path)
        clear_leftovers(self._path.parent, UNDER_WAY)
