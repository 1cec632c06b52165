"""What is wanted of a robot: objectives over its quantities, weighted."""

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
    """One thing that is wanted, or not.

    Attributes:
        kind: `"avoid"`: entering the region ends an episode as failed. `"reach"`: entering it ends one as succeeded,
            the sooner the better. `"drive"`: get there and stay. `"minimize"`, `"maximize"`: push a quantity below or
            above a threshold, and on.
        region: where: all of its parts at once.
        weight: beside the other objectives; only the ratios of weights matter.
        within: of `"drive"`: with more than so many iterations outside in a row, the start included, an episode ends as
            failed; None: it does not.

    Raises:
        InvalidArgument: naming what was expected and what came.
    """

    kind: Kind
    region: Region
    weight: Annotated[Number, Field(ge=1e-6, le=1e6)] = 1.0
    within: Annotated[Whole, Field(ge=1, le=LONGEST_EPISODE)] | None = None

    def __post_init__(self) -> None:
        if self.within is not None and self.kind != "drive":
            raise InvalidArgument(f"within: expected it of drive only, got it of {self.kind}")
        relation = {"minimize": "below", "maximize": "above"}.get(self.kind)
        if relation and [getattr(part, "relation", "around") for part in self.region] != [relation]:
            told = " and ".join(map(str, self.region))
            raise InvalidArgument(f"{self.kind}: expected one quantity {relation} a threshold, got {told}")

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
    """Objectives that hold together.

    Attributes:
        objectives: at least one.
    """

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=50)]

    def __str__(self) -> str:
        return "; ".join(map(str, self.objectives))
