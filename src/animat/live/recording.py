"""Recording a culture within a stimulation budget."""

from __future__ import annotations

from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.progress import Progress
from animat.recordings.protocol import Protocol
from animat.recordings.recording import Recording


def record_within(
    account: Account, culture: Culture, protocol: Protocol, seed: int, progress: Progress | None = None
) -> Recording:
    """Record by a protocol if the budget holds all of it.

    Of a recording that fails half way, what was handed to the culture until then is spent.

    Raises:
        BudgetSpent: if it does not; nothing is delivered then.
        UnsafeStimulus, InvalidArgument: as `Culture.record` does.
    """
    schedule = culture.schedule(protocol, seed)
    stimuli = [stimulus for block in schedule.blocks for stimulus in schedule.deliveries(block)]
    account.check(stimuli)
    before = culture.delivered
    try:
        return culture.record(protocol, seed, progress)
    finally:
        account.spend(stimuli[: culture.delivered - before])
