"""From the actions of a policy to the protocol that records them, for a culture whose recordings are not at hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from animat.coding.encoder import Encoder
from animat.errors import InvalidArgument
from animat.stimulation.protocol import CLOSED_LOOP, PAPER, Order, Protocol
from animat.stimulation.pulse import Pulse
from animat.tables import UNKNOWN

MOST_PATTERNS = 100
"""Of a culture's patterns, as many as are used where conditions name no electrodes (the paper)."""


def protocol_of(encoder: Encoder, order: Order, patterns: Int64[np.ndarray, "patterns size"], pulse: Pulse) -> Protocol:
    """The protocol that presents every condition of an encoder as often as `animat record` does by default.

    Args:
        encoder: what the actions are.
        order: of the presentations.
        patterns: electrodes of each of the culture's patterns, padded with -1.
        pulse: what each electrode delivers.

    Raises:
        InvalidArgument: for conditions that no protocol presents to this culture: electrodes that are none of its
            patterns, or several pulses on the same ones.
    """
    usual = PAPER if order == "blocked" else CLOSED_LOOP
    each, used = usual.presentations, min(MOST_PATTERNS, len(patterns))
    if encoder.electrodes:
        number_of = {frozenset(row) - {UNKNOWN}: number for number, row in enumerate(patterns.tolist())}
        for condition in encoder.conditions:
            sets = condition.electrodes or ()
            strange = next((one for one in sets if frozenset(one) not in number_of), None)
            if strange is not None or (encoder.pulses > 1 and not condition.only_last):
                what = f"the electrodes {'+'.join(map(str, strange))}" if strange else "several pulses on one pattern"
                raise InvalidArgument(
                    f"condition {condition.label}: expected one of the culture's patterns, to record it first, got "
                    f"{what}: give the recordings that the policies were trained on (--recordings)"
                )
        used = 1 + max(number_of[frozenset(one)] for c in encoder.conditions for one in c.electrodes or ())
        # Presentations are counted by frequency, and shared by its patterns.
        each *= used
    return replace(
        usual,
        frequencies_hz=tuple(dict.fromkeys(f for c in encoder.conditions for f in c.frequencies_hz)),
        pulses=encoder.pulses,
        patterns=used,
        presentations=each,
        pulse=pulse,
    )
