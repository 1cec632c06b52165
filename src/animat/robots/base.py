"""What a robot is: a body with a task, as pure functions of its state and as data."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from numbers import Real
from typing import Annotated, Any, ClassVar, Generic, TypeVar, final

from jaxtyping import Bool, Float
from pydantic import BeforeValidator, Field

from animat.errors import InvalidArgument, shown
from animat.lazy import Array, jax
from animat.records import Number, Whole

State = TypeVar("State")
"""A robot's state: a NamedTuple of float32 scalars; batches of robots are `jax.vmap` outside."""

LONGEST_EPISODE = 1_000_000
"""Iterations of an episode at most: each has a random key of its own, drawn before the first."""


def _whole(given: Any) -> Any:
    # The command line and files have 120.0 for 120.
    return int(given) if isinstance(given, float) and given.is_integer() else given


Iterations = Annotated[Whole, Field(ge=1, le=LONGEST_EPISODE), BeforeValidator(_whole)]
Size = Annotated[Number, Field(ge=1e-9, le=1e9)]
Amount = Annotated[Number, Field(ge=0, le=1e9)]
"""Parameters of a robot: a size is never 0."""

MOST_AT_ONCE = 5_000_000
"""Episodes side by side at most: each takes some 300 bytes."""

LEAST_SCALE, LARGEST_SCALE = 1e-12, 1e12
"""Of an observed quantity: within them a network of float32 computes with what it is divided by."""


@dataclasses.dataclass(frozen=True)
class Quantity:
    """One number of an observation.

    Attributes:
        name: what it is, `cart_position`.
        unit: what it is measured in, `m`.
        scale: how large it usually is, in that unit; a learner divides by it.
        low, high: bounds in that unit that no observation of an episode passes, the last one included.
        of_goal: whether it tells of the goal, and not of the body and its surroundings: a reflex does not know it
            (`animat.evaluation.coupling`).

    Raises:
        InvalidArgument: for a name or a unit that is no text, for a scale or a bound that is no number, and for bounds
            that do not rise.
    """

    name: str
    unit: str
    scale: float
    low: float = -math.inf
    high: float = math.inf
    of_goal: bool = False

    def __post_init__(self) -> None:
        for name in ("name", "unit"):
            if not isinstance(text := getattr(self, name), str):
                raise InvalidArgument(f"{name} of a Quantity: expected a text, got {shown(text)}")
        for name in ("scale", "low", "high"):
            number: Any = getattr(self, name)
            # Also what JAX traces, of a robot whose parameters are drawn.
            if not hasattr(number, "__float__") or getattr(number, "ndim", 0) != 0:
                raise InvalidArgument(f"{self.name}: {name} of a Quantity: expected a number, got {shown(number)}")
        if all(isinstance(bound, Real) for bound in (self.low, self.high)) and not self.low < self.high:
            raise InvalidArgument(f"{self.name}: expected low < high of a Quantity, got {self.low:g} and {self.high:g}")


class Robot(abc.ABC, Generic[State]):
    """A body with a task, driven by a motor command u in [-1, 1] an iteration, or by several.

    Implementations are frozen dataclasses whose fields are all parameters, with units in their names: they compare,
    hash (so they are static under `jax.jit`) and go to JSON. JAX is imported when the robot first moves, not before:
    a robot can be named, compared and stored without it.

    `terminated` says that the task ended (fell, arrived). That an episode reached `episode_limit` is truncation;
    whoever runs the episode counts, and a robot never says so.

    Methods that may be missing, and what needs them says so (`lacking`):

        succeeded(state) -> Bool[Array, ""]                            of the last state of an episode, in JAX
        heuristic(observation) -> command                              a heuristic policy, in JAX, of one observation
        draw(observation, command, earlier, height_px) -> picture      uint8, shape (height, width, 3)
        draw_paths(axes, paths)                                        whole episodes on Matplotlib's axes
        value_grid() -> animat.robots.grid.Grid                        for the optimal return
        potential(state) -> float                                      shapes what is learned from, not what is best
        with_goal_of(state, other) -> State                            the body of one state with the goal of another
    """

    name: ClassVar[str]
    """What `animat.robots.robot_named` knows it by."""

    n_commands: ClassVar[int] = 1
    """How many motor commands it takes at once, each the command of a readout (`animat.coding.decoder`)."""

    noise_size: ClassVar[int] = 0
    """How many uniform random numbers in [0, 1) one iteration consumes."""

    paper_iterations: ClassVar[int] = 500_000
    """Iterations that the paper trained a policy for on this task; of others, how many are trained by default."""

    baseline_commands: ClassVar[tuple[float, ...] | None] = None
    """What the baseline without neurons picks from; None: any command in [-1, 1]."""

    episode_limit: int
    """Iterations after which an episode is cut off."""

    @property
    @abc.abstractmethod
    def observation_spec(self) -> tuple[Quantity, ...]:
        """What the numbers of an observation are, in order."""

    @property
    def return_range(self) -> tuple[float, float]:
        """What the return of an episode can be at least and at most; infinite where that is not known."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def reset(self, key: Array) -> State:
        """The state at the start of an episode."""

    @abc.abstractmethod
    def advance(
        self, uniforms: Float[Array, " noise_size"], state: State, u: Float[Array, "*commands"]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        """One iteration, with its random numbers given: no random generator runs inside.

        Args:
            uniforms: random numbers in [0, 1), shape (noise_size,).
            state: before the iteration.
            u: the motor command, in [-1, 1]; of several, shape (n_commands,).

        Returns:
            the state after the iteration, the reward in the task's own units, and whether the task ended.
        """

    @abc.abstractmethod
    def observe(self, state: State) -> Float[Array, " observations"]:
        """What a controller sees of `state`, in the units of `observation_spec`, float32, shape (observations,)."""

    @final
    def step(
        self, key: Array, state: State, u: Float[Array, "*commands"]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        """One iteration, its random numbers drawn from `key`; arguments and results as in `advance`."""
        return self.advance(jax.random.uniform(key, (self.noise_size,)), state, u)

    def caveats(self) -> tuple[str, ...]:
        """What a user should know before trusting results with these parameters, a sentence each; mostly nothing."""
        return ()

    def departures(self) -> tuple[tuple[str, str], ...]:
        """Where it departs from a paper's print: each with a title, for the report of a study; mostly nothing."""
        return ()


WITHOUT = {
    "heuristic": "no heuristic policy among the controls",
    "value_grid": "no optimal return",
    "draw": "no pictures of the robot",
    "draw_paths": "no figure of paths",
}
"""What is left out for a robot without a method of this name (see `animat.Robot`)."""


def lacking(robot: Robot[Any]) -> dict[str, str]:
    """What is left out for this robot: a sentence for each method that it has not, by the method's name."""
    return {
        name: f"{without}: {robot.name} has no method `{name}`"
        for name, without in WITHOUT.items()
        if not hasattr(robot, name)
    }


def capability(robot: Robot[Any], name: str) -> Callable[..., Any]:
    """The method of this name.

    Raises:
        InvalidArgument: for a robot without it.
    """
    if not hasattr(robot, name):
        raise InvalidArgument(f"robot: {robot.name} has no method `{name}`")
    return getattr(robot, name)  # type: ignore[no-any-return]
