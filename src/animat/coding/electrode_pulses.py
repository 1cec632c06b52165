"""How many electrodes a trial of a condition pulses: what a cost of stimulation counts."""

from __future__ import annotations

from collections.abc import Sequence

from animat.errors import UnusableData
from animat.responses.condition import RESTING, Condition


def electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...] | None:
    """The electrode pulses of a trial of each condition: one for each electrode of each pulse.

    Where a condition is on one of several sets, their mean, as they are dealt equally often.

    Args:
        conditions: as recorded.
        pulses: of a trial.

    Returns:
        One number for each condition; None where some condition does not say the electrodes of all its pulses.
    """
    found = []
    for each in conditions:
        if not each.electrodes or (each.only_last and pulses > 1):
            return None
        sets = [] if each.electrodes == RESTING else each.electrodes
        found.append(pulses * sum(map(len, sets)) / len(each.electrodes))
    return tuple(found)


def expect_electrode_pulses(conditions: Sequence[Condition], pulses: int) -> tuple[float, ...]:
    """The same, for a cost that is asked for.

    Raises:
        UnusableData: where they are not known.
    """
    found = electrode_pulses(conditions, pulses)
    if found is None:
        raise UnusableData(
            "pulse_cost: expected conditions that say the electrodes of all their pulses, got "
            f"{', '.join(condition.label for condition in conditions)}; record places of several sizes, or leave the "
            "cost out"
        )
    return found
