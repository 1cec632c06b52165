"""A goal: objectives over regions of a robot's quantities, and its text: `avoid pole_angle outside -12..12 deg`.

goal      = objective { (";" | newline) objective }
objective = kind part { "and" part } [ "within" iterations ] [ "weight" number ]
part      = quantity ("in" | "outside") number ".." number [unit]
          | quantity ("above" | "below") number [unit]
          | quantity { "," quantity } "around" number { "," number } "radius" number [unit]
kind      = "avoid" | "reach" | "drive" | "minimize" | "maximize"
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from animat.errors import InvalidArgument, did_you_mean, shown, within
from animat.lazy import Array, jnp
from animat.records import Flag, Number, Positive, Whole, record
from animat.robots.base import LONGEST_EPISODE, Quantity

Kind = Literal["avoid", "reach", "drive", "minimize", "maximize"]
KINDS: tuple[str, ...] = get_args(Kind)

_TOKEN = re.compile(r"\.{2,}|,|[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?|[^\W\d][^\s,;]*|\S")
_N = r"[-+]?\.?\d\S*"
_RELATIONS = ("in", "outside", "above", "below", "around")
_QUANTITY = rf"(?!(?:{'|'.join(_RELATIONS)}|and|within|weight) )[^\W\d]\S*"
_UNIT = r"(?: (?!(?:and|within|weight)$)(\S+))?"
_BETWEEN = re.compile(rf"({_QUANTITY}) (in|outside) ({_N}) \.\. ({_N}){_UNIT}")
_BEYOND = re.compile(rf"({_QUANTITY}) (above|below) ({_N}){_UNIT}")
_AROUND = re.compile(rf"({_QUANTITY}(?: , {_QUANTITY})*) around ({_N}(?: , {_N})*) radius ({_N}){_UNIT}")
"""The forms of a region's part, in which spaces separate words, numbers and signs; `...` is none of them."""

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
        """How far inside the range a robot is, in scales of the quantity; negative outside; in the units of `spec`."""
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
        names, n = ", ".join(self.quantities), len(self.quantities)
        if len(self.centre) != n:
            raise InvalidArgument(f"{names}: expected a centre of {n} numbers, got {len(self.centre)}")
        if len(set(self.quantities)) < n:
            raise InvalidArgument(f"{names}: expected each quantity once")

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


Margins = tuple["Float[Array, ' objectives']", "Bool[Array, ' objectives']"]
"""For each objective, the margin in [-1, 1], and whether the robot is in its region."""

Region = Annotated[tuple[Range | Ball, ...], Field(min_length=1)]
"""The intersection of its parts: ranges of several quantities form a box."""


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
    also = [f"{known}/{own_per}" if own_per else known for known, base in _FACTORS if base == own]
    expected = " or ".join([own_unit, *also]) if own_unit else "no unit"
    raise InvalidArgument(f"{quantity.name}: expected {expected}, got {unit or 'no unit'}")


@record
class Objective:
    """One thing to achieve or to avoid.

    Attributes:
        kind: `"avoid"`: entering the region ends an episode as failed. `"reach"`: entering it ends one as succeeded,
            the sooner the better. `"drive"`: get there and stay. `"minimize"`, `"maximize"`: push a quantity below or
            above a threshold, and further.
        region: the intersection of its parts.
        weight: relative to the other objectives; only the ratios of weights matter.
        within: for `"drive"`: more iterations outside in a row, start included, fail the episode; None: they do not.
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


def margins_of(objectives: Sequence[Objective], spec: Mapping[str, Quantity], observation: Array) -> Margins:
    """How far inside the region of each objective a robot is, the least of its parts, and whether it is inside."""
    values = dict(zip(spec, observation, strict=True))
    least, inside = [], []
    for objective in objectives:
        margins = [(part.margin(values, spec), part.includes_edge) for part in objective.region]
        least.append(jnp.clip(reduce(jnp.minimum, [margin for margin, _ in margins]), -1.0, 1.0))
        inside.append(reduce(jnp.logical_and, [margin >= 0 if edge else margin > 0 for margin, edge in margins]))
    return jnp.stack(least), jnp.stack(inside)


def of_kind(objectives: Sequence[Objective], *kinds: Kind) -> Bool[np.ndarray, " objectives"]:
    """Which of the objectives are of one of these kinds."""
    return np.array([objective.kind in kinds for objective in objectives])


@record
class Goal:
    """At least one objective; they all apply together."""

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=50)]

    def __str__(self) -> str:
        return "; ".join(map(str, self.objectives))


def read_goal(text: str) -> Goal:
    """Parse a goal; `str` is the inverse. InvalidArgument names the objective that cannot be read."""
    clauses = [clause.strip() for clause in re.split("[;\n]", text) if clause.strip()]
    if not clauses:
        raise InvalidArgument("goal: expected an objective, such as 'avoid pole_angle outside -12..12 deg', got none")
    objectives = []
    with within("goal"):
        for clause in clauses:
            with within(repr(clause[:200])):
                objectives.append(_objective(" ".join(_TOKEN.findall(clause))))
        return Goal(tuple(objectives))


def is_text(goal: Goal) -> bool:
    """Whether a goal can be read back from its text."""
    try:
        return read_goal(str(goal)) == goal
    except InvalidArgument:
        return False


def _objective(text: str) -> Objective:
    kind, _, rest = text.partition(" ")
    if kind not in KINDS:
        raise InvalidArgument(f"expected {' or '.join(KINDS)}, got {shown(kind)}{did_you_mean(kind, KINDS)}")
    region, *pairs = re.split(" (within|weight) ", rest)
    parts = tuple(map(_part, region.split(" and ")))
    options: dict[str, Any] = {}
    for name, value in zip(pairs[::2], pairs[1::2], strict=True):
        if name in options or not re.fullmatch(_N, value):
            raise InvalidArgument(
                f"expected within and weight at most once, each with a number, got {shown(f'{name} {value}')}"
            )
        number = float(value)
        options[name] = int(number) if name == "within" and number.is_integer() else number
    return Objective(kind, parts, **options)  # type: ignore[arg-type]


def _part(text: str) -> Range | Ball:
    if match := _BETWEEN.fullmatch(text):
        name, relation, low, high, unit = match.groups("")
        return Range(name, float(low), float(high), unit, relation == "outside")
    if match := _BEYOND.fullmatch(text):
        name, relation, end, unit = match.groups("")
        is_above = relation == "above"
        return Range(name, float(end) if is_above else None, None if is_above else float(end), unit)
    if match := _AROUND.fullmatch(text):
        names, centre, radius, unit = match.groups("")
        return Ball(tuple(names.split(" , ")), tuple(map(float, centre.split(" , "))), float(radius), unit)
    misspelt = re.match(rf"{_QUANTITY}(?: , {_QUANTITY})* (?!(?:{'|'.join(_RELATIONS)})\b)([^\W\d]\S*)", text)
    meant = did_you_mean(misspelt[1], _RELATIONS) if misspelt else ""
    raise InvalidArgument(
        f"expected a region: QUANTITY in|outside LOW..HIGH UNIT; QUANTITY above|below NUMBER UNIT; or QUANTITY, "
        f"QUANTITY around NUMBER, NUMBER radius NUMBER UNIT; several joined by and, then within NUMBER, weight NUMBER; "
        f"got {shown(text)}{meant}"
    )
