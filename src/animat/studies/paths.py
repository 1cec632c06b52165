"""Single episodes with all that happened in them, for pictures and tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int64

from animat.environment import Environment
from animat.evaluation.host_rollouts import paths_on_host
from animat.evaluation.rollouts import Actor
from animat.neurons.simulator import NeuronSimulator
from animat.robots.host import HostRobot
from animat.studies.results import read_arrays, write_arrays


@dataclass(frozen=True, eq=False)
class Paths:
    """One episode of each of several actors.

    Attributes:
        observations: before each iteration and after the last, shape (actors, iterations + 1, observations).
        commands: u of each iteration, shape (actors, iterations).
        lengths: iterations of each episode; what comes after them means nothing, shape (actors,).
    """

    observations: Float[np.ndarray, "actors iterations+1 observations"]
    commands: Float[np.ndarray, "actors iterations"]
    lengths: Int64[np.ndarray, " actors"]

    def save(self, path: Path) -> Path:
        """Write it, complete or absent."""
        return write_arrays(path, vars(self))

    @staticmethod
    def load(path: Path) -> Paths:
        """Read what `save` wrote; raises InvalidFile if it cannot be read."""
        return Paths(**read_arrays(path))

    def whole(self) -> list[tuple[np.ndarray, list[float]]]:
        """Observations and commands of each actor, up to the end of its episode."""
        return [
            (observations[: length + 1], commands[:length].tolist())
            for observations, commands, length in zip(self.observations, self.commands, self.lengths, strict=True)
        ]


def record_paths(
    environment: Environment[Any], simulator: NeuronSimulator | None, actors: Actor, n_actors: int, seed: int
) -> Paths:
    """Run one episode of each actor; arguments as in `animat.evaluation.rollouts.roll_out`."""
    keys = jax.random.split(jax.random.key(seed), n_actors)
    if isinstance(environment.robot, HostRobot):
        return Paths(*paths_on_host(environment, simulator, actors, keys, seed))
    observations, commands, lengths = _record(environment, simulator, actors, keys)
    return Paths(np.asarray(observations), np.asarray(commands), np.asarray(lengths, np.int64))


@partial(jax.jit, static_argnums=0)
def _record(environment: Environment[Any], simulator: NeuronSimulator | None, actors: Actor, keys: Any) -> Any:
    n_drawn = environment.n_drawn

    def one_actor(actor: Actor, key: Any) -> Any:
        def iteration(carry: Any, key: Any) -> Any:
            state, going = carry
            uniforms = jax.random.uniform(key, (n_drawn + environment.noise_size,))
            observation = environment.observe(state)
            action = actor.act(environment, (observation / environment.scales)[None], uniforms[None, :n_drawn])[0]
            after = environment.advance(uniforms[n_drawn:], state, action, simulator)
            still = going & ~jnp.logical_or(*after.ended)
            return (after.carried, still), (environment.observe(after), after.info["command"], going)

        start, key = jax.random.split(key)
        state = environment.reset(start).carried
        keys = jax.random.split(key, environment.robot.episode_limit)
        _, (after, commands, going) = jax.lax.scan(iteration, (state, jnp.bool_(True)), keys)
        return jnp.concatenate([environment.observe(state)[None], after]), commands, going.sum()

    return jax.vmap(one_actor)(actors, keys)
