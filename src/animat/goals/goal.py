"""A goal: weighted objectives over a robot's quantities, and its text: `avoid pole_angle outside -12..12 deg`.

goal      = objective { (";" | newline) objective }
objective = kind part { "and" part } [ "within" iterations ] [ "weight" number ]
part      = quantity ("in" | "outside") number ".." number [unit]
          | quantity ("above" | "below") number [unit]
          | quantity { "," quantity } "around" number { "," number } "radius" number [unit]
kind      = "avoid" | "reach" | "drive" | "minimize" | "maximize"
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from animat.errors import InvalidArgument, did_you_mean, shown, within
from animat.goals.region import Ball, Range, Region, number
from animat.records import Number, Whole, record
from animat.robots.base import LONGEST_EPISODE

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
