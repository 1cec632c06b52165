"""The entries of a policy's provenance that code reads, without JAX; the others are for people, and kept unchanged."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from animat.errors import InvalidArgument
from animat.recordings.recorded_culture import RecordedCulture
from animat.records import Flag, Number, Positive, Share, Whole, read_record

Count = Annotated[Whole, Field(ge=1, le=10**9)]


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


class Provenance(TypedDict, total=False):
    """The entries of a provenance that are read."""

    training: TrainingProvenance | None
    simulators: SimulatorProvenance | None
    culture: RecordedCulture | None


def expect_provenance(provenance: Any) -> None:
    """Refuse a provenance with an invalid entry among those that are read."""
    trained = read_record(Provenance, provenance, "provenance").get("training") or {}
    # `Policy.trained_until_min` needs both.
    if trained.get("duration_min") is not None and "chunks" not in trained:
        raise InvalidArgument("provenance.training: expected chunks with duration_min, got none")
