"""What a policy acts in: neurons, mapping and robot as a single environment (`Animat`), pure and jittable."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from animat.arguments import check_argument
from animat.coding.decoder import decode, expect_one_command, expect_readout_per_command
from animat.coding.mapping import Mapping
from animat.errors import InvalidArgument, expect_at_least
from animat.neurons.history import INITIAL_HISTORY
from animat.neurons.simulator import Answer, NeuronSimulator
from animat.robots.base import Quantity, Robot

RobotState = TypeVar("RobotState")

Uniforms = Float[Array, " noise"]
Neurons: TypeAlias = NeuronSimulator | None
"""The simulator of the neurons that move a robot; None without neurons."""

_NOT_CARRIED = ("delivered", "rate_hz", "command")
"""Entries of `info` about the last iteration, which the next one does not need."""


class Ended(NamedTuple):
    """Whether the task ended by itself (fell, reached), or the episode was cut off (`animat.wrappers.EpisodeLimit`)."""

    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]


class Responded(NamedTuple):
    """The result of an action before the robot moves: as in `State.info`, with the answer of the neurons."""

    delivered: Array
    answer: Answer
    command: Float[Array, "*commands"]


class State(NamedTuple):
    """The state of an episode, and what the iteration that led to it did (all 0 at the start).

    Attributes:
        iteration: the number of iterations done.
        neurons: their history state, see `animat.neurons.simulator.Answer`.
        reward: in the task's units.
        info: by name. `delivered`: the condition that reached the neurons (the action itself, without neurons).
            `rate_hz`: the response x, Hz per channel (NaN without neurons); with several readouts, shape (readouts,).
            `command`: the motor command u in [-1, 1]; with several, shape (commands,). Wrappers add what they remember,
            which `advance` passes on.
    """

    robot: Any
    iteration: Int[Array, ""]
    neurons: Float[Array, "2"]
    reward: Float[Array, ""]
    ended: Ended
    info: dict[str, Array]

    @property
    def carried(self) -> State:
        """Only what the next iteration needs, which keeps compiled loops small."""
        remembered = {name: value for name, value in self.info.items() if name not in _NOT_CARRIED}
        return self._replace(reward=None, ended=None, info=remembered)  # type: ignore[arg-type]


class Environment(abc.ABC, Generic[RobotState]):
    """What a policy acts in: a robot, moved by neurons (`Animat`) or directly (`WithoutNeurons`), or a wrapper.

    Everything in it is static; the simulator is an argument of each step, so refreshing it changes data, not code.
    Episodes continue until the task ends by itself, unless a wrapper cuts them off (`animat.wrappers`).
    """

    robot: Robot[RobotState]

    @property
    @abc.abstractmethod
    def n_actions(self) -> int | None:
        """The number of discrete actions; None: continuous actions in [-1, 1], one per command."""

    @property
    @abc.abstractmethod
    def noise_size(self) -> int:
        """The number of uniforms in [0, 1) that one iteration consumes."""

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        """The quantities of an observation, in order; those of the robot come first."""
        return self.robot.observation_spec

    def observe(self, state: State) -> Float[Array, " observations"]:
        """What a policy sees, in the units of `observation_spec`; float32, of whatever type a user's robot makes it."""
        return jnp.asarray(self.robot.observe(state.robot), jnp.float32)

    def reset(self, key: PRNGKeyArray) -> State:
        """Start an episode."""
        rest = jnp.zeros(self.robot.command_shape)
        delivered = rest if self.n_actions is None else jnp.int32(0)
        return State(
            self.robot.reset(key),
            jnp.int32(0),
            jnp.array(INITIAL_HISTORY, jnp.float32),
            jnp.float32(0.0),
            Ended(jnp.bool_(False), jnp.bool_(False)),
            {"delivered": delivered, "rate_hz": rest, "command": rest},
        )

    @abc.abstractmethod
    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        """The result of an action before the robot moves; arguments as in `advance`."""

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        """One iteration, with its random numbers as an argument: training draws them for many iterations at once.

        Args:
            uniforms: random numbers in [0, 1), shape (noise_size,).
            state: before the iteration; `State.carried` is enough.
            action: an index, or the commands.
        """
        delivered, answer, command = self.respond(uniforms, state, action, simulator)
        robot, reward, terminated = self.robot.advance(uniforms[: self.robot.noise_size], state.robot, command)
        info = state.info | {"delivered": delivered, "rate_hz": answer.rate_hz, "command": command}
        return State(robot, state.iteration + 1, answer.history, reward, Ended(terminated, jnp.bool_(False)), info)

    @final
    def step(self, key: PRNGKeyArray, state: State, action: Array, simulator: Neurons) -> State:
        """One iteration: action, response, command, movement."""
        return self.advance(jax.random.uniform(key, (self.noise_size,), jnp.float32), state, action, simulator)

    @property
    def n_drawn(self) -> int:
        """The number of uniforms for drawing an action: one, or one for each continuous command."""
        return 1 if self.n_actions is not None else self.robot.n_commands

    @property
    def scales(self) -> Float[np.ndarray, " observations"]:
        """The divisors with which a policy scales observations to order one."""
        return np.array([quantity.scale for quantity in self.observation_spec], np.float32)


@dataclass(frozen=True)
class Animat(Environment[RobotState]):
    """A robot moved by the responses of neurons to the conditions that the agent picks.

    Attributes:
        mapping: from the neurons' response to the robot's command.
        n_conditions: the number of actions: the simulator's `n_conditions`.

    Raises:
        InvalidArgument: for anything but a robot and a mapping, such as their names, or no condition.
    """

    robot: Robot[RobotState]
    mapping: Mapping
    n_conditions: int

    def __post_init__(self) -> None:
        # Not by `checked_arguments`: the type checker of the tests would resolve annotations in the decorator's module.
        check_argument("robot", self.robot, Robot)
        check_argument("mapping", self.mapping, Mapping)
        check_argument("n_conditions", self.n_conditions, int)
        expect_at_least("n_conditions", self.n_conditions, 1)

    @property
    def n_actions(self) -> int:
        return self.n_conditions

    @property
    def noise_size(self) -> int:
        # The last one is for drawing the delivered condition (`ShuffledDelivery`): with or without it, robot and
        # neurons get the same random numbers.
        return self.robot.noise_size + 2

    def expect_simulator(self, simulator: Neurons) -> NeuronSimulator:
        """The simulator; raises InvalidArgument for none, or one of another number of conditions."""
        if simulator is None:
            raise InvalidArgument("simulator: expected a neuron simulator, which an Animat needs, got None")
        if simulator.n_conditions != self.n_conditions:
            expected = f"expected {simulator.n_conditions}, those of the simulator, got {self.n_conditions}"
            raise InvalidArgument(f"n_conditions: {expected}: make the Animat with n_conditions of the simulator")
        return simulator

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        simulator = self.expect_simulator(simulator)
        expect_readout_per_command(self.robot.name, self.robot.n_commands, simulator.n_readouts)
        answer = simulator.answer(action, uniforms[self.robot.noise_size], state.neurons)
        command = decode(self.mapping, answer.rate_hz, simulator.percentiles)
        return Responded(action, answer, command)


@dataclass(frozen=True)
class WithoutNeurons(Environment[RobotState]):
    """The baseline: the agent moves the robot directly, by one of a few commands or by continuous ones.

    Attributes:
        commands: the commands to pick from, such as (-1, 1) for the cartpole; None: continuous commands in [-1, 1], as
            many as the robot takes.

    Raises:
        InvalidArgument: for anything but a robot, commands that are not from -1 to 1, or commands to pick from with a
            robot that takes several at once.
    """

    robot: Robot[RobotState]
    commands: tuple[float, ...] | None

    def __post_init__(self) -> None:
        check_argument("robot", self.robot, Robot)
        if self.commands is not None:
            check_argument("commands", self.commands, tuple)
            # A list would not be hashed, as static arguments under jit are.
            object.__setattr__(self, "commands", tuple(self.commands))
            numbers = [u for u in self.commands if isinstance(u, float | int | np.number) and -1 <= u <= 1]
            if not self.commands or len(numbers) < len(self.commands):
                raise InvalidArgument(f"commands: expected numbers from -1 to 1, at least one, got {self.commands}")
            expect_one_command(self.robot.name, self.robot.n_commands)

    @property
    def n_actions(self) -> int | None:
        return None if self.commands is None else len(self.commands)

    @property
    def noise_size(self) -> int:
        return self.robot.noise_size

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        no_answer = Answer(jnp.full(self.robot.command_shape, jnp.nan, jnp.float32), state.neurons)
        command = action if self.commands is None else jnp.asarray(self.commands, jnp.float32)[action]
        return Responded(action, no_answer, jnp.clip(command, -1.0, 1.0))
