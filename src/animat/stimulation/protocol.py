"""How stimuli are presented, which must be the same when recording a culture and when driving a robot with it."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, SkipValidation

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, in_file
from animat.plain_file import read_plain_text
from animat.records import Number, Whole, json_data, record
from animat.stimulation.frequency import distinct
from animat.stimulation.places import NONE, Places, check_places, count_places
from animat.stimulation.pulse import PUBLISHED_PULSE, Pulse

Order = Literal["blocked", "mixed"]

_MOST_PULSES = 10_000_000
_LONGEST_RECORDING_S = 7 * 86_400
_MOST_BYTES = 2**20

Count = Annotated[Whole, Field(ge=1, le=1_000_000)]
Pulses = Annotated[Whole, Field(ge=1, le=_MOST_PULSES)]
Seconds = Annotated[Number, Field(ge=0, le=86_400)]
Tail = Annotated[Number, Field(ge=50e-6, le=86_400)]
"""A delivery ends after the time of its last stimulus, by a step of the grid of times or more."""
Frequency = Annotated[Number, Field(gt=0, le=10_000)]


@record
class Presentation:
    """The order of the stimulus frequencies and the pulses per trial, kept with the data.

    A culture has memory: it responds differently to 80 Hz in a block of 80 Hz than between other frequencies. So a
    simulator, and a policy trained on it, is valid only for the presentation it was recorded with.

    Attributes:
        order: `"blocked"`, all stimuli of a frequency together (the paper), or `"mixed"`, a frequency drawn at random
            for each trial (as a closed loop presents them).
        pulses: pulses 1/f apart in one trial; the response is read after the last one (the paper: 1).

    Raises:
        InvalidArgument: for an unknown order, or fewer than one pulse.
    """

    order: Order
    pulses: Pulses = 1

    def __str__(self) -> str:
        return f"{self.order}, {self.pulses} pulse{'' if self.pulses == 1 else 's'} per trial"


@record
class Protocol:
    """What is done in one recording; with patterns and a seed it becomes a `Schedule` (`animat.stimulation.schedule`).

    Every pulse comes 1/f after the previous one, f being the frequency of its own trial, and the response is read
    after the last pulse of a trial. The defaults are the paper's: five frequencies as blocks in random order, each of
    100 patterns once at each frequency, one pulse per trial.

    Attributes:
        frequencies_hz: the conditions, each once.
        order: `"blocked"` or `"mixed"`: the conditions' trials shuffled together, as in a closed loop.
        pulses: per trial, with different patterns where there are enough.
        patterns: use this many of the culture's patterns, the first ones; 1 repeats one pattern.
        trials: at each frequency; each pattern is read equally often, in random order.
        places: groups of electrodes, `"corners"`, `"halves"` or `"quadrants"` (`animat.stimulation.places`), instead
            of patterns: each place at each frequency is then a condition, presented equally often, with all pulses on
            the whole group. One of the groups may be `"none"`: its trials deliver nothing.
        setup_s: set-up time before each block (mixed: before the only block). It is not recorded, and the recording's
            clock leaves it out.
        pause_s: recorded without stimuli before each block.
        tail_s: recorded after the last pulse of each block; at least 50 us.
        pulse: what every electrode delivers.

    Raises:
        InvalidArgument: naming the attribute, what was expected and what came.

    Source: the paper's methods; 38.75 s of stimulation in about 120 s with set-up.
    """

    frequencies_hz: Annotated[tuple[Frequency, ...], Field(min_length=1)] = (5.0, 10.0, 20.0, 40.0, 80.0)
    order: Order = "blocked"
    pulses: Pulses = 1
    patterns: Count = 100
    trials: Count = 100
    places: Annotated[Places, SkipValidation] = ()
    setup_s: Seconds = 14.0
    pause_s: Seconds = 2.0
    tail_s: Tail = 0.1
    pulse: Annotated[Pulse, BeforeValidator(Pulse.from_list)] = PUBLISHED_PULSE

    def __post_init__(self) -> None:
        # Frequencies that differ only by rounding are one condition.
        if len(distinct(np.array(self.frequencies_hz))) < len(self.frequencies_hz):
            listed = ", ".join(f"{hz:.10g}" for hz in self.frequencies_hz)
            raise InvalidArgument(f"frequencies_hz: expected each once, got {listed}")
        object.__setattr__(self, "places", check_places(self.places))
        if not self.is_rest and max(self.frequencies_hz) * self.pulse.duration_us > 1e6:
            lasts_us, fastest_hz = self.pulse.duration_us, max(self.frequencies_hz)
            expected = f"at most {1e6 / lasts_us:.4g} Hz, as a pulse lasts {lasts_us:g} us"
            raise InvalidArgument(f"frequencies_hz: expected {expected}, got {fastest_hz:g} Hz")
        of_each = self.trials * self.pulses * max(1, self.n_places)
        pulses = len(self.frequencies_hz) * of_each
        if pulses > _MOST_PULSES:
            what = f"at most {_MOST_PULSES:,} in a recording (frequencies x places x trials x pulses)"
            raise InvalidArgument(f"pulses: expected {what}, got {pulses:,}")
        stimulated_s = sum(of_each / f for f in self.frequencies_hz)
        if stimulated_s > _LONGEST_RECORDING_S:
            expected = f"stimuli of at most a week ({_LONGEST_RECORDING_S:,} s) in a recording"
            raise InvalidArgument(f"frequencies_hz: expected {expected}, got {stimulated_s:.3g} s")

    @property
    def presentation(self) -> Presentation:
        """The part of the protocol that must be the same when a robot is driven."""
        return Presentation(self.order, self.pulses)

    @property
    def n_places(self) -> int:
        """How many places there are; 0 if the culture's patterns are used."""
        return count_places(self.places)

    @property
    def is_rest(self) -> bool:
        """Whether it delivers nothing at all: its only place is `"none"`."""
        return self.places == (NONE,)

    def to_json(self) -> str:
        """As one line of JSON, as stored under `"protocol"` in a recording's file."""
        data = vars(self) | {"pulse": self.pulse.to_list()}
        if not self.places:
            # A series compares protocols by their text, and older ones have no places.
            del data["places"]
        return json.dumps(data)

    @staticmethod
    def from_json(text: str, defaults: Protocol | None = None) -> Protocol:
        """From the output of `to_json`; raises InvalidArgument for anything else, naming the key.

        `defaults` are for keys that are left out; None: the defaults above, except that the pulse is required.
        """
        data = json_data(text, "protocol")
        if not isinstance(data, dict) or (defaults is None and "pulse" not in data):
            needed = ', such as {"frequencies_hz": [5, 10]}' if defaults else ", with a pulse"
            raise InvalidArgument(f"protocol: expected what Protocol.to_json writes{needed}, got {text.strip()[:80]!r}")
        if "presentations" in data and "trials" not in data:
            # Older files have this name.
            data["trials"] = data.pop("presentations")
        return replace(defaults or PAPER, **data)


@checked_arguments
def read_protocol(path: str | os.PathLike[str], defaults: Protocol | None = None) -> Protocol:
    """Read a protocol from a JSON file, as `Protocol.to_json` writes it; keys left out take the `defaults`.

    Raises InvalidFile for anything else, naming the key.
    """
    with in_file(path):
        return Protocol.from_json(read_plain_text(path, _MOST_BYTES), defaults or PAPER)


PAPER = Protocol()
"""The paper's recording."""

CLOSED_LOOP = Protocol(order="mixed", trials=1000)
"""What a closed loop needs: frequencies mixed at random, one pulse per trial, and enough trials of each for a simulator
with memory to find responses with a similar history."""

TWO_COMMANDS = replace(CLOSED_LOOP, places="corners", frequencies_hz=(20.0,))
"""What a closed loop with two commands needs: stimuli that differ only in place. A culture is then stimulated equally
often whatever is chosen; with several frequencies a policy always takes the fastest, which no recording has shown."""
