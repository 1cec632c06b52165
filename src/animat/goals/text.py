"""A goal as text, as on the command line and in files: `avoid pole_angle outside -12..12 deg`.

goal      = objective { (";" | newline) objective }
objective = kind part { "and" part } [ "within" iterations ] [ "weight" number ]
part      = quantity ("in" | "outside") number ".." number [unit]
          | quantity ("above" | "below") number [unit]
          | quantity { "," quantity } "around" number { "," number } "radius" number [unit]
kind      = "avoid" | "reach" | "drive" | "minimize" | "maximize"
"""

from __future__ import annotations

import re
from typing import Any

from animat.errors import InvalidArgument, did_you_mean, shown, within
from animat.goals.goal import KINDS, Goal, Objective
from animat.goals.region import Ball, Range

_TOKEN = re.compile(r"\.{2,}|,|[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?|[^\W\d][^\s,;]*|\S")
_N = r"[-+]?\.?\d\S*"
_RELATIONS = ("in", "outside", "above", "below", "around")
_QUANTITY = rf"(?!(?:{'|'.join(_RELATIONS)}|and|within|weight) )[^\W\d]\S*"
_UNIT = r"(?: (?!(?:and|within|weight)$)(\S+))?"
_BETWEEN = re.compile(rf"({_QUANTITY}) (in|outside) ({_N}) \.\. ({_N}){_UNIT}")
_BEYOND = re.compile(rf"({_QUANTITY}) (above|below) ({_N}){_UNIT}")
_AROUND = re.compile(rf"({_QUANTITY}(?: , {_QUANTITY})*) around ({_N}(?: , {_N})*) radius ({_N}){_UNIT}")
"""The forms of a region's part, in which spaces separate words, numbers and signs; `...` is none of them."""
_EXAMPLE = "avoid pole_angle outside -12..12 deg"


def read_goal(text: Any) -> Goal:
    """Parse a goal; `str` is the inverse.

    Raises:
        InvalidArgument: naming the objective, what was expected and what was given.
    """
    if not isinstance(text, str):
        raise InvalidArgument(f"goal: expected a string such as {_EXAMPLE!r}, got {shown(text)}")
    clauses = [clause.strip() for clause in re.split("[;\n]", text) if clause.strip()]
    if not clauses:
        raise InvalidArgument(f"goal: expected an objective, such as {_EXAMPLE!r}, got nothing")
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
