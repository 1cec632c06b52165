"""What a training may be told: the settings of its algorithm, and how much at most. JAX is not imported here."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import Number, Positive, Share, Whole, record

LEARNER = 2
"""Revision of the learner, raised with every change after which a training gives other policies. 2: exploration."""
MOST_POLICIES = 1_000
MOST_ITERATIONS = 2_000_000_000
"""Iterations are counted in 32 bits, with room for a last round of all environments."""
PulseCost = Annotated[Number, Field(ge=0, le=1e6)]
"""What an electrode pulse costs, in the units of a reward."""
FORMER = {
    "updates": "gradient_steps",
    "follow": "tau",
    "averaging": "averaging_exponent",
    "first_alpha": "initial_alpha",
    "entropy_share": "target_entropy_ratio",
}
"""What files of before call settings."""


@record
class SAC:
    """The algorithm's settings; all of them static under jit.

    Attributes:
        environments: episodes run side by side by one policy.
        gradient_steps: after each step of all of them; gradient_steps / environments is the replay ratio.
        batch: transitions in one gradient step.
        replay: transitions remembered; the oldest are forgotten first.
        hidden: width of each of the two hidden layers of actor and critics.
        learning_rate: of Adam, for actor, critics and alpha.
        discount: gamma.
        tau: share of the critics that the target critics take over at each gradient step.
        reward_scale: rewards are multiplied by it inside the learner only.
        averaging_exponent: of polynomial-decay averaging; the deployed actor is an average over about the last
            1 / (averaging_exponent + 1) of its training so far.
        initial_alpha: weight of the entropy bonus at the start.
        target_entropy_ratio: the entropy that discrete actions keep, as a share of the largest possible, log(actions).
        entropy_nats: the entropy that a continuous action keeps, for each of its commands.

    Raises:
        InvalidArgument: for a count below 1 or beyond what fits, a rate or a share outside what it may be, or a replay
            that is no multiple of the environments.
    """

    # With the most of each, a group of five policies takes some gigabytes.
    environments: Annotated[Whole, Field(ge=1, le=65_536)] = 32
    gradient_steps: Annotated[Whole, Field(ge=1, le=1_024)] = 4
    batch: Annotated[Whole, Field(ge=1, le=16_384)] = 64
    # As float32 numbers no more.
    replay: Annotated[Whole, Field(ge=1, le=2**23)] = 131_072
    hidden: Annotated[Whole, Field(ge=1, le=1_024)] = 64
    learning_rate: Positive = 1e-3
    discount: Share = 0.99
    tau: Share = 0.005
    reward_scale: Positive = 0.1
    averaging_exponent: Annotated[Whole, Field(ge=1, le=1_000_000)] = 3
    initial_alpha: Positive = 0.1
    target_entropy_ratio: Share = 0.1
    entropy_nats: Number = -1.0

    def __post_init__(self) -> None:
        if self.replay % self.environments:
            raise InvalidArgument(
                f"replay: expected a multiple of environments ({self.environments}), got {self.replay}"
            )
