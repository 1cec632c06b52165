"""The Animat: neurons, mapping and robot as one environment that a policy acts in, pure and jittable."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from animat.coding.decoder import decoded, expect_fit, expect_one_command
from animat.coding.mapping import Mapping
from animat.errors import InvalidArgument
from animat.neurons.simulator import AT_FIRST, Answer, NeuronSimulator
from animat.robots.base import Robot

RobotState = TypeVar("RobotState")

Delivery = Literal["chosen", "shuffled"]

Uniforms = Float[Array, " noise"]
Number = Float[Array, ""]
Command = Float[Array, "*commands"]
Actuated = tuple[Array, Answer, Command]


class EpisodeState(NamedTuple):
    """Where an episode stands: the robot's state, the iterations done, and what the neurons remember.

    Attributes:
        robot: the state of the robot.
        iteration: how many are done.
        past: in [0, 1], see `animat.neurons.simulator.Answer`.
    """

    robot: Any
    iteration: Int[Array, ""]
    past: Number


class Outcome(NamedTuple):
    """What one iteration did.

    Attributes:
        state: after it.
        reward: in the task's own units.
        terminated: the task ended by itself (fell, reached).
        truncated: the episode limit ended it; never together with `terminated`.
        delivered: the condition that reached the neurons (the action itself, where there are none).
        rate_hz: the response x, Hz per channel (NaN without neurons); of several readouts, shape (readouts,).
        command: the motor command u in [-1, 1]; of several, shape (commands,).
    """

    state: EpisodeState
    reward: Number
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    delivered: Array
    rate_hz: Float[Array, "*readouts"]
    command: Command


class Environment(abc.ABC, Generic[RobotState]):
    """What a policy acts in: a robot, moved through neurons (`Animat`) or directly (`WithoutNeurons`).

    Everything in it is static; the simulator is an argument of each step, so refreshing it changes data, not code.
    """

    robot: Robot[RobotState]

    @property
    @abc.abstractmethod
    def n_actions(self) -> int | None:
        """How many discrete actions there are; None: continuous ones in [-1, 1], one a command."""

    @property
    @abc.abstractmethod
    def noise_size(self) -> int:
        """How many uniforms in [0, 1) one iteration consumes."""

    @abc.abstractmethod
    def actuate(self, uniforms: Uniforms, past: Number, action: Array, simulator: NeuronSimulator | None) -> Actuated:
        """Turn an action into (what was delivered, the answer after a past, the command in [-1, 1])."""

    @property
    def n_drawn(self) -> int:
        """How many uniforms drawing an action takes: one, or one for each continuous command."""
        return 1 if self.n_actions is not None else self.robot.n_commands

    @property
    def n_observations(self) -> int:
        """How many numbers a policy sees."""
        return len(self.robot.quantities)

    @property
    def scales(self) -> Float[np.ndarray, " observations"]:
        """What a policy divides an observation by, so that its numbers are of order one."""
        return np.array([quantity.scale for quantity in self.robot.quantities], np.float32)

    @final
    def reset(self, key: PRNGKeyArray) -> EpisodeState:
        """Start an episode."""
        return EpisodeState(self.robot.reset(key), jnp.int32(0), jnp.float32(AT_FIRST))

    @final
    def step(self, key: PRNGKeyArray, state: EpisodeState, action: Array, simulator: NeuronSimulator | None) -> Outcome:
        """One iteration: action, response, command, movement."""
        return self.advance(jax.random.uniform(key, (self.noise_size,)), state, action, simulator)

    @final
    def advance(
        self,
        uniforms: Uniforms,
        state: EpisodeState,
        action: Array,
        simulator: NeuronSimulator | None,
    ) -> Outcome:
        """The same with the random numbers handed in: training draws them for many iterations at once."""
        of_robot = self.robot.noise_size
        delivered, answer, command = self.actuate(uniforms[of_robot:], state.past, action, simulator)
        robot, reward, terminated = self.robot.advance(uniforms[:of_robot], state.robot, command)
        iteration = state.iteration + 1
        truncated = (iteration >= self.robot.episode_limit) & ~terminated
        after = EpisodeState(robot, iteration, answer.past)
        return Outcome(after, reward, terminated, truncated, delivered, answer.rate_hz, command)

    @final
    def observe(self, state: EpisodeState) -> Float[Array, " observations"]:
        """The robot's observation in its own units."""
        return self.robot.observe(state.robot)


@dataclass(frozen=True)
class Animat(Environment[RobotState]):
    """A robot that moves as neurons answer to the condition the agent picks.

    Attributes:
        robot: the body and its task.
        mapping: from the response of a readout to a motor command.
        n_conditions: how many conditions the agent picks from.
        delivery: `"chosen"`: the neurons get the agent's condition; `"shuffled"`: one drawn anew at each iteration,
            whatever the agent chose (the paper's control condition, section 3.2).
    """

    robot: Robot[RobotState]
    mapping: Mapping
    n_conditions: int
    delivery: Delivery = "chosen"

    @property
    def n_actions(self) -> int:
        return self.n_conditions

    @property
    def noise_size(self) -> int:
        return self.robot.noise_size + 2

    def actuate(self, uniforms: Uniforms, past: Number, action: Array, simulator: NeuronSimulator | None) -> Actuated:
        if simulator is None:
            raise InvalidArgument("simulator: an Animat needs the neurons to answer, got None")
        if self.delivery == "shuffled":
            action = jnp.minimum((uniforms[1] * self.n_conditions).astype(jnp.int32), self.n_conditions - 1)
        expect_fit(self.robot.name, self.robot.n_commands, simulator.n_readouts)
        answer = simulator.answer(action, uniforms[0], past)
        return action, answer, decoded(self.mapping, answer.rate_hz, simulator.percentiles)


@dataclass(frozen=True)
class WithoutNeurons(Environment[RobotState]):
    """The baseline: the agent moves the robot directly, by one of a few commands or by continuous ones.

    Attributes:
        robot: the body and its task.
        commands: the commands to pick from, such as (-1, 1) for the cartpole; None: any in [-1, 1], of as many
            dimensions as the robot takes commands.

    Raises:
        InvalidArgument: for commands to pick from, and a robot that takes several at once.
    """

    robot: Robot[RobotState]
    commands: tuple[float, ...] | None

    def __post_init__(self) -> None:
        if self.commands is not None:
            expect_one_command(self.robot.name, self.robot.n_commands)

    @property
    def n_actions(self) -> int | None:
        return None if self.commands is None else len(self.commands)

    @property
    def noise_size(self) -> int:
        return self.robot.noise_size

    def actuate(self, uniforms: Uniforms, past: Number, action: Array, simulator: NeuronSimulator | None) -> Actuated:
        command = action if self.commands is None else jnp.asarray(self.commands, jnp.float32)[action]
        return action, Answer(jnp.float32(jnp.nan), past), jnp.clip(command, -1.0, 1.0)
