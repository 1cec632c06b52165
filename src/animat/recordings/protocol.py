"""How stimuli are presented: what must be the same when a culture is recorded and when a robot is driven by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from animat.errors import InvalidArgument

Order = Literal["blocked", "mixed"]


@dataclass(frozen=True)
class Presentation:
    """The order of the stimulus frequencies and the pulses of one presentation; it travels with the data.

    A culture has a memory: at 80 Hz it answers otherwise in a block of 80 Hz than between other frequencies. So a
    simulator, and a policy trained on it, holds for the presentation that it was recorded with.

    Attributes:
        order: `"blocked"`, all stimuli of a frequency together (the paper), or `"mixed"`, a frequency drawn at random
            for each presentation (as a closed loop presents them).
        pulses: pulses 1/f apart in one presentation; the response is read after the last one (the paper: 1).

    Raises:
        InvalidArgument: for another order, or fewer pulses than one.
    """

    order: Order
    pulses: int = 1

    def __post_init__(self) -> None:
        if self.order not in get_args(Order):
            raise InvalidArgument(f"order: expected 'blocked' or 'mixed', got {self.order!r}")
        if self.pulses < 1:
            raise InvalidArgument(f"pulses: expected at least 1 pulse a presentation, got {self.pulses}")

    def __str__(self) -> str:
        return f"{self.order}, {self.pulses} pulse{'' if self.pulses == 1 else 's'} a presentation"
