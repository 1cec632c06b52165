"""Lessons as data: the ranges from which episodes are drawn, and when a policy moves on to the next lesson."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import field
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from animat.errors import InvalidArgument, did_you_mean, in_file, within
from animat.goals.robot import without_goal
from animat.plain_file import read_toml
from animat.records import Number, read_record, record
from animat.robots.base import Robot
from animat.robots.host import HostRobot

EPISODES = 20
"""Default number of episodes in an assessment that lessons need."""
MOST_EPISODES = 10_000
MOST_VARIED = 10
"""Largest number of parameters that vary: a robot is built for every combination of their ends as a check."""
_MOST_BYTES = 2**20


def _expect_low_first(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"expected the low end first, got [{ends[0]:g}, {ends[1]:g}]")
    return ends


Range = Annotated[tuple[Number, Number], AfterValidator(_expect_low_first)]
"""The lowest and the highest value; every value in between is equally likely."""


@record
class Lesson:
    """Ranges from which each episode is drawn; whatever is not named keeps the value of the robot and its reset.

    Attributes:
        name: what the lesson is called in tables.
        parameters: ranges of the robot's parameters, such as `{"pole_mass_kg": (0.4, 0.7)}`.
        starts: ranges of numbers of the robot's state at the start of an episode, by name.
        recordings_min: an episode draws one of the recordings that started between these minutes; None: one of all.
        success: the share of an assessment's episodes that must succeed for the policy to move on.
        until_return: alternatively, the mean return that they must reach, in the task's units.

    Raises:
        InvalidArgument: for a range with the high end first, or if both `success` and `until_return` are set.
    """

    name: Annotated[str, Field(max_length=200)] = ""
    parameters: dict[str, Range] = field(default_factory=dict)
    starts: dict[str, Range] = field(default_factory=dict)
    recordings_min: Range | None = None
    success: Annotated[Number, Field(gt=0, le=1)] | None = None
    until_return: Number | None = None

    def __post_init__(self) -> None:
        if self.success is not None and self.until_return is not None:
            raise InvalidArgument("until_return: expected either success or until_return, got both")

    @property
    def has_threshold(self) -> bool:
        """Whether it says when a policy moves on."""
        return self.success is not None or self.until_return is not None


@record
class _File:
    lessons: tuple[Lesson, ...] = ()


def read_lessons(path: str | os.PathLike[str]) -> tuple[Lesson, ...]:
    """Read lessons from a TOML file, one table `[[lessons]]` each, whose keys are the attributes of `Lesson`."""
    with in_file(path):
        lessons = read_record(_File, read_toml(path, _MOST_BYTES)).lessons
        if not lessons:
            raise InvalidArgument("expected a table [[lessons]] for each lesson, got none")
    return lessons


def stages_of(lessons: Sequence[Lesson]) -> tuple[Lesson, ...]:
    """The lessons in turn; a last one with a threshold is followed by the task itself."""
    return (*lessons, *[Lesson(name="the task itself")] * (not lessons or lessons[-1].has_threshold))


def check_lessons(lessons: Sequence[Lesson], robot: Robot[Any], *, draws_recordings: bool) -> None:
    """Refuse lessons that do not fit this robot."""
    if lessons and isinstance(robot, HostRobot):
        raise InvalidArgument(f"lessons: expected a robot that is stepped by JAX, got {robot.name}")
    for number, lesson in enumerate(lessons, 1):
        with within(f"lesson {number} ({lesson.name})" if lesson.name else f"lesson {number}"):
            if number < len(lessons) and not lesson.has_threshold:
                raise InvalidArgument("expected success or until_return, to move on to the next lesson, got neither")
            _check_lesson(lesson, robot, draws_recordings)


def _check_lesson(lesson: Lesson, robot: Robot[Any], draws_recordings: bool) -> None:
    if lesson.success is not None and not hasattr(robot, "succeeded"):
        got = f"{robot.name}, which has no method `succeeded`; use until_return"
        raise InvalidArgument(f"success: expected a robot that reports success, got {got}")
    if lesson.recordings_min is not None and not draws_recordings:
        expected = "only with shadowing 'drawn' (--shadowing drawn)"
        raise InvalidArgument(f"recordings_min: expected {expected}, got it without")
    body: Any = without_goal(robot)
    numbers = {f.name: getattr(body, f.name) for f in dataclasses.fields(body)}
    if len(lesson.parameters) > MOST_VARIED:
        raise InvalidArgument(f"parameters: expected at most {MOST_VARIED}, got {len(lesson.parameters)}")
    for name in lesson.parameters:
        if name not in numbers:
            known = ", ".join(known for known, value in numbers.items() if isinstance(value, float))
            near = did_you_mean(name, numbers) or f"; there are {known}"
            raise InvalidArgument(f"parameters: expected parameters of {robot.name}, got {name!r}{near}")
        if not isinstance(numbers[name], float):
            got = f"one that is {numbers[name]!r}, which cannot vary"
            raise InvalidArgument(f"parameters.{name}: expected a parameter that is a real number, got {got}")
    # If a combination is invalid anywhere, it is invalid at a corner.
    most = -math.inf
    for corner in itertools.product(*lesson.parameters.values()):
        values = dict(zip(lesson.parameters, corner, strict=True))
        corner_text = ", ".join(f"{name} = {value:g}" for name, value in values.items())
        with within(f"parameters: {robot.name} cannot have {corner_text}"):
            varied: Robot[Any] = dataclasses.replace(body, **values)
            most = max(most, (varied if body is robot else robot).return_range[1])
    if lesson.until_return is not None and lesson.until_return > most:
        most_text = f"{most:g}, the highest return of {robot.name}"
        raise InvalidArgument(f"until_return: expected at most {most_text}, got {lesson.until_return:g}")
