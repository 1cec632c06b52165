"""The specification of a training: robot, mapping, number of policies, duration, seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Generic, Literal, TypeVar, get_type_hints

import numpy as np
from pydantic import BeforeValidator, Field, InstanceOf

from animat.coding.decoder import expect_one_command
from animat.coding.encoder import expect_electrode_pulses
from animat.coding.mapping import Mapping, mapping_named, mapping_to_data, register_mapping
from animat.environment import Animat, Environment, WithoutNeurons
from animat.errors import InvalidArgument, counted, in_min, shown, some_of
from animat.goals.robot import body_and_goal, without_goal
from animat.neurons.timeline import SimulatorTimeline
from animat.recordings.findings import Finding
from animat.records import Flag, Number, Positive, Seed, Whole, read_record
from animat.registry import is_ours
from animat.robots.base import MOST_ITERATIONS, Robot
from animat.robots.host import HostRobot
from animat.robots.registry import register_robot, robot_named
from animat.training.lessons import EPISODES, MOST_EPISODES, Lesson, check_lessons
from animat.training.settings import SAC, Policies, PulseCost, Shadowing
from animat.wrappers import Delivery, NeuralObservation, ShuffledDelivery, TrialCosts

Percentiles = Literal["moving", "first"]

CHUNKS = 60
"""Number of chunks in a training: the units of progress, refresh and checkpoint; a culture minute each by default."""

T = TypeVar("T")


class _Named(Generic[T]):
    """A field that takes an object or its name, and holds the object."""

    def __init__(self, named: Callable[[str], T]) -> None:
        self._named = named

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, training: object, owner: type) -> T:
        if training is None:
            # On the class, this error tells the dataclass decorator that the field has no default.
            raise AttributeError(self._name)
        value: T = vars(training)[self._name]
        return value

    def __set__(self, training: object, value: T | str) -> None:
        vars(training)[self._name] = self._named(value) if isinstance(value, str) else value


def _mapping_named(name: str) -> Mapping:
    if name == "none":
        raise InvalidArgument("mapping: expected None without neurons, mapping=None in Python, got 'none'")
    return mapping_named(name)


Commands = Annotated[
    tuple[Annotated[Number, Field(ge=-1, le=1)], ...],
    BeforeValidator(lambda commands: commands.tolist() if isinstance(commands, np.ndarray) else commands),
]


@dataclass(frozen=True)
class Training:
    """Everything that determines the policies, except for the recordings.

    Attributes:
        robot: the robot, or its name; with or without a goal (`animat.goals.robot.with_goal`).
        mapping: from responses to commands, or its name; None: the baseline without neurons.
        policies: number of policies, each with its own random numbers.
        iterations: iterations of the robot per policy; rounded up to whole rounds of `algorithm.environments`.
        seed: decides every random draw.
        shadowing: whether simulators are refreshed during training; if not, the first one is used throughout.
            `"drawn"`: each episode draws one of those that refreshing would have used (`animat.training.lessons`).
        duration_min: minutes of the culture's clock it represents (the paper: 60); None: `SimulatorTimeline.span_min`.
        percentiles: `"moving"` with the simulator in use, or fixed by the `"first"` recording.
        delivery: `"shuffled"` trains the paper's control, whose condition is drawn at random regardless of its choice.
        neural_observation: whether policies also see the neurons' history state (`animat.wrappers.NeuralObservation`).
            A closed loop computes it from the culture's responses; a live run refuses such policies.
        commands: without neurons, the commands to choose from; None: any in [-1, 1], as many as the robot takes.
        algorithm: settings of Soft Actor-Critic.
        lessons: in turn, each with ranges for its episodes (`Lesson`); after a last one that has `success` or
            `until_return` comes the task itself.
        pulse_cost: cost of an electrode pulse, in the units of the reward: policies are trained on the rewards minus
            the costs of their trials (`animat.coding.encoder`). Reported returns do not include the cost.
        assess: episodes on which policies are assessed after each sixtieth of the training, to keep the best version of
            each; None: they are not assessed, except in 20 episodes if a lesson has `success` or `until_return`.

    Raises:
        InvalidArgument: for counts or durations that are not positive.
    """

    robot: _Named[Robot[Any]] = _Named(robot_named)
    mapping: _Named[Mapping | None] = _Named(_mapping_named)
    policies: Policies = 10
    iterations: Annotated[Whole, Field(ge=1, le=MOST_ITERATIONS)] = 800_000
    seed: Seed = 1
    shadowing: Shadowing = True
    duration_min: Positive | None = None
    percentiles: Percentiles = "moving"
    delivery: Delivery = "chosen"
    neural_observation: Flag = False
    commands: Commands | None = None
    algorithm: InstanceOf[SAC] = field(default_factory=SAC)
    lessons: tuple[InstanceOf[Lesson], ...] = ()
    assess: Annotated[Whole, Field(ge=1, le=MOST_EPISODES)] | None = None
    pulse_cost: PulseCost = 0.0

    def __post_init__(self) -> None:
        for what, kind in (("robot", Robot), ("mapping", Mapping)):
            value: Any = getattr(self, what)
            if not isinstance(value, kind) and (what, value) != ("mapping", None):
                raise InvalidArgument(f"{what}: expected a {what} or the name of one, got {shown(value)}")
        for name, expected in _TYPES.items():
            # The converted value: 60 and 60.0 are the same training, and numpy numbers cannot be written to a file.
            vars(self)[name] = read_record(expected, getattr(self, name), name)
        if self.commands is not None:
            if not self.commands:
                raise InvalidArgument("commands: expected at least 1 command to pick from, or None for any, got none")
            expect_one_command(self.robot.name, self.robot.n_commands)
        if self.neural_observation and self.mapping is None:
            raise InvalidArgument("neural_observation: expected only with a mapping, got no mapping")
        check_lessons(self.lessons, self.robot, draws_recordings=self.shadowing == "drawn")
        if self.pulse_cost and self.mapping is None:
            raise InvalidArgument(f"pulse_cost: expected 0 without neurons, got {self.pulse_cost:g}")
        if self.pulse_cost and self.episodes_assessed:
            expected = "0 with assessments, which use the task's own return"
            raise InvalidArgument(f"pulse_cost: expected {expected}, got {self.pulse_cost:g}")
        if self.shadowing == "drawn" and self.mapping is None:
            raise InvalidArgument("shadowing: expected a mapping with 'drawn', got none")
        if self.is_varied and isinstance(self.robot, HostRobot):
            raise InvalidArgument(f"robot: expected one stepped by JAX for assessments, got {self.robot.name}")

    def register(self) -> None:
        """Register its robot and its mapping in this process, so that policies can be loaded here."""
        if isinstance(self.robot, HostRobot):
            self.robot.prepare()
        else:
            register_robot(type(without_goal(self.robot)))
        if self.mapping is not None and not is_ours(self.mapping):
            register_mapping(type(self.mapping))

    @property
    def is_varied(self) -> bool:
        """Whether episodes are drawn from ranges, or policies are assessed."""
        return bool(self.lessons or self.assess or self.shadowing == "drawn")

    @property
    def episodes_assessed(self) -> int:
        """Number of episodes per assessment; 0: no assessments."""
        return self.assess or EPISODES * any(lesson.has_threshold for lesson in self.lessons)

    @property
    def rounds(self) -> int:
        """Number of rounds; in each round all `algorithm.environments` do one iteration."""
        return math.ceil(self.iterations / self.algorithm.environments)

    def chunk(self, index: int) -> tuple[int, int]:
        """The first round of a chunk, and the one after its last round."""
        return index * self.rounds // CHUNKS, (index + 1) * self.rounds // CHUNKS

    def minute(self, index: int) -> float:
        """The start of a chunk, in minutes of the culture's clock after the first recording."""
        if not self.shadowing or self.duration_min is None:
            return 0.0
        return self.duration_min * index / CHUNKS

    def with_duration_of(self, timeline: SimulatorTimeline | None) -> Training:
        """This training with a duration: its own, or else as long as the recordings, of which the last is used, too."""
        if self.duration_min is not None or timeline is None:
            return self
        first_min, last_min = timeline.start_min[[0, -1]].tolist()
        return replace(self, duration_min=max(timeline.span_min, (last_min - first_min) * CHUNKS / (CHUNKS - 1)))

    def unused_recordings(self, timeline: SimulatorTimeline) -> tuple[Finding, ...]:
        """A finding if, without a duration of its own, there are recordings that no chunk would begin with."""
        if not self.shadowing or self.shadowing == "drawn" or self.duration_min is not None:
            return ()
        lasting, first_min = self.with_duration_of(timeline), float(timeline.start_min[0])
        used = {timeline.row_at(first_min + lasting.minute(index)) for index in range(CHUNKS)}
        unused = [in_min(minute) for row, minute in enumerate(timeline.start_min.tolist()) if row not in used]
        if not unused:
            return ()
        chunk = f"simulators change every {in_min(lasting.minute(1))} of the culture's clock"
        message = (
            f"{counted(len(unused), 'recording')} of {len(timeline)} not used in training, in which {chunk}: at "
            f"{some_of(unused)}; give recordings without long pauses"
        )
        return (Finding("unused-recordings", "warning", message, float(len(unused))),)

    def environment(self, n_conditions: int) -> Environment[Any]:
        """The environment that the policies act in, without the episode limit."""
        if self.mapping is None:
            return WithoutNeurons(self.robot, self.commands)
        environment: Environment[Any] = Animat(self.robot, self.mapping, n_conditions)
        if self.delivery == "shuffled":
            environment = ShuffledDelivery(environment)
        return NeuralObservation(environment) if self.neural_observation else environment

    def environment_on(self, timeline: SimulatorTimeline | None) -> Environment[Any]:
        """The environment for a culture's simulators, including the costs of trials, if any.

        Raises UnusableData for a pulse cost with conditions whose electrodes are unknown.
        """
        environment = self.environment(0 if timeline is None else len(timeline.conditions))
        if timeline is None or not self.pulse_cost:
            return environment
        pulses = 1 if timeline.presentation is None else timeline.presentation.pulses
        counts = expect_electrode_pulses(timeline.conditions, pulses)
        return TrialCosts(environment, tuple(self.pulse_cost * count for count in counts))

    def to_dict(self) -> dict[str, Any]:
        """This training as plain data, for a file."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {
            **body_and_goal(self.robot),
            "mapping": None if self.mapping is None else mapping_to_data(self.mapping),
            "algorithm": asdict(self.algorithm),
            "lessons": [asdict(lesson) for lesson in self.lessons],
            "chunks": CHUNKS,
        }


_TYPES = get_type_hints(Training, include_extras=True)
"""Of all other fields. Evaluated once, so that `read_record` knows them again."""
del _TYPES["robot"], _TYPES["mapping"]
