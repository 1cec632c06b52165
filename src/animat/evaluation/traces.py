"""Episodes recorded step by step."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped

from animat.environment import Environment, State
from animat.evaluation.rollouts import Actor
from animat.neurons.simulator import NeuronSimulator


class Traces(NamedTuple):
    """Episodes of several actors; entries after the end of an episode are meaningless.

    Attributes:
        states: before each iteration and after the last (`State.carried`), each array with the axes of `observations`.
        observations: of these states.
        actions: chosen in each iteration.
        commands: u of each iteration.
        lengths: iterations of each episode.
    """

    states: State
    observations: Float[np.ndarray, "actors episodes iterations+1 observations"]
    actions: Shaped[np.ndarray, "actors episodes iterations *commands"]
    commands: Float[np.ndarray, "actors episodes iterations *commands"]
    lengths: Int[np.ndarray, "actors episodes"]


def trace(
    environment: Environment[Any],
    simulator: NeuronSimulator | None,
    actors: Actor,
    *,
    episodes: int,
    seed: int,
) -> Traces:
    """Run episodes of each actor on a robot in JAX; arguments as in `animat.evaluation.rollouts.roll_out`."""
    n_actors = actors.n_actors
    keys = jax.random.split(jax.random.key(seed), n_actors * episodes).reshape(n_actors, episodes)
    traced: Traces = jax.device_get(_trace(environment, simulator, actors, keys))
    return traced


@partial(jax.jit, static_argnums=0)
def _trace(environment: Environment[Any], simulator: NeuronSimulator | None, actors: Actor, keys: Any) -> Traces:
    n_drawn = environment.n_drawn

    def one_episode(actor: Actor, key: Any) -> Traces:
        def iteration(carry: Any, key: Any) -> Any:
            state, going = carry
            uniforms = jax.random.uniform(key, (n_drawn + environment.noise_size,))
            observation = environment.observe(state) / environment.scales
            action = actor.act(environment, observation[None], uniforms[None, :n_drawn])[0]
            after = environment.advance(uniforms[n_drawn:], state, action, simulator)
            still = going & ~jnp.logical_or(*after.ended)
            return (after.carried, still), (after.carried, action, after.info["command"], going)

        start, key = jax.random.split(key)
        first = environment.reset(start).carried
        keys = jax.random.split(key, environment.robot.episode_limit)
        _, (after, actions, commands, going) = jax.lax.scan(iteration, (first, jnp.bool_(True)), keys)
        states = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, after)
        observations: Any = jax.vmap(environment.observe)(states)
        return Traces(states, observations, actions, commands, going.sum())

    return jax.vmap(lambda actor, of_actor: jax.vmap(partial(one_episode, actor))(of_actor))(actors, keys)
