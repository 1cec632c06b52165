"""A goal: weighted objectives over a robot's quantities."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field

from animat.errors import InvalidArgument
from animat.goals.region import Region, number
from animat.records import Number, Whole, record
from animat.robots.base import LONGEST_EPISODE

Kind = Literal["avoid", "reach", "drive", "minimize", "maximize"]
KINDS: tuple[str, ...] = get_args(Kind)


@record
class Objective:
    """One thing to achieve or to avoid.

    Attributes:
        kind: `"avoid"`: entering the region ends an episode as failed. `"reach"`: entering it ends one as succeeded,
            the sooner the better. `"drive"`: get there and stay. `"minimize"`, `"maximize"`: push a quantity below or
            above a threshold, and further.
        region: the intersection of its parts.
        weight: relative to the other objectives; only the ratios of weights matter.
        within: for `"drive"`: more consecutive iterations outside than this, the start included, end an episode as
            failed; None: they do not.

    Raises:
        InvalidArgument: naming what was expected and what was given.
    """

    kind: Kind
    region: Region
    weight: Annotated[Number, Field(ge=1e-6, le=1e6)] = 1.0
    within: Annotated[Whole, Field(ge=1, le=LONGEST_EPISODE)] | None = None

    def __post_init__(self) -> None:
        if self.within is not None and self.kind != "drive":
            raise InvalidArgument(f"within: expected it for drive only, got it for {self.kind}")
        relation = {"minimize": "below", "maximize": "above"}.get(self.kind)
        if relation and [getattr(part, "relation", "around") for part in self.region] != [relation]:
            region = " and ".join(map(str, self.region))
            raise InvalidArgument(f"{self.kind}: expected one quantity {relation} a threshold, got {region}")

    def __str__(self) -> str:
        text = f"{self.kind} {' and '.join(map(str, self.region))}"
        text += "" if self.within is None else f" within {self.within}"
        return text if self.weight == 1 else f"{text} weight {number(self.weight)}"

    @property
    def can_fail(self) -> bool:
        """Whether it may end an episode as failed."""
        return self.kind == "avoid" or self.within is not None


@record
class Goal:
    """At least one objective; they all apply together."""

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=50)]

    def __str__(self) -> str:
        return "; ".join(map(str, self.objectives))
