"""What follows a training while it goes on: a function that is called with the learning curve's rows as they come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class CurveRow:
    """A row of a policy's learning curve, as it will be in its file: one part of the training.

    Attributes:
        policy: its name, such as `p0`.
        iterations: done at the end of the part.
        episodes: that ended in the part.
        mean_return: of these; NaN for none.
        entropy: of its actions at the end of the part, nats, over transitions drawn from its replay.
        alpha: the weight of the entropy bonus then.
        critic_loss: then, over the same transitions. These three are NaN where no file has them, as of policies that
            were trained before they were kept.
    """

    policy: str
    iterations: int
    episodes: int
    mean_return: float
    entropy: float
    alpha: float
    critic_loss: float


class TrainingCallback(Protocol):
    """What `train` calls with each row, in the process that called it.

    The rows of a policy come in their order, each once a call of `train`, those from before it was gone on with too.
    Nothing that a callback does changes what is learned. What it raises ends the training, as Ctrl-C does: called
    again, it goes on.
    """

    def __call__(self, row: CurveRow) -> None:
        """Take in a row."""
