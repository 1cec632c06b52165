"""What is trained: robot, mapping, how many policies and for how long, from which seed."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

from animat.animat import Animat, Delivery, Environment, WithoutNeurons
from animat.errors import InvalidArgument
from animat.mapping import Mapping
from animat.robots.base import Robot
from animat.robots.registry import robot_to_dict
from animat.training.sac import SAC

Percentiles = Literal["moving", "first"]

CHUNKS = 60
"""Parts that training is cut into: the units of progress, refresh and checkpoint; a culture minute each by default."""


@dataclass(frozen=True)
class Training:
    """Everything that decides how policies come out, but for the recordings.

    Attributes:
        robot: the robot to be driven.
        mapping: from responses to commands; None trains the baseline without neurons, which moves the robot directly.
        policies: how many are trained, each from its own random numbers.
        iterations: of the robot, for each policy; rounded up to whole rounds of `algorithm.environments`.
        seed: decides every random draw.
        shadowing: whether simulators are refreshed during training; if not, the first one is used throughout.
        duration_min: minutes of the culture's clock that the whole training stands for (the paper: 60).
        percentiles: `"moving"` with the simulator in use, or those of the `"first"` recording held.
        delivery: `"shuffled"` trains the paper's control, whose condition is drawn at random whatever it chose.
        commands: without neurons, the commands to pick from; None: any in [-1, 1].
        algorithm: settings of Soft Actor-Critic.

    Raises:
        InvalidArgument: for counts or durations that are not positive.
    """

    robot: Robot[Any]
    mapping: Mapping | None
    policies: int = 10
    iterations: int = 800_000
    seed: int = 1
    shadowing: bool = True
    duration_min: float = 60.0
    percentiles: Percentiles = "moving"
    delivery: Delivery = "chosen"
    commands: tuple[float, ...] | None = None
    algorithm: SAC = field(default_factory=SAC)

    def __post_init__(self) -> None:
        for name in ("policies", "iterations"):
            if getattr(self, name) < 1:
                raise InvalidArgument(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.iterations > 2**31 - 1 - self.algorithm.environments:
            raise InvalidArgument(
                f"iterations: expected at most 2e9, as they are counted in int32, got {self.iterations}"
            )
        # JAX takes 32 bits of a seed: beyond them two seeds would give the same draws.
        if not 0 <= self.seed < 2**32:
            raise InvalidArgument(f"seed: expected a whole number from 0 to 4294967295, got {self.seed}")
        if not (math.isfinite(self.duration_min) and self.duration_min > 0):
            raise InvalidArgument(f"duration_min: expected positive minutes, got {self.duration_min:g}")
        for name, allowed in (("percentiles", get_args(Percentiles)), ("delivery", get_args(Delivery))):
            if getattr(self, name) not in allowed:
                raise InvalidArgument(f"{name}: expected one of {', '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def rounds(self) -> int:
        """Rounds of training; in each, every one of `algorithm.environments` does one iteration."""
        return math.ceil(self.iterations / self.algorithm.environments)

    def chunk(self, index: int) -> tuple[int, int]:
        """The first round of a chunk, and the one after its last."""
        return index * self.rounds // CHUNKS, (index + 1) * self.rounds // CHUNKS

    def minute(self, index: int) -> float:
        """The minute of the culture's clock, from the first recording on, that a chunk starts at."""
        return self.duration_min * index / CHUNKS if self.shadowing else 0.0

    def environment(self, n_conditions: int) -> Environment[Any]:
        """What the policies act in."""
        if self.mapping is None:
            return WithoutNeurons(self.robot, self.commands)
        return Animat(self.robot, self.mapping, n_conditions, self.delivery)

    def to_dict(self) -> dict[str, Any]:
        """The same as plain data, for a file."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return plain | {
            "robot": robot_to_dict(self.robot),
            "mapping": None if self.mapping is None else self.mapping.name,
            "algorithm": asdict(self.algorithm),
            "chunks": CHUNKS,
        }
