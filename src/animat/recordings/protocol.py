"""How stimuli are presented: what must be the same when a culture is recorded and when a robot is driven by it."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from typing import Literal, get_args

from animat.errors import InvalidArgument
from animat.recordings.stimulus import PUBLISHED_PULSE, Pulse

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


@dataclass(frozen=True)
class Protocol:
    """What is done in one recording; with patterns and a seed it becomes a `Schedule` (`recordings.schedule`).

    Every pulse comes 1/f after the one before it, f being the frequency of its own presentation, and the response is
    read after the last pulse of a presentation. The defaults are the paper's: five frequencies as blocks in random
    order, each of 100 patterns once at each, one pulse a presentation.

    Attributes:
        frequencies_hz: the conditions, each once.
        order: `"blocked"` or `"mixed"`: the frequencies' presentations shuffled together, as a closed loop meets them.
        pulses: of one presentation, with different patterns where there are enough.
        patterns: how many of the culture's patterns are used, the first ones; 1 repeats one pattern.
        presentations: at each frequency; each pattern is read equally often, in random order.
        setup_s: before each block (mixed: before the one block), the time that setting up takes. Nothing is recorded
            meanwhile, and the recording's clock leaves it out.
        pause_s: recorded without stimuli before each block.
        tail_s: recorded after the last pulse of each block.
        pulse: what every electrode delivers.

    Raises:
        InvalidArgument: naming the attribute, what was expected and what came.

    Source: the paper's methods; 38.75 s of stimulation in about 120 s with set-up.
    """

    frequencies_hz: tuple[float, ...] = (5.0, 10.0, 20.0, 40.0, 80.0)
    order: Order = "blocked"
    pulses: int = 1
    patterns: int = 100
    presentations: int = 100
    setup_s: float = 14.0
    pause_s: float = 2.0
    tail_s: float = 0.1
    pulse: Pulse = PUBLISHED_PULSE

    def __post_init__(self) -> None:
        object.__setattr__(self, "frequencies_hz", tuple(float(f) for f in self.frequencies_hz))
        if not self.frequencies_hz or not all(0 < f <= 10_000 for f in self.frequencies_hz):
            raise InvalidArgument(f"frequencies_hz: expected some, above 0 Hz to 10 kHz, got {self.frequencies_hz}")
        if len(set(self.frequencies_hz)) < len(self.frequencies_hz):
            raise InvalidArgument(f"frequencies_hz: expected each once, got {self.frequencies_hz}")
        for name in ("patterns", "presentations"):
            if not 1 <= getattr(self, name) <= 1_000_000:
                raise InvalidArgument(f"{name}: expected 1 to 1,000,000, got {getattr(self, name)}")
        for name in ("setup_s", "pause_s", "tail_s"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InvalidArgument(f"{name}: expected finite seconds from 0, got {getattr(self, name)}")
        # The order and the number of pulses are checked there.
        _ = self.presentation

    @property
    def presentation(self) -> Presentation:
        """The part of it that must be the same when a robot is driven."""
        return Presentation(self.order, self.pulses)

    def to_json(self) -> str:
        """As one line of JSON, the way it travels in a recording's provenance under `"protocol"`."""
        data = {each.name: getattr(self, each.name) for each in fields(self)}
        return json.dumps({**data, "pulse": self.pulse.to_list()})

    @staticmethod
    def from_json(text: str) -> Protocol:
        """From what `to_json` gave.

        Raises:
            InvalidArgument: for anything else.
        """
        try:
            data = json.loads(text)
            return Protocol(**{**data, "pulse": Pulse.from_list(data["pulse"])})
        except (ValueError, TypeError, KeyError) as error:
            raise InvalidArgument(f"protocol: expected what Protocol.to_json writes, got {text[:80]!r}") from error


PAPER = Protocol()
"""The paper's recording."""

CLOSED_LOOP = Protocol(order="mixed", pulses=5)
"""Recorded as a closed loop presents: frequencies mixed at random, five pulses a presentation, the last one read."""
