"""The plan of a live run, and everything about it that can be checked before a culture is opened."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from animat.closed_loop.loop import Loop
from animat.closed_loop.running import check_episodes
from animat.coding.mapping import N_PERCENTILES
from animat.cultures.budget import Account
from animat.cultures.series import minutes_of
from animat.errors import BudgetSpent, InvalidArgument, Mismatch
from animat.folders import RECORDINGS
from animat.plain_file import expect_no_file
from animat.recordings.formats.npz import UNDER_WAY
from animat.records import Positive, record
from animat.responses.condition import Condition
from animat.stimulation.places import NONE
from animat.stimulation.protocol import Protocol
from animat.training.folder import expect_trainable
from animat.training.specification import Training
from animat.writing import LOCK

LOG_FILE = "live.log"


@record
class Timetable:
    """When the culture is recorded.

    Attributes:
        interval_min: minutes of the culture's clock between the starts of two recordings.
        duration_min: minutes of the culture's clock from the first recording to the end of training.
        speed: minutes of the culture's clock per minute of real time: 1 for a living culture.
    """

    interval_min: Positive = 10.0
    duration_min: Positive = 60.0
    speed: Positive = 1.0

    @property
    def recordings(self) -> int:
        """Number of recordings; none is made at the end of training."""
        return math.ceil(self.duration_min / self.interval_min - 1e-9)


@contextmanager
def for_the_first_recording() -> Iterator[None]:
    """Add a remedy to the error for a budget that is too small for the first recording."""
    try:
        yield
    except BudgetSpent as spent:
        raise BudgetSpent(f"{spent} by the first recording: ask for fewer trials, or give a larger budget") from spent


def check_plan(
    training: Training,
    protocol: Protocol,
    folder: Path,
    timetable: Timetable,
    episodes: int,
    settings: Mapping[str, Any],
    account: Account | None = None,
) -> None:
    """Raise for errors that would otherwise appear once the culture is open, or after an hour of training.

    Arguments are those of `animat.live.shadowing.live`.

    Raises:
        InvalidArgument: for a training or a setting that a live run does not have.
        BudgetSpent: for a budget with fewer pulses than the first recording.
        InvalidFile: if the folder is a file.
        Mismatch: if the folder is not empty: a live run cannot be resumed, as its culture has changed since.
    """
    if training.mapping is None:
        raise InvalidArgument("mapping: expected one, as a live run acts through neurons, got none")
    if training.neural_observation:
        raise InvalidArgument("neural_observation: expected False, as a live run has none, got True")
    if training.pulse_cost:
        expected = "expected 0, as all conditions of a live run cost the same"
        raise InvalidArgument(f"pulse_cost: {expected}, got {training.pulse_cost:g}")
    if training.lessons or training.assess:
        raise InvalidArgument("lessons, assess: expected none, as the end of a live run is not known, got some")
    if (n := training.robot.n_commands) > 1:
        got = f"{training.robot.name}, which takes {n}: record, train with --readouts, and run"
        raise InvalidArgument(f"robot: expected one command, as a live run reads all channels as one, got {got}")
    expect_trainable(training, is_saved=True)
    takes_min = minutes_of(protocol)
    if takes_min > timetable.interval_min:
        expected = f"at least the {takes_min:.2f} min that a recording takes"
        raise InvalidArgument(f"interval_min: expected {expected}, got {timetable.interval_min:g}")
    with for_the_first_recording():
        places = max(1, protocol.n_places) - (NONE in protocol.places)
        (account or Account()).check_number(len(protocol.frequencies_hz) * places * protocol.trials * protocol.pulses)
    check_episodes("episodes", episodes)
    loop_settings = {name: getattr(protocol, name) for name in ("pulses", "pulse", "patterns")}
    loop_settings |= {name: value for name, value in settings.items() if name != "greedy"}
    conditions = tuple(Condition(f"{hz:g} Hz", hz, "Hz") for hz in protocol.frequencies_hz)
    Loop(training.robot, training.mapping, conditions, np.zeros(N_PERCENTILES, np.float32), **loop_settings)
    expect_no_file(folder, "the live run")
    if folder.exists() and any(file.name != LOCK for file in folder.iterdir()):
        left = (folder / RECORDINGS / UNDER_WAY).exists()
        see = f"animat {'recover' if left else 'watch'} {folder}"
        remedy = f"choose another, or {'keep what a device had recorded' if left else 'see what it holds'}: {see}"
        raise Mismatch(f"{folder}: expected an empty folder for a live run, got one with files; {remedy}")
