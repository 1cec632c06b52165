"""From the actions of a policy to the protocol that records them, for a culture whose recordings are not at hand."""

from __future__ import annotations

import itertools
from dataclasses import replace

from animat.coding.encoder import Encoder
from animat.errors import InvalidArgument
from animat.responses.condition import RESTING
from animat.stimulation.places import NONE
from animat.stimulation.protocol import CLOSED_LOOP, PAPER, Order, Protocol
from animat.stimulation.pulse import Pulse

MOST_PATTERNS = 100
"""Of a culture's patterns, as many as are used where conditions name no electrodes (the paper)."""


def protocol_of(encoder: Encoder, order: Order, n_patterns: int, pulse: Pulse) -> Protocol:
    """The protocol that presents every condition of an encoder as often as `animat record` does by default.

    Args:
        encoder: what the actions are.
        order: of the presentations.
        n_patterns: how many the culture has.
        pulse: what each electrode delivers.

    Raises:
        InvalidArgument: for conditions that no protocol presents: on some electrodes and on any, on different ones in
            one presentation, or not on all electrodes at all frequencies.
    """
    conditions = encoder.conditions
    frequencies_hz = tuple(dict.fromkeys(hz for condition in conditions for hz in condition.frequencies_hz))
    places = tuple(dict.fromkeys(one for condition in conditions for one in condition.electrodes or ()))
    if places:
        presented = {each for c in conditions for each in itertools.product(c.frequencies_hz, c.electrodes or ())}
        is_whole = len(presented) == len(frequencies_hz) * len(places)
        if not is_whole or encoder.takes_patterns:
            raise InvalidArgument(
                f"conditions: expected every one on electrodes of its own, each at the same frequencies, for a culture "
                f"to be recorded first, got {', '.join(condition.label for condition in conditions)}: give the "
                "recordings that the policies were trained on (--recordings)"
            )
    return replace(
        PAPER if order == "blocked" else CLOSED_LOOP,
        frequencies_hz=frequencies_hz,
        pulses=encoder.pulses,
        patterns=min(MOST_PATTERNS, n_patterns),
        places=tuple(NONE if (place,) == RESTING else place for place in places),
        pulse=pulse,
    )
