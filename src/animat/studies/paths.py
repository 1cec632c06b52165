"""Single episodes with all observations and commands, for figures and tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int64

from animat.environment import Environment
from animat.evaluation.host_rollouts import paths_on_host
from animat.evaluation.rollouts import Actor, trace
from animat.neurons.simulator import NeuronSimulator
from animat.robots.host import HostRobot


@dataclass(frozen=True, eq=False)
class Paths:
    """One episode of each of several actors.

    Attributes:
        observations: before each iteration and after the last, shape (actors, iterations + 1, observations).
        commands: u of each iteration, shape (actors, iterations), or (actors, iterations, commands) for several.
        lengths: iterations of each episode, shape (actors,); observations and commands beyond them are meaningless.
    """

    observations: Float[np.ndarray, "actors iterations+1 observations"]
    commands: Float[np.ndarray, "actors iterations *commands"]
    lengths: Int64[np.ndarray, " actors"]

    def episodes(self) -> list[tuple[np.ndarray, list[float]]]:
        """Observations and commands of each actor, up to the end of its episode."""
        return [
            (observations[: length + 1], commands[:length].tolist())
            for observations, commands, length in zip(self.observations, self.commands, self.lengths, strict=True)
        ]


def record_paths(environment: Environment[Any], simulator: NeuronSimulator | None, actors: Actor, seed: int) -> Paths:
    """Run one episode of each actor; arguments as for `animat.evaluation.rollouts.roll_out`."""
    if isinstance(environment.robot, HostRobot):
        keys = jax.random.split(jax.random.key(seed), actors.n_actors)
        return Paths(*paths_on_host(environment, simulator, actors, keys, seed))
    traced = trace(environment, simulator, actors, episodes=1, seed=seed)
    observations, commands, lengths = (each[:, 0] for each in (traced.observations, traced.commands, traced.lengths))
    return Paths(observations, commands, lengths.astype(np.int64))
