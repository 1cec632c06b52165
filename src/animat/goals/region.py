"""Regions of a robot's quantities, and how far within them a robot is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from typing import Annotated, ClassVar

from jaxtyping import Bool, Float
from pydantic import Field

from animat.errors import InvalidArgument, did_you_mean
from animat.lazy import Array, jnp
from animat.records import Flag, Number, Positive, record
from animat.robots.base import Quantity

Name = Annotated[str, Field(min_length=1)]

_IN_BASE_UNITS = {("deg", "rad"): math.pi / 180, ("rad", "deg"): 180 / math.pi, ("cm", "m"): 0.01, ("mm", "m"): 0.001}
"""How many of the second unit one of the first is."""


@record
class Range:
    """Values of one quantity: between two ends, beyond one, or outside of both.

    Between `low` and `high` the ends belong to it; beyond one end, or outside, they do not.

    Attributes:
        quantity: its name, as a robot observes it.
        low, high: its ends; None: there is none.
        unit: of the ends; empty for a quantity without.
        outside: whether it is all that lies outside of the two ends.

    Raises:
        InvalidArgument: for no ends, or ends between which nothing lies.
    """

    quantity: Name
    low: Number | None = None
    high: Number | None = None
    unit: str = ""
    outside: Flag = False

    def __post_init__(self) -> None:
        both = self.low is not None and self.high is not None
        if (self.low is None and self.high is None) or (self.outside and not both):
            raise InvalidArgument(f"{self.quantity}: expected {'both ends' if self.outside else 'an end'}, got none")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise InvalidArgument(
                f"{self.quantity}: expected the lower end first, got {number(self.low)}..{number(self.high)}, "
                "between which nothing lies"
            )

    def __str__(self) -> str:
        ends = "..".join(number(end) for end in (self.low, self.high) if end is not None)
        return f"{self.quantity} {self.relation} {ends}" + (f" {self.unit}" if self.unit else "")

    @property
    def relation(self) -> str:
        """How its ends bound it, in a word."""
        if self.low is None or self.high is None:
            return "below" if self.low is None else "above"
        return "outside" if self.outside else "in"

    @property
    def has_its_edge(self) -> bool:
        """Whether its ends belong to it."""
        return self.relation == "in"

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Of what lies in it; of what is outside of two ends there are none."""
        ends = (-math.inf if self.low is None else self.low, math.inf if self.high is None else self.high)
        return {} if self.outside else {self.quantity: ends}

    def in_units(self, spec: Mapping[str, Quantity]) -> Range:
        """The same in the units of a robot.

        Raises:
            InvalidArgument: for a quantity that there is none of, or a unit that is none of it.
        """
        factor = _factor(self.unit, _known(self.quantity, spec))
        low, high = (None if end is None else end * factor for end in (self.low, self.high))
        return Range(self.quantity, low, high, spec[self.quantity].unit, self.outside)

    def margin(self, seen: Mapping[str, Array], spec: Mapping[str, Quantity]) -> Float[Array, ""]:
        """How far within it a robot is, in scales of the quantity; below 0 where it is not in it.

        Args:
            seen: the quantities by name, in the units of `spec`, as the region is (`in_units`).
        """
        value = seen[self.quantity]
        within = [value - self.low] if self.low is not None else []
        within += [self.high - value] if self.high is not None else []
        nearest = reduce(jnp.minimum, within) / spec[self.quantity].scale
        return -nearest if self.outside else nearest


@record
class Ball:
    """Values of several quantities of one unit that are near others: a disc, a ball; its edge belongs to it.

    Attributes:
        quantities: their names, as a robot observes them.
        centre: a number for each.
        radius: how far from the centre it reaches.
        unit: of centre and radius; empty for quantities without.
    """

    quantities: Annotated[tuple[Name, ...], Field(min_length=1)]
    centre: tuple[Number, ...]
    radius: Positive
    unit: str = ""

    def __post_init__(self) -> None:
        if len(self.centre) != len(self.quantities):
            raise InvalidArgument(
                f"{', '.join(self.quantities)}: expected a centre of {len(self.quantities)} numbers, got "
                f"{len(self.centre)}"
            )

    def __str__(self) -> str:
        centre = ", ".join(map(number, self.centre))
        unit = f" {self.unit}" if self.unit else ""
        return f"{', '.join(self.quantities)} around {centre} radius {number(self.radius)}{unit}"

    has_its_edge: ClassVar[bool] = True

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Of what lies in it."""
        ends = ((at - self.radius, at + self.radius) for at in self.centre)
        return dict(zip(self.quantities, ends, strict=True))

    def in_units(self, spec: Mapping[str, Quantity]) -> Ball:
        """As `Range.in_units`; the quantities must be of one unit."""
        known = [_known(name, spec) for name in self.quantities]
        for each in known[1:]:
            if each.unit != known[0].unit:
                raise InvalidArgument(
                    f"{each.name}: expected a quantity in {known[0].unit}, as {known[0].name} is, got {each.unit}"
                )
        factor = _factor(self.unit, known[0])
        return Ball(self.quantities, tuple(factor * at for at in self.centre), factor * self.radius, known[0].unit)

    def margin(self, seen: Mapping[str, Array], spec: Mapping[str, Quantity]) -> Float[Array, ""]:
        """As `Range.margin`, in the largest of the scales."""
        apart = [(seen[name] - at) ** 2 for name, at in zip(self.quantities, self.centre, strict=True)]
        scale = max(spec[name].scale for name in self.quantities)
        return (self.radius - jnp.sqrt(sum(apart[1:], apart[0]))) / scale


Region = Annotated[tuple[Range | Ball, ...], Field(min_length=1)]
"""All of its parts at once: ranges of several quantities are a box."""


def margin_of(
    region: tuple[Range | Ball, ...], seen: Mapping[str, Array], spec: Mapping[str, Quantity]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """How far within a region a robot is: the least of its parts' margins, in [-1, 1]; and whether it is in it."""
    margins = [part.margin(seen, spec) for part in region]
    inside = [m >= 0 if part.has_its_edge else m > 0 for part, m in zip(region, margins, strict=True)]
    return jnp.clip(reduce(jnp.minimum, margins), -1.0, 1.0), reduce(jnp.logical_and, inside)


def region_in_units(region: tuple[Range | Ball, ...], spec: Mapping[str, Quantity]) -> tuple[Range | Ball, ...]:
    """A region in the units of a robot.

    Raises:
        InvalidArgument: as `Range.in_units`, and for parts that have nothing in common.
    """
    parts = tuple(part.in_units(spec) for part in region)
    left: dict[str, tuple[float, float]] = {}
    for part in parts:
        for name, (low, high) in part.bounds().items():
            before = left.get(name, (-math.inf, math.inf))
            left[name] = low, high = max(low, before[0]), min(high, before[1])
            if not low < high:
                raise InvalidArgument(f"{name}: expected parts that have something in common, got an empty region")
    for part in parts:
        if isinstance(part, Range) and part.outside:
            low, high = left.get(part.quantity, (-math.inf, math.inf))
            if part.low is not None and part.high is not None and part.low <= low and high <= part.high:
                raise InvalidArgument(
                    f"{part.quantity}: expected parts that have something in common, got an empty region"
                )
    return parts


def number(value: float) -> str:
    """As short as can be, and the same number when it is read."""
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def _known(name: str, spec: Mapping[str, Quantity]) -> Quantity:
    if name not in spec:
        raise InvalidArgument(f"expected a quantity among {', '.join(spec)}, got {name!r}{did_you_mean(name, spec)}")
    return spec[name]


def _factor(unit: str, quantity: Quantity) -> float:
    """How many of a quantity's unit one of this unit is."""
    wanted = "" if quantity.unit == "1" else quantity.unit
    if unit == wanted:
        return 1.0
    (given, _, per), (own, _, own_per) = unit.partition("/"), wanted.partition("/")
    if per == own_per and (given, own) in _IN_BASE_UNITS:
        return _IN_BASE_UNITS[given, own]
    also = [f"{other}/{per}" if own_per else other for other, base in _IN_BASE_UNITS if base == own]
    expected = " or ".join([wanted, *also]) if wanted else "no unit"
    raise InvalidArgument(f"{quantity.name}: expected {expected}, got {unit or 'no unit'}")
