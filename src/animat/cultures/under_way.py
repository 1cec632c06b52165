"""The recording that is being made, as far as it is: a file beside the series, for whoever looks meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from animat.recordings.recording import Recording
from animat.writing import atomic_write, clear_away

UNDER_WAY = ".under-way.npz"
"""Its name in the folder of the recordings; hidden, so that no reader of a folder takes it for one of them."""
EVERY_S = 3.0
"""Seconds between two times that it is written."""


class UnderWay:
    """What `Culture.record` is followed by; use it as a context manager, which removes the file in the end.

    Args:
        folder: of the recordings.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / UNDER_WAY
        self._written_s = -np.inf

    def __enter__(self) -> Self:
        self.remove()
        return self

    def __call__(self, so_far: Callable[[], Recording]) -> None:
        """Write what was recorded so far, unless that was done just before."""
        if time.monotonic() - self._written_s < EVERY_S:
            return
        # A recording is not ended for the sake of a look; what is wrong with it, it says itself.
        with suppress(Exception), atomic_write(self._path) as beside, beside.open("wb") as file:
            np.savez(file, **_columns(so_far()))
        self._written_s = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the file, and what a killed run left of it."""
        for file in (self._path, *self._path.parent.glob(f".{UNDER_WAY}.*.partial*")):
            clear_away(file)


def _columns(recording: Recording) -> dict[str, Any]:
    """A recording as `animat.recordings.columns.PlainColumns` names its parts."""
    channels, stimuli, presentation = recording.channels, recording.stimuli, recording.presentation
    return {
        "spike_time_s": recording.spike_times_s,
        "spike_channel": recording.spike_channels,
        "channel_label": channels.label,
        "channel_electrode": channels.electrode,
        "channel_xy_um": np.column_stack([channels.x_um, channels.y_um]),
        **{f"stimulus_{each.name}": getattr(stimuli, each.name) for each in fields(stimuli)},
        **{name: getattr(recording, name) for name in ("sampling_rate_hz", "start_min", "start_s", "duration_s")},
        **({} if presentation is None else {f"presentation_{name}": of for name, of in vars(presentation).items()}),
    }
