"""The number of electrodes that a trial of a condition pulses, on which the cost of stimulation depends."""

from __future__ import annotations

from collections.abc import Sequence

from animat.errors import UnusableData
from animat.responses.condition import RESTING, Condition


def electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...] | None:
    """The electrode pulses of a trial of each condition; None if the electrodes of all pulses are not known for some.

    For a condition on one of several sets it is their mean, as they are used equally often.
    """
    counts = []
    for each in conditions:
        if not each.electrodes or (each.only_last and pulses > 1):
            return None
        sets = [] if each.electrodes == RESTING else each.electrodes
        counts.append(pulses * sum(map(len, sets)) / len(each.electrodes))
    return tuple(counts)


def expect_electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...]:
    """The same where the cost is required; raises UnusableData if they are not known."""
    counts = electrode_pulses(conditions, pulses)
    if counts is None:
        raise UnusableData(
            "pulse_cost: expected conditions that state the electrodes of all their pulses, got "
            f"{', '.join(condition.label for condition in conditions)}; record places of several sizes, or leave the "
            "cost out"
        )
    return counts
