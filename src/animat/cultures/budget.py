"""How many pulses a culture may receive in total, and how many it has received."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from animat.cultures.base import Culture
from animat.errors import AnimatError, BudgetSpent, expect_at_least
from animat.progress import Progress, Silent
from animat.recordings.recording import Recording
from animat.stimulation.plain import whole_number
from animat.stimulation.protocol import Protocol
from animat.stimulation.stimulus import Stimulus


@dataclass(frozen=True)
class Budget:
    """An allowance of stimulation, in addition to the culture's limits; None: unlimited.

    Attributes:
        pulses: in total; electrodes pulsed together count once.
        pulses_per_electrode: on any one electrode.

    Raises:
        InvalidArgument: for a number that is below 0 or not whole.
    """

    pulses: int | None = None
    pulses_per_electrode: int | None = None

    def __post_init__(self) -> None:
        for name in ("pulses", "pulses_per_electrode"):
            if (value := getattr(self, name)) is not None:
                value = whole_number(f"budget.{name}", value)
                expect_at_least(f"budget.{name}", value, 0)
                object.__setattr__(self, name, value)


class Account:
    """What was spent of a budget, in recordings and closed loops alike."""

    def __init__(self, budget: Budget | None = None) -> None:
        self.budget = budget or Budget()
        self.pulses = 0
        self._on: Counter[int] = Counter()

    @property
    def most_on_an_electrode(self) -> int:
        """Pulses on the electrode that had the most."""
        return max(self._on.values(), default=0)

    def check(self, stimuli: Sequence[Stimulus]) -> None:
        """Raise `BudgetSpent`, naming what would be exceeded, unless the budget covers these stimuli too."""
        self.check_number(_count_pulses(stimuli))
        most = self.budget.pulses_per_electrode
        if most is None:
            return
        for electrode, more in _counted(stimuli).items():
            if self._on[electrode] + more > most:
                had = f"electrode {electrode} had {self._on[electrode]} of {most} pulses"
                raise BudgetSpent(f"budget.pulses_per_electrode: {had}, and {_more(more)} wanted")

    def check_number(self, wanted: int) -> None:
        """Raise `BudgetSpent` unless the budget covers this many more pulses, on any electrodes."""
        most = self.budget.pulses
        if most is not None and self.pulses + wanted > most:
            raise BudgetSpent(f"budget.pulses: {self.pulses} of {most} pulses are spent, and {_more(wanted)} wanted")

    def spend(self, stimuli: Sequence[Stimulus]) -> None:
        """Enter stimuli as delivered."""
        self.pulses += _count_pulses(stimuli)
        # Without a Counter of the stimuli, which takes five times as long, before every pulse of a closed loop.
        for stimulus in stimuli:
            for electrode in stimulus.electrodes:
                self._on[electrode] += 1

    def take_back(self, stimuli: Sequence[Stimulus]) -> None:
        """Enter stimuli as not delivered after all: the culture refused them."""
        self.pulses -= _count_pulses(stimuli)
        self._on -= _counted(stimuli)

    def to_dict(self) -> dict[str, Any]:
        """What was spent, and the budget, as plain data."""
        budget, most = self.budget, self.most_on_an_electrode
        of = {"of": budget.pulses, "of_per_electrode": budget.pulses_per_electrode}
        return {"pulses": self.pulses, "most_on_an_electrode": most, **of}

    def __str__(self) -> str:
        of, each = self.budget.pulses, self.budget.pulses_per_electrode
        spent = f"{self.pulses:,}{'' if of is None else f' of {of:,}'} pulses"
        most = f"{self.most_on_an_electrode:,}{'' if each is None else f' of {each:,}'}"
        return f"{spent}; at most {most} on an electrode"


def record_within(
    account: Account,
    culture: Culture,
    protocol: Protocol,
    seed: int,
    progress: Progress | None = None,
    follow: Callable[[Callable[[], Recording]], None] | None = None,
) -> Recording:
    """Record by a protocol, as `Culture.record` does; raises `BudgetSpent` unless the budget covers all of it.

    If a recording fails half way, only the blocks that it had handed to the culture are spent, the last one as a whole.
    """
    schedule = culture.schedule(protocol, seed)
    by_block = [schedule.deliveries(block) for block in schedule.blocks]
    account.check([stimulus for stimuli in by_block for stimulus in stimuli])
    handed_over = _HandedOver(progress or Silent())
    try:
        return culture.record(protocol, seed, handed_over, follow)
    except BaseException as error:
        # Only an error of the culture shows that the current block was refused; not once part of it was delivered.
        if handed_over.blocks.is_integer():
            handed_over.blocks += not isinstance(error, AnimatError) or error.is_admitted
        raise
    finally:
        begun = by_block[: math.ceil(handed_over.blocks)]
        account.spend([stimulus for stimuli in begun for stimulus in stimuli])


class _HandedOver:
    """Counts the blocks of this recording that were delivered: the culture's own count covers every thread."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self.blocks = progress, 0.0

    def update(self, done: float, total: float, note: str = "") -> None:
        self.blocks = done
        self._progress.update(done, total, note)


def _count_pulses(stimuli: Sequence[Stimulus]) -> int:
    """How many of the stimuli are delivered, rests aside."""
    return sum(not stimulus.is_rest for stimulus in stimuli)


def _more(pulses: int) -> str:
    return f"{pulses} more {'was' if pulses == 1 else 'were'}"


def _counted(stimuli: Sequence[Stimulus]) -> Counter[int]:
    return Counter(electrode for stimulus in stimuli for electrode in stimulus.electrodes)
