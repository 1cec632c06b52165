"""Wrappers of an environment, which combine in any order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from animat.arguments import check_argument
from animat.environment import Animat, Environment, Neurons, Responded, RobotState, State, Uniforms
from animat.errors import InvalidArgument
from animat.robots.base import Quantity, Robot, capability
from animat.robots.host import HostRobot

Delivery = Literal["chosen", "shuffled"]
"""The condition that the neurons get: the one chosen, or one drawn at random (`ShuffledDelivery`)."""


@dataclass(frozen=True)
class Wrapper(Environment[RobotState]):
    """An environment that passes everything on to another, `inside`; each subclass changes something."""

    inside: Environment[RobotState]

    def __post_init__(self) -> None:
        check_argument("inside", self.inside, Environment)

    @property
    def robot(self) -> Robot[RobotState]:  # type: ignore[override]  # read-only, as in every frozen dataclass
        return self.inside.robot

    @property
    def n_actions(self) -> int | None:
        return self.inside.n_actions

    @property
    def noise_size(self) -> int:
        return self.inside.noise_size

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return self.inside.observation_spec

    def observe(self, state: State) -> Float[Array, " observations"]:
        return self.inside.observe(state)

    def reset(self, key: PRNGKeyArray) -> State:
        return self.inside.reset(key)

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        return self.inside.respond(uniforms, state, action, simulator)

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        return self.inside.advance(uniforms, state, action, simulator)


def unwrapped(environment: Environment[RobotState], to: type[Wrapper[Any]] | tuple[()] = ()) -> Environment[RobotState]:
    """The first wrapper of that kind, or, without one, the environment inside all: `Animat` or `WithoutNeurons`."""
    while isinstance(environment, Wrapper) and not isinstance(environment, to):
        environment = environment.inside
    return environment


@final
@dataclass(frozen=True)
class EpisodeLimit(Wrapper[RobotState]):
    """Truncates an episode at the robot's `episode_limit`, unless the task ends by itself.

    Attributes:
        inside: the environment that it is put around, such as an `Animat`.
    """

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        after = self.inside.advance(uniforms, state, action, simulator)
        truncated = (after.iteration >= self.robot.episode_limit) & ~after.ended.terminated
        return after._replace(ended=after.ended._replace(truncated=truncated))


@dataclass(frozen=True)
class NeuralWrapper(Wrapper[RobotState]):
    """A wrapper of an environment with neurons; raises InvalidArgument around any other."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(inmost := unwrapped(self), Animat):
            raise InvalidArgument(f"inside: expected an Animat, which has neurons, got {type(inmost).__name__}")


@final
@dataclass(frozen=True)
class ShuffledDelivery(NeuralWrapper[RobotState]):
    """Delivers a random condition at each iteration, whatever was chosen: the paper's control (section 3.2).

    Attributes:
        inside: the environment that it is put around.

    Raises:
        InvalidArgument: around an environment without neurons.
    """

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        return self.inside.respond(uniforms, state, self._drawn(uniforms), simulator)

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        return self.inside.advance(uniforms, state, self._drawn(uniforms), simulator)

    def _drawn(self, uniforms: Uniforms) -> Array:
        n = self.n_actions or 0
        return jnp.minimum((uniforms[-1] * n).astype(jnp.int32), n - 1)


@final
@dataclass(frozen=True)
class NeuralObservation(NeuralWrapper[RobotState]):
    """Appends the history state of the neurons (`State.neurons`) to the observation.

    A simulator's next answer depends on trace and load alone; a simulator without memory leaves both at 0.5.

    Attributes:
        inside: the environment that it is put around.

    Raises:
        InvalidArgument: around an environment without neurons.
    """

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        trace, load = Quantity("trace", "1", 1.0, 0.0, 1.0), Quantity("load", "1", 1.0, 0.0)
        return (*self.inside.observation_spec, trace, load)

    def observe(self, state: State) -> Float[Array, " observations"]:
        # With `YokedDelivery` inside, the agent is in the other episode.
        acting: State = state.info.get(_OTHER, state)  # type: ignore[assignment]
        return jnp.concatenate([self.inside.observe(state), acting.neurons])


@final
@dataclass(frozen=True)
class TrialCosts(NeuralWrapper[RobotState]):
    """Adds up the cost of an episode's trials in `State.info["cost"]`; rewards are unchanged (see `net_reward`).

    `costs` are those of a trial of each condition, in the units of the reward.
    """

    costs: tuple[float, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.costs) != self.n_actions:
            raise InvalidArgument(f"costs: expected one for each of {self.n_actions} conditions, got {self.costs}")

    def reset(self, key: PRNGKeyArray) -> State:
        return _remembering(self.inside.reset(key), {_COST: jnp.float32(0.0)})

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        after = self.inside.advance(uniforms, state, action, simulator)
        return add_cost(after, self.of(after.info["delivered"]))

    def of(self, delivered: Array) -> Array:
        """The cost of trials of these conditions."""
        return jnp.asarray(self.costs, jnp.float32)[delivered]


def net_reward(before: State, after: State) -> Array:
    """The reward of an iteration less the cost of its trial, if costs are counted (`TrialCosts`)."""
    return after.reward - (after.info[_COST] - before.info[_COST]) if _COST in after.info else after.reward


def net_return(returns: Array, after: State) -> Array:
    """The return of an episode so far less the cost of its trials, if costs are counted."""
    return returns - after.info[_COST] if _COST in after.info else returns


def add_cost(state: State, more: Array) -> State:
    """Add the cost of another trial to a state, for bodies stepped outside JAX."""
    return _remembering(state, {_COST: state.info[_COST] + more})


@final
@dataclass(frozen=True)
class YokedDelivery(NeuralWrapper[RobotState]):
    """Delivers the stimuli chosen for another episode, which runs in parallel: as many, but unrelated to this one.

    The agent observes and acts in the other episode, with its own neurons; when it ends it starts again. The same
    stimuli are delivered here, whatever happens here. Refuses a robot that is stepped outside JAX.

    Source: the non-contingent control of Bakkum et al. 2008, doi:10.1088/1741-2560/5/3/004.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.robot, HostRobot):
            raise InvalidArgument(f"robot: expected one that is stepped in JAX, got {self.robot.name}, which is not")

    @property
    def noise_size(self) -> int:
        return 2 * self.inside.noise_size

    def observe(self, state: State) -> Float[Array, " observations"]:
        return self.inside.observe(state.info[_OTHER])  # type: ignore[arg-type]

    def reset(self, key: PRNGKeyArray) -> State:
        state, other = self.inside.reset(key), self.inside.reset(jax.random.fold_in(key, 1)).carried
        return _remembering(state, {_OTHER: other, _START: other})

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        n, other = self.inside.noise_size, state.info[_OTHER]
        other_after = self.inside.advance(uniforms[n:], other, action, simulator)  # type: ignore[arg-type]
        next_ = _where(jnp.logical_or(*other_after.ended), state.info[_START], other_after.carried)
        return _remembering(self.inside.advance(uniforms[:n], state, action, simulator), {_OTHER: next_})


@final
@dataclass(frozen=True)
class GoalSwitch(Wrapper[RobotState]):
    """Gives the robot another goal after `at` iterations, that of the first other start whose goal looks different."""

    at: int

    def __post_init__(self) -> None:
        super().__post_init__()
        capability(self.robot, "with_goal_of")

    def reset(self, key: PRNGKeyArray) -> State:
        state = self.inside.reset(key)
        return _remembering(state, {_GOAL: other_goal(self.robot, state.robot, jax.random.fold_in(key, 1))})

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> State:
        after = self.inside.advance(uniforms, state, action, simulator)
        switched = capability(self.robot, "with_goal_of")(after.robot, after.info[_GOAL])
        return after._replace(robot=_where(after.iteration == self.at, switched, after.robot))


@final
@dataclass(frozen=True)
class ReversedMapping(Animat[RobotState]):
    """Reverses the mapping: every response moves the robot by the opposite command."""

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        responded = super().respond(uniforms, state, action, simulator)
        return responded._replace(command=-responded.command)


@final
@dataclass(frozen=True)
class IdealActuator(Animat[RobotState]):
    """Moves the robot by the `commands` of the condition (several: a tuple) in place of the response."""

    commands: tuple[float | tuple[float, ...], ...]

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: Neurons) -> Responded:
        responded = super().respond(uniforms, state, action, simulator)
        return responded._replace(command=jnp.asarray(self.commands, jnp.float32)[action])


def replace_innermost(
    environment: Environment[RobotState], change: Callable[[Environment[RobotState]], Environment[RobotState]]
) -> Environment[RobotState]:
    """The environment with its wrappers around a changed innermost one."""
    if isinstance(environment, Wrapper):
        return replace(environment, inside=replace_innermost(environment.inside, change))
    return change(environment)


STARTS = 16
"""Starts among which another goal is sought: of two equally likely goals, the other is missed once in 65,000 times."""


def other_goal(robot: Robot[RobotState], own: RobotState, key: PRNGKeyArray) -> RobotState:
    """A start of the robot whose goal differs from its own in the observation."""
    starts = jax.vmap(robot.reset)(jax.random.split(key, STARTS))
    switched = jax.vmap(capability(robot, "with_goal_of"), (None, 0))(own, starts)
    is_other = jnp.any(jax.vmap(robot.observe)(switched) != robot.observe(own), axis=-1)
    return jax.tree.map(lambda x: x[jnp.argmax(is_other)], starts)  # type: ignore[no-any-return]


_OTHER, _START, _GOAL, _COST = "other_episode", "other_start", "other_goal", "cost"
"""In `State.info`: the other episode and its start; the state whose goal is switched to; and the cost of trials."""


def _remembering(state: State, remembered: dict[str, Any]) -> State:
    return state._replace(info={**state.info, **remembered})


def _where(condition: Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(partial(jnp.where, condition), yes, no)
