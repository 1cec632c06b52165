"""A goal as text, as the command line and files have it: `avoid pole_angle outside -12..12 deg`.

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

from animat.errors import InvalidArgument, did_you_mean, shown
from animat.goals.goal import KINDS, Goal, Objective
from animat.goals.region import Ball, Range

_TOKEN = re.compile(r"\.\.|,|[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?|[^\W\d][^\s,;]*|\S")
_RELATIONS = ("in", "outside", "above", "below", "around")
_AFTER = ("and", "within", "weight")
_EXAMPLE = "avoid pole_angle outside -12..12 deg"


def read_goal(text: Any) -> Goal:
    """The goal of a text; `str` of a goal gives such a text back.

    Raises:
        InvalidArgument: naming the objective, what was expected and what came.
    """
    if not isinstance(text, str):
        raise InvalidArgument(f"goal: expected a text such as {_EXAMPLE!r}, got {shown(text)}")
    clauses = [clause.strip() for clause in re.split("[;\n]", text) if clause.strip()]
    if not clauses:
        raise InvalidArgument(f"goal: expected something to strive for, such as {_EXAMPLE!r}, got nothing")
    objectives = []
    for clause in clauses:
        try:
            objectives.append(_Clause(clause).objective())
        except InvalidArgument as error:
            raise InvalidArgument(f"goal: {clause[:200]!r}: {error}") from error
    try:
        return Goal(tuple(objectives))
    except InvalidArgument as error:
        raise InvalidArgument(f"goal: {error}") from error


class _Clause:
    """The words of an objective, taken one after the other."""

    def __init__(self, clause: str) -> None:
        self._left: list[str] = _TOKEN.findall(clause)[::-1]

    def objective(self) -> Objective:
        kind = self._one_of(KINDS)
        region = [self._part()]
        while self._follows("and"):
            region.append(self._part())
        options: dict[str, Any] = {}
        while self._left:
            name = self._one_of([each for each in _AFTER if each not in options])
            if name == "and":
                raise InvalidArgument("expected parts of a region before within and weight, got 'and' after them")
            value = self._number()
            options[name] = int(value) if name == "within" and value.is_integer() else value
        return Objective(kind, tuple(region), **options)  # type: ignore[arg-type]

    def _part(self) -> Range | Ball:
        names = [self._word("a quantity")]
        while self._follows(","):
            names.append(self._word("a quantity"))
        relation = self._one_of(_RELATIONS if len(names) == 1 else ("around",))
        if relation == "around":
            centre = [self._number()]
            while self._follows(","):
                centre.append(self._number())
            self._one_of(("radius",))
            return Ball(tuple(names), tuple(centre), self._number(), self._unit())
        first = self._number()
        if relation == "above":
            return Range(names[0], first, None, self._unit())
        if relation == "below":
            return Range(names[0], None, first, self._unit())
        self._one_of(("..",))
        return Range(names[0], first, self._number(), self._unit(), relation == "outside")

    def _take(self, expected: str) -> str:
        if not self._left:
            raise InvalidArgument(f"expected {expected}, got nothing more")
        return self._left.pop()

    def _one_of(self, known: tuple[str, ...] | list[str]) -> str:
        word = self._take(" or ".join(known))
        if word not in known:
            raise InvalidArgument(f"expected {' or '.join(known)}, got {shown(word)}{did_you_mean(word, known)}")
        return word

    def _follows(self, word: str) -> bool:
        if self._left[-1:] != [word]:
            return False
        self._left.pop()
        return True

    def _word(self, expected: str) -> str:
        word = self._take(expected)
        if not (word[0].isalpha() or word[0] == "_") or word in (*_RELATIONS, *_AFTER):
            raise InvalidArgument(f"expected {expected}, got {shown(word)}")
        return word

    def _number(self) -> float:
        word = self._take("a number")
        try:
            return float(word)
        except ValueError:
            raise InvalidArgument(f"expected a number, got {shown(word)}") from None

    def _unit(self) -> str:
        if not self._left or self._left[-1] in _AFTER:
            return ""
        return self._take("a unit")
