"""Robots with a task so small that what a learner must end in is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, final

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from animat.robots.base import Quantity, Robot


class Counted(NamedTuple):
    """How many iterations the episode has lasted."""

    iteration: Float[Array, ""]


@final
@dataclass(frozen=True)
class Payer(Robot[Counted]):
    """Pays the command times `pay` at each iteration, whatever happened before.

    Attributes:
        ends: whether every iteration terminates the episode.
        shows_iteration: whether the observation is the iteration; else it is always 1, and there is only one state.
    """

    pay: float = 1.0
    ends: bool = False
    shows_iteration: bool = False
    episode_limit: int = 10**9

    name: ClassVar[str] = "payer"
    noise_size: ClassVar[int] = 1
    paper_iterations: ClassVar[int] = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("iteration", "1", 2.0),)

    def reset(self, key: Array) -> Counted:
        return Counted(jnp.zeros(()))

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: Counted, u: Float[Array, ""]
    ) -> tuple[Counted, Float[Array, ""], Bool[Array, ""]]:
        return Counted(state.iteration + 1), self.pay * u, jnp.bool_(self.ends)

    def observe(self, state: Counted) -> Float[Array, " observations"]:
        return jnp.stack([state.iteration if self.shows_iteration else jnp.float32(2.0)])


@final
@dataclass(frozen=True)
class Follower(Robot[Counted]):
    """Shows a number in [-1, 1] and pays more, the nearer the command is to it; 5 iterations an episode."""

    episode_limit: int = 5

    name: ClassVar[str] = "follower"
    noise_size: ClassVar[int] = 1
    paper_iterations: ClassVar[int] = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("wanted", "1", 1.0),)

    def reset(self, key: Array) -> Counted:
        return Counted(jnp.float32(0.5))

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: Counted, u: Float[Array, ""]
    ) -> tuple[Counted, Float[Array, ""], Bool[Array, ""]]:
        return Counted(2 * uniforms[0] - 1), 1 - jnp.abs(state.iteration - u), jnp.bool_(False)

    def observe(self, state: Counted) -> Float[Array, " observations"]:
        return jnp.stack([state.iteration])


class TwoCounted(NamedTuple):
    """Two numbers."""

    wanted: Float[Array, "2"]


@dataclass(frozen=True)
class FollowerOfTwo(Robot[TwoCounted]):
    """Shows two numbers in [-1, 1] and pays more, the nearer each of two commands is to its own."""

    episode_limit: int = 5

    name: ClassVar[str] = "follower of two"
    n_commands: ClassVar[int] = 2
    noise_size: ClassVar[int] = 2
    paper_iterations: ClassVar[int] = 1

    @property
    def observation_spec(self) -> tuple[Quantity, ...]:
        return (Quantity("wanted", "1", 1.0), Quantity("wanted too", "1", 1.0))

    def reset(self, key: Array) -> TwoCounted:
        return TwoCounted(jnp.array([0.5, -0.5], jnp.float32))

    def advance(
        self, uniforms: Float[Array, " noise_size"], state: TwoCounted, u: Float[Array, " commands"]
    ) -> tuple[TwoCounted, Float[Array, ""], Bool[Array, ""]]:
        return TwoCounted(2 * uniforms - 1), 1 - jnp.mean(jnp.abs(state.wanted - u)), jnp.bool_(False)

    def observe(self, state: TwoCounted) -> Float[Array, " observations"]:
        return state.wanted
