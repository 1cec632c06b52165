"""What a live run is to do, and everything about it that can be checked before a culture is opened."""

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
from animat.plain_file import expect_no_file
from animat.records import Positive, record
from animat.responses.condition import Condition
from animat.stimulation.places import NONE
from animat.stimulation.protocol import Protocol
from animat.training.folder import expect_trainable
from animat.training.specification import Training
from animat.writing import LOCK

LOG_FILE = "live.log"
RECORDINGS, POLICIES, SESSION = "recordings", "policies", "session"
EXCHANGE = ".exchange"
"""A folder of simulators and of how training goes, for the processes that train."""
_NOT_OF_THE_LOOP = ("greedy",)


@record
class Timetable:
    """When the culture is recorded.

    Attributes:
        interval_min: of the culture's clock, between the starts of two recordings.
        duration_min: of the culture's clock, from the first recording to the end of training.
        speed: minutes of the culture's clock in one of ours: 1 for a living one.

    Raises:
        InvalidArgument: for a number that is not above 0.
    """

    interval_min: Positive = 10.0
    duration_min: Positive = 60.0
    speed: Positive = 1.0

    @property
    def recordings(self) -> int:
        """How many are made: the end of training needs none."""
        return math.ceil(self.duration_min / self.interval_min - 1e-9)


@contextmanager
def for_the_first_recording() -> Iterator[None]:
    """Say of a budget that does not hold it what can be done."""
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
    """Raise for what would only come out when the culture is open, or after an hour of training.

    Arguments are those of `animat.live.shadowing.live`.

    Raises:
        InvalidArgument: for a training without neurons or with a neural observation, recordings that take longer than
            an interval, no episodes, or a setting of the closed loop that cannot be.
        BudgetSpent: for a budget with fewer pulses than the first recording.
        InvalidFile: if a file is in the folder's place.
        Mismatch: if something is in the folder already: a live run is not gone on with, as its culture has lived on.
    """
    if training.mapping is None:
        raise InvalidArgument("mapping: expected one, as a live run is through neurons, got none")
    if training.neural_observation:
        raise InvalidArgument("neural_observation: expected False, as a live run shows none, got True")
    if training.pulse_cost:
        raise InvalidArgument(
            f"pulse_cost: expected 0, as conditions of a live run do not differ in it, got {training.pulse_cost:g}"
        )
    if training.lessons or training.assess:
        raise InvalidArgument("lessons, assess: expected none, as a live run has no end that is known, got some")
    if (n := training.robot.n_commands) > 1:
        raise InvalidArgument(
            f"robot: expected one command, as a live run reads all channels as one, got {training.robot.name}, which "
            f"takes {n}: record, train with --readouts, and run"
        )
    expect_trainable(training, is_saved=True)
    takes_min = minutes_of(protocol)
    if takes_min > timetable.interval_min:
        raise InvalidArgument(
            f"interval_min: expected at least the {takes_min:.2f} min that a recording takes, "
            f"got {timetable.interval_min:g}"
        )
    with for_the_first_recording():
        places = max(1, protocol.n_places) - (NONE in protocol.places)
        (account or Account()).check_number(len(protocol.frequencies_hz) * places * protocol.trials * protocol.pulses)
    check_episodes("episodes", episodes)
    of_the_loop = {name: value for name, value in settings.items() if name not in _NOT_OF_THE_LOOP}
    conditions = tuple(Condition(f"{hz:g} Hz", hz, "Hz") for hz in protocol.frequencies_hz)
    given = {name: getattr(protocol, name) for name in ("pulses", "pulse", "patterns")} | of_the_loop
    Loop(training.robot, training.mapping, conditions, np.zeros(N_PERCENTILES, np.float32), **given)
    expect_no_file(folder, "the live run")
    if folder.exists() and any(each.name != LOCK for each in folder.iterdir()):
        raise Mismatch(
            f"{folder}: expected an empty folder for a live run, got one with files; choose another, or see what is "
            f"there: animat watch {folder}"
        )
