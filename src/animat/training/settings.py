"""What describes a training, without JAX: the algorithm's settings, limits, and what code reads of a provenance."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator
from typing_extensions import TypedDict

from animat.errors import InvalidArgument, shown
from animat.recordings.recorded_culture import RecordedCulture
from animat.records import Flag, Number, Positive, Share, Whole, read_record, record

LEARNER = 2
"""Revision of the learner, raised with every change that changes trained policies. 2: exploration."""
MOST_POLICIES = 1_000
Policies = Annotated[Whole, Field(ge=1, le=MOST_POLICIES)]
PulseCost = Annotated[Number, Field(ge=0, le=1e6)]
"""Cost of an electrode pulse, in the units of the reward."""
Count = Annotated[Whole, Field(ge=1, le=10**9)]
FORMER = {
    "updates": "gradient_steps",
    "follow": "tau",
    "averaging": "averaging_exponent",
    "first_alpha": "initial_alpha",
    "entropy_share": "target_entropy_ratio",
}
"""Names of settings in older files, and their current names."""


def _expect_shadowing(value: Any) -> Any:
    # Not as a union type, whose error message would name only one of its members.
    value = bool(value) if isinstance(value, np.bool_) else value
    if not isinstance(value, bool) and value != "drawn":
        raise ValueError(f"expected True, False or 'drawn', got {shown(value)}")
    return value


Shadowing = Annotated[bool | Literal["drawn"], PlainValidator(_expect_shadowing)]


@record
class SAC:
    """The algorithm's settings; all of them static under jit.

    Attributes:
        environments: episodes that one policy runs in parallel.
        gradient_steps: per iteration of all environments; gradient_steps / environments is the replay ratio.
        batch: transitions per gradient step.
        replay: number of transitions stored, a multiple of environments; the oldest are overwritten first.
        hidden: width of each of the two hidden layers of actor and critics.
        learning_rate: Adam's learning rate, for actor, critics and alpha.
        discount: gamma.
        tau: fraction by which the target critics move towards the critics at each gradient step.
        reward_scale: factor applied to rewards inside the learner only.
        averaging_exponent: of polynomial-decay averaging, over about the last 1 / (averaging_exponent + 1) of training.
        initial_alpha: weight of the entropy bonus at the start.
        target_entropy_ratio: target entropy of discrete actions, as a share of the largest possible, log(actions).
        entropy_nats: target entropy of a continuous action, per command.

    Raises:
        InvalidArgument: for a number outside its range.
    """

    # At these limits a group of five policies takes some gigabytes.
    environments: Annotated[Whole, Field(ge=1, le=65_536)] = 32
    gradient_steps: Annotated[Whole, Field(ge=1, le=1_024)] = 4
    batch: Annotated[Whole, Field(ge=1, le=16_384)] = 64
    # Indices are drawn from float32 uniforms, which have 23 bits.
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
            n = self.environments
            raise InvalidArgument(f"replay: expected a multiple of environments ({n}), got {self.replay}")


class TrainingProvenance(TypedDict, total=False):
    """How the policy was trained; missing entries are unknown."""

    shadowing: Flag | Literal["drawn"]
    duration_min: Positive | None
    chunks: Count
    percentiles: Literal["moving", "first"]
    delivery: Literal["chosen", "shuffled"]


class SimulatorProvenance(TypedDict, total=False):
    """The simulators it was trained on; missing entries are unknown."""

    kind: Literal["histogram", "empirical", "memory"]
    bins: Count | None
    range_hz: Positive | None
    by: str | None
    burst_threshold: Share | None
    recorded_at_min: list[Number]


class SwapProvenance(TypedDict):
    """A simulator that live training went on with, of the recording at that minute."""

    recorded_at_min: Number


class Provenance(TypedDict, total=False):
    """The entries of a policy's provenance that code reads; the others are for people, and kept unchanged."""

    training: TrainingProvenance | None
    swaps: list[SwapProvenance] | None
    simulators: SimulatorProvenance | None
    culture: RecordedCulture | None


def check_provenance(provenance: Any) -> None:
    """Refuse a provenance with an invalid entry among those that are read."""
    trained = read_record(Provenance, provenance, "provenance").get("training") or {}
    # `Policy.trained_until_min` needs both.
    if trained.get("duration_min") is not None and "chunks" not in trained:
        raise InvalidArgument("provenance.training: expected chunks with duration_min, got none")
