"""What a policy's provenance may say, where anything reads it: how it was trained, and on which simulators.

The rest of it is for people and is kept as it is. JAX is not imported here: policies are loaded without it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from animat.errors import InvalidArgument
from animat.records import Flag, Number, Positive, Share, Whole, read_record

Count = Annotated[Whole, Field(ge=1, le=10**9)]


class Trained(TypedDict, total=False):
    """How it was trained; what is left out is not known."""

    shadowing: Flag | Literal["drawn"]
    duration_min: Positive | None
    chunks: Count
    percentiles: Literal["moving", "first"]
    delivery: Literal["chosen", "shuffled"]


class Simulated(TypedDict, total=False):
    """The simulators that it was trained on; what is left out is not known."""

    kind: Literal["histogram", "empirical", "memory"]
    bins: Count | None
    range_hz: Positive | None
    by: str | None
    burst_threshold: Share | None
    recorded_at_min: list[Number]


class Provenance(TypedDict, total=False):
    """All that is read of a provenance."""

    training: Trained | None
    simulators: Simulated | None


def expect_provenance(provenance: Any) -> None:
    """Refuse a provenance in which something that is read cannot be.

    Raises:
        InvalidArgument: naming it, what was expected and what came.
    """
    trained = read_record(Provenance, provenance, "provenance").get("training") or {}
    # From when on a simulator was the last one in training takes both.
    if trained.get("duration_min") is not None and "chunks" not in trained:
        raise InvalidArgument("provenance.training: expected chunks beside duration_min, got none")
