"""Soft Actor-Critic for bodies that are stepped outside JAX: acting and learning are compiled, the bodies are not.

A round is divided where the bodies move: one compiled program takes what they did, learns, and acts for the next one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from animat.compilation import jit_side_by_side
from animat.environment import Environment, Neurons
from animat.neurons.history import INITIAL_HISTORY
from animat.robots.host import Bodies, BodiesSnapshot, HostRobot
from animat.training.replay import pack_transitions
from animat.training.sac import Finished, Learner, begin, choose_actions, critic_state, draw_uniforms, end_round, learn
from animat.training.settings import SAC
from animat.wrappers import TrialCosts, add_cost


class Actions(NamedTuple):
    """A policy's actions in a round, with the history state of the neurons after them; trials may be free of cost."""

    action: Array
    command: Float[Array, "environments *commands"]
    neurons: Float[Array, "environments 2"]
    cost: Float[Array, " environments"] | None = None


def act(environment: Environment[Any], settings: SAC, learner: Learner, simulator: Neurons) -> tuple[Learner, Actions]:
    """The actions of a round; arguments as in `animat.training.sac.train_chunk`."""
    key, use = jax.random.split(learner.key)
    for_acting, _ = draw_uniforms(environment, settings, use)
    return _act(environment, learner._replace(key=key), simulator, for_acting)


def learn_and_act(
    environment: Environment[Any],
    settings: SAC,
    learner: Learner,
    acted: Actions,
    moved: tuple[Any, Array],
    simulator: Neurons,
    index: Int[Array, ""],
) -> tuple[Learner, Actions, Finished]:
    """Store a round, learn from the replay, and act in the next round.

    `moved` is what the bodies did: their `StepResult`, and what is observed once ended episodes have restarted.
    """
    key, use = jax.random.split(learner.key)
    for_acting, for_learning = draw_uniforms(environment, settings, use)
    before, ((observation, reward, terminated, truncated), begun) = learner.episodes, moved
    ended = terminated | truncated
    after = before._replace(robot=observation, iteration=before.iteration + 1, neurons=acted.neurons, reward=reward)
    net = reward
    if acted.cost is not None:
        after, net = add_cost(after, acted.cost), reward - acted.cost
    state, next_state = critic_state(environment, before), critic_state(environment, after)
    # Critics see the time left: the return ends at the limit. Where the body truncates an episode earlier, it does not.
    is_last = terminated | (after.iteration >= environment.robot.episode_limit)
    rows = pack_transitions(settings, state, next_state, acted.action, net, is_last)
    episodes = before._replace(
        robot=begun,
        iteration=jnp.where(ended, 0, after.iteration),
        neurons=jnp.where(ended[:, None], jnp.array(INITIAL_HISTORY, jnp.float32), after.neurons),
        info=jax.tree.map(lambda cost: jnp.where(ended, 0.0, cost), after.info),
    )
    learner, finished = end_round(settings, learner._replace(key=key), index, rows, after, ended, episodes)
    learner = learn(environment, settings, learner, index, for_learning)
    return *_act(environment, learner, simulator, for_acting), finished


def _act(
    environment: Environment[Any], learner: Learner, simulator: Neurons, uniforms: Array
) -> tuple[Learner, Actions]:
    observation = jax.vmap(environment.observe)(learner.episodes) / environment.scales
    learner, action, noise = choose_actions(environment, learner, observation, uniforms)
    responded = jax.vmap(environment.respond, (0, 0, 0, None))(noise, learner.episodes, action, simulator)
    return learner, Actions(
        action,
        responded.command,
        jnp.broadcast_to(responded.answer.history, (len(observation), 2)),
        environment.of(responded.delivered) if isinstance(environment, TrialCosts) else None,
    )


@lru_cache(maxsize=8)
def _compiled(environment: Environment[Any], algorithm: SAC) -> tuple[Callable[..., Any], ...]:
    """`begin`, `act` and `learn_and_act` for several policies."""
    return (
        jit_side_by_side(partial(begin, environment, algorithm)),
        jit_side_by_side(partial(act, environment, algorithm), (0, None), donate_argnums=0),
        jit_side_by_side(partial(learn_and_act, environment, algorithm), (0, 0, 0, None, None), donate_argnums=(0, 1)),
    )


class OnHost:
    """`begin` and `train_chunk` of `animat.training.sac` for policies of a robot that is stepped outside JAX.

    Between chunks the learners hold the bodies as data (`BodiesSnapshot`): checkpoints are like those of other robots.
    """

    def __init__(self, environment: Environment[Any], algorithm: SAC) -> None:
        assert isinstance(environment.robot, HostRobot)
        self._robot, self._n = environment.robot, algorithm.environments
        self._beginning, self._act, self._learn_and_act = _compiled(environment, algorithm)
        self._bodies: Bodies | None = None

    def begin(self, keys: PRNGKeyArray) -> Learner:
        # Seeds follow from each policy's key, like its other draws.
        policy_seeds = np.asarray(jax.random.key_data(keys)).astype(int).tolist()
        self._seeds = [(*seed, body) for seed in policy_seeds for body in range(self._n)]
        learners: Learner = self._beginning(keys)
        none = BodiesSnapshot.initial(self._robot, len(keys) * self._n)
        return learners._replace(episodes=learners.episodes._replace(robot=self._by_policy(none)))

    def train(self, learners: Learner, simulator: Neurons, first: Array, last: Array) -> tuple[Learner, Finished]:
        members = len(learners.returns)
        finished = Finished(np.zeros(members), np.zeros(members))  # type: ignore[arg-type]
        if int(last) == int(first):
            return learners, finished
        learners, bodies = self._restore(learners)
        learners, acted = self._act(learners, simulator)
        for index in range(int(first), int(last)):
            commands = np.asarray(acted.command).reshape(len(self._seeds), -1)
            stepped = bodies.step(commands)
            ended = np.flatnonzero(stepped.ended)
            begun = bodies.begin(ended.tolist()) if len(ended) else stepped.observation
            moved = self._by_policy((stepped._replace(reward=stepped.reward.astype(np.float32)), begun))
            learners, acted, of_round = self._learn_and_act(learners, acted, moved, simulator, np.int32(index))
            if len(ended):
                finished = Finished(*(a + np.asarray(b) for a, b in zip(finished, of_round, strict=True)))
        snapshot = self._by_policy(bodies.snapshot)
        return learners._replace(episodes=learners.episodes._replace(robot=snapshot)), finished

    def _restore(self, learners: Learner) -> tuple[Learner, Bodies]:
        """The bodies, created for the first chunk as the learners have them, and learners with their observations."""
        is_restored = True
        if self._bodies is None or not learners.episodes.robot.commands.shape[2]:
            flat = (np.asarray(part).reshape(len(self._seeds), *part.shape[2:]) for part in learners.episodes.robot)
            self._bodies = Bodies(self._robot, self._seeds)
            is_restored = self._bodies.restore(BodiesSnapshot(*flat))
        episodes = learners.episodes._replace(robot=self._by_policy(self._bodies.observation))
        if not is_restored:
            explored = learners.exploration
            explored = explored._replace(left=jnp.zeros_like(explored.left), was_held=jnp.zeros_like(explored.was_held))
            learners = learners._replace(returns=jnp.zeros_like(learners.returns), exploration=explored)
            episodes = episodes._replace(
                iteration=jnp.zeros_like(episodes.iteration),
                info=jax.tree.map(jnp.zeros_like, episodes.info),
                neurons=jnp.broadcast_to(jnp.array(INITIAL_HISTORY, jnp.float32), episodes.neurons.shape),
            )
        return learners._replace(episodes=episodes), self._bodies

    def _by_policy(self, flat: Any) -> Any:
        """Arrays of all bodies with a leading axis of policies."""
        return jax.tree.map(lambda part: np.reshape(part, (len(part) // self._n, self._n, *part.shape[1:])), flat)
