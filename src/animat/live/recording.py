"""Recording a culture within a stimulation budget."""

from __future__ import annotations

import math
from collections.abc import Callable

from animat.cultures.base import Culture
from animat.cultures.budget import Account
from animat.errors import AnimatError
from animat.progress import Progress, Silent
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Protocol


def record_within(
    account: Account,
    culture: Culture,
    protocol: Protocol,
    seed: int,
    progress: Progress | None = None,
    follow: Callable[[Callable[[], Recording]], None] | None = None,
) -> Recording:
    """Record by a protocol if the budget holds all of it.

    Of a recording that fails half way, what it handed to the culture until then is spent, and nothing that others did.
    Other arguments are those of `Culture.record`.

    Raises:
        BudgetSpent: if it does not; nothing is delivered then.
        UnsafeStimulus, InvalidArgument: as `Culture.record` does.
    """
    schedule = culture.schedule(protocol, seed)
    by_block = [schedule.deliveries(block) for block in schedule.blocks]
    account.check([stimulus for stimuli in by_block for stimulus in stimuli])
    blocks = _Blocks(progress or Silent())
    try:
        return culture.record(protocol, seed, blocks, follow)
    except BaseException as error:
        # Of the block under way only an error of the culture tells that it was refused; not if some of it was over.
        if not blocks.is_within_one:
            blocks.handed_over += not isinstance(error, AnimatError) or error.is_admitted
        raise
    finally:
        account.spend([stimulus for stimuli in by_block[: blocks.handed_over] for stimulus in stimuli])


class _Blocks:
    """Counts the blocks of this recording alone that began: the culture's own count has those of every thread."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self.handed_over, self.is_within_one = progress, 0, False

    def update(self, done: float, total: float, note: str = "") -> None:
        self.handed_over = math.ceil(done)
        self.is_within_one = done != self.handed_over
        self._progress.update(done, total, note)
