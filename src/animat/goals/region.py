"""Regions of a robot's quantities, and how far inside them a robot is."""

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

_FACTORS = {("deg", "rad"): math.pi / 180, ("rad", "deg"): 180 / math.pi, ("cm", "m"): 0.01, ("mm", "m"): 0.001}
"""Factors from the first unit to the second."""


@record
class Range:
    """Values of one quantity: between two ends, beyond one, or outside both.

    The range between `low` and `high` includes its ends; a range beyond one end, or outside, does not.

    Attributes:
        low, high: its ends; None: there is none.
        unit: of the ends; empty for a quantity without a unit.
        outside: whether it is the range outside the two ends.
    """

    quantity: Name
    low: Number | None = None
    high: Number | None = None
    unit: str = ""
    outside: Flag = False

    def __post_init__(self) -> None:
        ends = [end for end in (self.low, self.high) if end is not None]
        if len(ends) < 1 + self.outside:
            raise InvalidArgument(f"{self.quantity}: expected {'both ends' if self.outside else 'an end'}, got none")
        if len(ends) == 2 and not ends[0] < ends[1]:
            given = "..".join(map(number, ends))
            raise InvalidArgument(f"{self.quantity}: expected the lower end first, got {given}, with nothing between")

    def __str__(self) -> str:
        ends = "..".join(number(end) for end in (self.low, self.high) if end is not None)
        return f"{self.quantity} {self.relation} {ends}" + (f" {self.unit}" if self.unit else "")

    @property
    def relation(self) -> str:
        """How its ends bound it: below, above, outside or in."""
        if self.low is None or self.high is None:
            return "below" if self.low is None else "above"
        return "outside" if self.outside else "in"

    @property
    def includes_edge(self) -> bool:
        return self.relation == "in"

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds of its values; none for a range outside two ends."""
        ends = (-math.inf if self.low is None else self.low, math.inf if self.high is None else self.high)
        return {} if self.outside else {self.quantity: ends}

    def in_units(self, spec: Mapping[str, Quantity]) -> Range:
        """The same range in the units of a robot; InvalidArgument for a quantity or unit that it cannot have."""
        factor = _factor(self.unit, _quantity_named(self.quantity, spec))
        low, high = (None if end is None else end * factor for end in (self.low, self.high))
        return Range(self.quantity, low, high, spec[self.quantity].unit, self.outside)

    def margin(self, values: Mapping[str, Array], spec: Mapping[str, Quantity]) -> Float[Array, ""]:
        """How far inside it a robot is, in scales of the quantity; below 0 outside; all in the units of `spec`."""
        value = values[self.quantity]
        distances = [] if self.low is None else [value - self.low]
        distances += [] if self.high is None else [self.high - value]
        nearest = reduce(jnp.minimum, distances) / spec[self.quantity].scale
        return -nearest if self.outside else nearest


@record
class Ball:
    """A disc or ball of values of several quantities with the same unit, including its edge.

    Attributes:
        centre: one number for each of the quantities.
        unit: of centre and radius; empty for quantities without a unit.
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
        if len(set(self.quantities)) < len(self.quantities):
            raise InvalidArgument(f"{', '.join(self.quantities)}: expected each quantity once")

    def __str__(self) -> str:
        centre = ", ".join(map(number, self.centre))
        unit = f" {self.unit}" if self.unit else ""
        return f"{', '.join(self.quantities)} around {centre} radius {number(self.radius)}{unit}"

    includes_edge: ClassVar[bool] = True

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds of its values."""
        ends = ((at - self.radius, at + self.radius) for at in self.centre)
        return dict(zip(self.quantities, ends, strict=True))

    def in_units(self, spec: Mapping[str, Quantity]) -> Ball:
        """As `Range.in_units`; the quantities must have the same unit."""
        first, *others = [_quantity_named(name, spec) for name in self.quantities]
        for other in others:
            if other.unit != first.unit:
                raise InvalidArgument(
                    f"{other.name}: expected a quantity in {first.unit}, like {first.name}, got {other.unit}"
                )
        factor = _factor(self.unit, first)
        return Ball(self.quantities, tuple(factor * at for at in self.centre), factor * self.radius, first.unit)

    def margin(self, values: Mapping[str, Array], spec: Mapping[str, Quantity]) -> Float[Array, ""]:
        """As `Range.margin`, in the largest of the scales."""
        squares = [(values[name] - at) ** 2 for name, at in zip(self.quantities, self.centre, strict=True)]
        scale = max(spec[name].scale for name in self.quantities)
        return (self.radius - jnp.sqrt(sum(squares[1:], squares[0]))) / scale


Region = Annotated[tuple[Range | Ball, ...], Field(min_length=1)]
"""The intersection of its parts: ranges of several quantities form a box."""


def margin_of(
    region: tuple[Range | Ball, ...], values: Mapping[str, Array], spec: Mapping[str, Quantity]
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """How far inside a region a robot is (the smallest margin of its parts, in [-1, 1]), and whether it is inside."""
    margins = [part.margin(values, spec) for part in region]
    inside = [m >= 0 if part.includes_edge else m > 0 for part, m in zip(region, margins, strict=True)]
    return jnp.clip(reduce(jnp.minimum, margins), -1.0, 1.0), reduce(jnp.logical_and, inside)


def region_in_units(region: tuple[Range | Ball, ...], spec: Mapping[str, Quantity]) -> tuple[Range | Ball, ...]:
    """A region in the units of a robot; InvalidArgument as `Range.in_units`, and for parts that do not overlap."""
    parts = tuple(part.in_units(spec) for part in region)
    common: dict[str, tuple[float, float]] = {}
    for part in parts:
        for name, (low, high) in part.bounds().items():
            before = common.get(name, (-math.inf, math.inf))
            common[name] = low, high = max(low, before[0]), min(high, before[1])
            if not low < high:
                raise InvalidArgument(f"{name}: expected parts that overlap, got an empty region")
    for part in parts:
        if isinstance(part, Range) and part.outside:
            low, high = common.get(part.quantity, (-math.inf, math.inf))
            if part.low is not None and part.high is not None and part.low <= low and high <= part.high:
                raise InvalidArgument(f"{part.quantity}: expected parts that overlap, got an empty region")
    return parts


def number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def _quantity_named(name: str, spec: Mapping[str, Quantity]) -> Quantity:
    if name not in spec:
        raise InvalidArgument(f"expected a quantity among {', '.join(spec)}, got {name!r}{did_you_mean(name, spec)}")
    return spec[name]


def _factor(unit: str, quantity: Quantity) -> float:
    own_unit = "" if quantity.unit == "1" else quantity.unit
    if unit == own_unit:
        return 1.0
    (other, _, per), (own, _, own_per) = unit.partition("/"), own_unit.partition("/")
    if per == own_per and (other, own) in _FACTORS:
        return _FACTORS[other, own]
    also = [f"{known}/{per}" if own_per else known for known, base in _FACTORS if base == own]
    expected = " or ".join([own_unit, *also]) if own_unit else "no unit"
    raise InvalidArgument(f"{quantity.name}: expected {expected}, got {unit or 'no unit'}")
