"""What may be put around an environment, each one thing, in any order and together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from animat.environment import Animat, Environment, Responded, RobotState, State, Uniforms
from animat.errors import InvalidArgument
from animat.neurons.simulator import NeuronSimulator
from animat.robots.base import Quantity, Robot

Delivery = Literal["chosen", "shuffled"]
"""What the neurons get: the condition that was chosen, or one drawn at random (`ShuffledDelivery`)."""


@dataclass(frozen=True)
class Wrapper(Environment[RobotState]):
    """An environment around another one, which it leaves as it is; each kind of wrapper changes something.

    Attributes:
        inside: the other one.
    """

    inside: Environment[RobotState]

    @property
    def robot(self) -> Robot[RobotState]:  # type: ignore[override]  # of a frozen dataclass it is not written either
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

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: NeuronSimulator | None) -> Responded:
        return self.inside.respond(uniforms, state, action, simulator)

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: NeuronSimulator | None) -> State:
        return self.inside.advance(uniforms, state, action, simulator)


def unwrapped(environment: Environment[RobotState]) -> Environment[RobotState]:
    """What is inside of all wrappers: an `Animat`, or one `WithoutNeurons`."""
    while isinstance(environment, Wrapper):
        environment = environment.inside
    return environment


@final
@dataclass(frozen=True)
class EpisodeLimit(Wrapper[RobotState]):
    """Cuts an episode off after the robot's `episode_limit`, unless the task ends by itself."""

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: NeuronSimulator | None) -> State:
        after = self.inside.advance(uniforms, state, action, simulator)
        truncated = (after.iteration >= self.robot.episode_limit) & ~after.ended.terminated
        return after._replace(ended=after.ended._replace(truncated=truncated))


@final
@dataclass(frozen=True)
class ShuffledDelivery(Wrapper[RobotState]):
    """Delivers a condition drawn anew at each iteration, whatever was chosen: the paper's control (section 3.2).

    Raises:
        InvalidArgument: around an environment without neurons.
    """

    def __post_init__(self) -> None:
        _expect_neurons(self)

    def respond(self, uniforms: Uniforms, state: State, action: Array, simulator: NeuronSimulator | None) -> Responded:
        return self.inside.respond(uniforms, state, self._drawn(uniforms), simulator)

    def advance(self, uniforms: Uniforms, state: State, action: Array, simulator: NeuronSimulator | None) -> State:
        return self.inside.advance(uniforms, state, self._drawn(uniforms), simulator)

    def _drawn(self, uniforms: Uniforms) -> Array:
        n = self.n_actions or 0
        return jnp.minimum((uniforms[-1] * n).astype(jnp.int32), n - 1)


@final
@dataclass(frozen=True)
class NeuralObservation(Wrapper[RobotState]):
    """Lets the policy see, after all else, what the neurons remember (`State.neurons`).

    Trace and load are all that a simulator's next answer depends on; one without memory leaves both at 0.5.

    Raises:
        InvalidArgument: around an environment without neurons.
    """

    def __post_init__(self) -> None:
        _expect_neurons(self)

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        trace, load = Quantity("trace", "1", 1.0, 0.0, 1.0), Quantity("load", "1", 1.0, 0.0)
        return (*self.inside.observation_spec, trace, load)

    def observe(self, state: State) -> Float[Array, " observations"]:
        return jnp.concatenate([self.inside.observe(state), state.neurons])


def _expect_neurons(wrapper: Wrapper[Any]) -> None:
    if not isinstance(inmost := unwrapped(wrapper), Animat):
        raise InvalidArgument(f"inside: expected an Animat, whose neurons answer, got {type(inmost).__name__}")
