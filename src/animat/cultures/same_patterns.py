"""Whether a culture is stimulated through the patterns that it was recorded with."""

from __future__ import annotations

from jaxtyping import Int64
from numpy import ndarray

from animat.cultures.base import Culture
from animat.recordings.findings import Finding
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN


def other_patterns(recording: Recording, culture: Culture) -> Finding | None:
    """What there is to say of patterns of a recording that the culture does not have; None if it has all of them.

    A policy was trained on responses to those patterns; through other electrodes the same culture answers otherwise.

    Args:
        recording: of the culture.
        culture: open.
    """
    recorded, there = _sets(recording.stimuli.electrodes), _sets(culture.patterns)
    strange = recorded - there - {frozenset()}
    if not strange:
        return None
    return Finding(
        "other-patterns",
        "warning",
        f"{len(strange)} of the {len(recorded)} sets of electrodes that were stimulated in the recordings are no "
        "pattern of this culture: through other electrodes it answers otherwise (a CL1's patterns are drawn by "
        "--culture-seed, a MaxOne's are those of --selection)",
        float(len(strange)),
    )


def _sets(electrodes: Int64[ndarray, "patterns size"]) -> set[frozenset[int]]:
    return {frozenset(row) - {UNKNOWN} for row in electrodes.tolist()}
