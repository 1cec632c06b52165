"""The contract of a robot: a body with a task, as pure functions of its state and as data."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from numbers import Real
from typing import Annotated, Any, ClassVar, Generic, TypeAlias, TypeVar, final

from jaxtyping import Bool, Float
from pydantic import BeforeValidator, Field

from animat.errors import InvalidArgument, shown
from animat.lazy import Array, jax, jnp
from animat.records import Number, Whole

State = TypeVar("State")
"""A robot's state: a NamedTuple of numbers or arrays; `jax.vmap` makes batches of robots."""

Uniforms: TypeAlias = "Float[Array, ' noise_size']"
Transition: TypeAlias = tuple[State, "Float[Array, '']", "Bool[Array, '']"]
"""The state after an iteration, the reward in the task's own units, and whether the task ended."""

LONGEST_EPISODE = 1_000_000
"""Most iterations of an episode: each has its own random key, drawn before the first."""

# Whole numbers from the command line and files may be floats, 120.0.
_TO_WHOLE = BeforeValidator(lambda value: int(value) if isinstance(value, float) and value.is_integer() else value)
Iterations = Annotated[Whole, Field(ge=1, le=LONGEST_EPISODE), _TO_WHOLE]
Size = Annotated[Number, Field(ge=1e-9, le=1e9)]
Amount = Annotated[Number, Field(ge=0, le=1e9)]
"""Types of a robot's parameters: a size is never 0."""

MOST_ITERATIONS = 2_000_000_000
"""Most iterations of a training: they are counted in 32 bits, with room for a last round of all environments."""

MOST_AT_ONCE = 5_000_000
"""Most episodes side by side: each takes some 300 bytes, and 12 for each condition."""

LEAST_SCALE, LARGEST_SCALE = 1e-12, 1e12
"""Limits of a quantity's scale, within which a float32 network can compute with the scaled quantity."""


@dataclasses.dataclass(frozen=True)
class Quantity:
    """One number of an observation.

    Attributes:
        name: such as `cart_position`.
        unit: such as `m`.
        scale: its usual size, in that unit; a learner divides by it.
        low, high: bounds in that unit that no observation of an episode exceeds, including the last.
        of_goal: whether it describes the goal, not the body; a reflex does not know it (`animat.evaluation.coupling`).

    Raises:
        InvalidArgument: for a name or unit that is not a string, a scale or bound that is no number, or falling bounds.
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
                raise InvalidArgument(f"{name} of a Quantity: expected a string, got {shown(text)}")
        for name in ("scale", "low", "high"):
            number: Any = getattr(self, name)
            # JAX traces these for a robot whose parameters are drawn.
            if not hasattr(number, "__float__") or getattr(number, "ndim", 0) != 0:
                raise InvalidArgument(f"{self.name}: {name} of a Quantity: expected a number, got {shown(number)}")
        if all(isinstance(bound, Real) for bound in (self.low, self.high)) and not self.low < self.high:
            raise InvalidArgument(f"{self.name}: expected low < high of a Quantity, got {self.low:g} and {self.high:g}")


class Robot(abc.ABC, Generic[State]):
    """A body with a task, driven by one or several motor commands u in [-1, 1] per iteration.

    Implementations are frozen dataclasses whose fields are all parameters, with units in their names; ours raise
    InvalidArgument for one that is not finite or makes no sense. They compare, hash (so they are static under
    `jax.jit`) and convert to JSON, without JAX, which is imported only when a robot first moves.

    `terminated` means that the task ended (fell, arrived). Reaching `episode_limit` is truncation: the program that
    runs the episode counts iterations, the robot never does.

    These methods are optional, and a feature that needs a missing one reports it (`lacking`):

        succeeded(state) -> Bool[Array, ""]                            for the last state of an episode, in JAX
        heuristic(observation) -> command                              a heuristic policy, in JAX, for one observation
        draw(observation, command, earlier, height_px) -> picture      uint8, shape (height, width, 3)
        draw_paths(axes, paths)                                        whole episodes on Matplotlib axes
        value_grid() -> animat.robots.grid.Grid                        for the optimal return
        potential(state) -> float                                      shapes the rewards, not the best policy
        with_goal_of(state, other) -> State                            the body of one state with the goal of another
    """

    name: ClassVar[str]
    """Its name for `animat.robots.robot_named`."""

    n_commands: ClassVar[int] = 1
    """How many motor commands it takes at once, each the command of a readout (`animat.coding.decoder`)."""

    noise_size: ClassVar[int] = 0
    """How many uniform random numbers in [0, 1) one iteration consumes."""

    paper_iterations: ClassVar[int] = 500_000
    """Iterations for which the paper trained a policy on this task; on other tasks, the default number."""

    baseline_commands: ClassVar[tuple[float, ...] | None] = None
    """Commands from which the baseline without neurons chooses; None: any command in [-1, 1]."""

    episode_limit: int
    """Iterations after which an episode is cut off."""

    @final
    @property
    def command_shape(self) -> tuple[int, ...]:
        """The shape of a motor command: (), or (n_commands,) for several."""
        return () if self.n_commands == 1 else (self.n_commands,)

    @property
    @abc.abstractmethod
    def observation_spec(self) -> tuple[Quantity, ...]:
        """The quantities that make up an observation, in order."""

    @property
    def return_range(self) -> tuple[float, float]:
        """The lowest and the highest possible return of an episode; infinite if unknown."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def reset(self, key: Array) -> State:
        """The state at the start of an episode."""

    @abc.abstractmethod
    def advance(self, uniforms: Uniforms, state: State, u: Float[Array, "*commands"]) -> Transition[State]:
        """One iteration from given random numbers: no random generator runs inside.

        Args:
            uniforms: random numbers in [0, 1), shape (noise_size,).
            state: before the iteration.
            u: the motor command in [-1, 1], of `command_shape`.
        """

    @abc.abstractmethod
    def observe(self, state: State) -> Float[Array, " observations"]:
        """The observation of `state`, in the units of `observation_spec`, float32, shape (observations,)."""

    @final
    def step(self, key: Array, state: State, u: Float[Array, "*commands"]) -> Transition[State]:
        """One iteration with random numbers drawn from `key`; arguments and results as in `advance`."""
        return self.advance(jax.random.uniform(key, (self.noise_size,), jnp.float32), state, u)

    def caveats(self) -> tuple[str, ...]:
        """Warnings to consider before trusting results with these parameters, one sentence each; usually none."""
        return ()

    def departures(self) -> tuple[tuple[str, str], ...]:
        """Departures from the printed paper, each a title and a text for a study's report; usually none."""
        return ()


WITHOUT = {
    "heuristic": "no heuristic policy among the controls",
    "value_grid": "no optimal return",
    "draw": "no pictures of the robot",
    "draw_paths": "no figure of paths",
}
"""What is left out for a robot without the optional method of this name."""


def lacking(robot: Robot[Any]) -> dict[str, str]:
    """What is left out for this robot: a sentence for each missing method, by the method's name."""
    missing = {name: without for name, without in WITHOUT.items() if not hasattr(robot, name)}
    return {name: f"{without}: {robot.name} has no method `{name}`" for name, without in missing.items()}


def capability(robot: Robot[Any], name: str) -> Callable[..., Any]:
    """The method of this name; raises InvalidArgument if the robot has none."""
    if not hasattr(robot, name):
        raise InvalidArgument(f"robot: {robot.name} has no method `{name}`")
    return getattr(robot, name)  # type: ignore[no-any-return]
