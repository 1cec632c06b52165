"""Where the episodes of a session start: decided by its seed, and so known before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Array, Key

from animat.lazy import jax, jnp


@dataclass(frozen=True)
class Starts:
    """The starts of the first `rounds` episodes of each agent: all agents of a round have the same one.

    `entropy` decides them, together with the round's number.
    """

    entropy: int
    rounds: int

    @classmethod
    def of_session(cls, seed: int, rounds: int) -> Self:
        """The starts in a session with that seed."""
        return cls(int(robot_generator(seed).integers(2**31)), rounds)

    def of_episodes(self, episodes: int) -> Key[Array, " episodes"]:
        """The key from which each of several episodes starts, one round after the other, again and again."""
        rounds = jnp.arange(episodes) % self.rounds
        return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(self.entropy), rounds)

    def seeds_of(self, episodes: Sequence[int]) -> list[tuple[int, int]]:
        """The seeds of bodies outside JAX in these episodes, by their numbers."""
        return [(self.entropy, episode % self.rounds) for episode in episodes]


def robot_generator(seed: int) -> np.random.Generator:
    """What draws a robot's starts and noise in a session with that seed."""
    return np.random.default_rng([seed, 22])
