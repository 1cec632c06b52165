"""Callbacks that follow a training: functions called with each row of the learning curves as it is produced."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class CurveRow:
    """A row of a policy's learning curve, as in the policy's file: one chunk of the training.

    Attributes:
        policy: name of the policy, such as `p0`.
        iterations: iterations done at the end of the chunk.
        episodes: number of episodes that ended in the chunk.
        mean_return: their mean return; NaN if none ended.
        entropy: entropy of the actions at the end of the chunk, nats, over transitions drawn from the replay.
        alpha: weight of the entropy bonus at that time.
        critic_loss: critics' loss at that time, over the same transitions. Older files lack these three: NaN.
    """

    policy: str
    iterations: int
    episodes: int
    mean_return: float
    entropy: float
    alpha: float
    critic_loss: float


class TrainingCallback(Protocol):
    """A function that `train` calls with each row of each policy, in order, including those from before a continuation.

    It is called in the process that called `train`, and changes nothing that is learned. An exception that it raises
    ends the training, as Ctrl-C does; call `train` again to continue.
    """

    def __call__(self, row: CurveRow) -> None:
        """Process a row."""
