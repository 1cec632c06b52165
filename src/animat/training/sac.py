"""Soft Actor-Critic, whole: networks, replay, losses, and the loop of acting and learning, as one jittable chunk.

Discrete actions after Christodoulou (2019, arXiv:1910.07207), continuous ones after Haarnoja et al. (2018,
arXiv:1812.05905), with two critics, target critics that follow slowly, and an entropy bonus whose weight alpha is
learned so that the policy keeps a wanted entropy.

An episode is judged by its whole return up to a fixed length, and what pays depends on how much of it is left: near its
end a cart may roll where it would be lost later. So the critics see the time left and the return ends with the episode
(Pardo et al. 2018, arXiv:1712.00378); the actor, which is what is deployed, does not see it, and learns what is best on
average over the times at which a state comes up (critics that see more than the actor: Pinto et al. 2018,
arXiv:1710.06542).

Made for many small policies: everything of one policy is one pytree (`Learner`), so `jax.vmap` trains several side by
side; a transition is one packed row; the random numbers of an iteration are one block.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from animat.environment import Environment, State
from animat.neurons.simulator import NeuronSimulator
from animat.robots.base import Robot
from animat.training.exploration import Exploration, ended_episodes, explore, n_uniforms, nothing_held, paid_for_entropy
from animat.training.networks import Network, draw_action, forward, initial_networks, squashed_normal
from animat.training.replay import Batch, batch_of, remember, transitions
from animat.training.settings import SAC
from animat.wrappers import EpisodeLimit, net_return, net_reward


class Trained(NamedTuple):
    """What gradients change: the actor, two critics stacked, and the entropy bonus's weight."""

    actor: Network
    critics: Network
    log_alpha: Float[Array, ""]


class Learner(NamedTuple):
    """One policy while it is trained: everything that the next iteration depends on, and the actor to be deployed."""

    trained: Trained
    deployed: Network
    targets: Network
    optimiser: Any
    replay: Float[Array, "transitions row"]
    episodes: State
    returns: Float[Array, " environments"]
    exploration: Exploration
    key: PRNGKeyArray


class Finished(NamedTuple):
    """The policy's episodes that ended in a chunk of training: how many, and the sum of their returns, in task's units.

    What trials cost (`animat.wrappers.TrialCosts`) is learned from, and not taken off here.
    Those in which actions were held (`animat.training.exploration`) are not among them.
    """

    episodes: Float[Array, ""]
    returns: Float[Array, ""]


# --- losses ---------------------------------------------------------------------------------------------------------


def discrete_losses(
    trained: Trained, targets: Network, batch: Batch, settings: SAC, paid: Float[Array, ""] | float = 1.0
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The losses of critics, actor and alpha; each has a gradient for its own parameters only.

    With Q the smaller of the two critics (of the two target critics where it says Q_target), d for ended, s a state
    with its time left and o the observation in it:

    critics: sum_i mean (Q_i(s, a) - r - gamma (1 - d) sum_a' pi(a'|o') (Q_target(s', a') - k alpha log pi(a'|o')))^2/2
    actor:   mean sum_a pi(a|o) (alpha log pi(a|o) - Q(s, a))
    alpha:   mean log alpha (H(pi(.|o)) - H_wanted)

    with k = `paid`: 1, or 0 while entropy is not paid for (`learn`).
    """
    fixed = jax.lax.stop_gradient
    alpha = jnp.exp(fixed(trained.log_alpha))

    log_next = jax.nn.log_softmax(forward(fixed(trained.actor), batch.next_observation))
    next_q = jnp.min(forward(targets, batch.next_state), axis=0)
    next_value = jnp.sum(jnp.exp(log_next) * (next_q - paid * alpha * log_next), axis=-1)
    target = fixed(batch.reward + settings.discount * (1.0 - batch.ended) * next_value)
    q = forward(trained.critics, batch.state)
    taken = jax.nn.one_hot(batch.action.astype(jnp.int32), q.shape[-1])
    critic_loss = 0.5 * jnp.sum(jnp.mean((jnp.sum(q * taken, axis=-1) - target) ** 2, axis=-1))

    log_pi = jax.nn.log_softmax(forward(trained.actor, batch.observation))
    pi = jnp.exp(log_pi)
    actor_loss = jnp.mean(jnp.sum(pi * (alpha * log_pi - fixed(jnp.min(q, axis=0))), axis=-1))

    entropy = fixed(-jnp.sum(pi * log_pi, axis=-1))
    alpha_loss = trained.log_alpha * jnp.mean(entropy - settings.target_entropy_ratio * math.log(q.shape[-1]))
    return critic_loss, actor_loss, alpha_loss


def continuous_losses(
    trained: Trained,
    targets: Network,
    batch: Batch,
    uniforms: Float[Array, "2 batch commands"],
    settings: SAC,
    paid: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The same for continuous actions, with a' and a_new drawn from the policy (reparameterised).

    critics: sum_i mean (Q_i(s, a) - r - gamma (1 - d) (Q_target(s', a') - k alpha log pi(a'|o')))^2 / 2
    actor:   mean alpha log pi(a_new|o) - Q(s, a_new)
    alpha:   mean log alpha (-log pi(a_new|o) - H_wanted)
    """
    fixed = jax.lax.stop_gradient
    alpha = jnp.exp(fixed(trained.log_alpha))

    def critic(critics: Network, state: Array, action: Array) -> Float[Array, "2 batch"]:
        return forward(critics, jnp.concatenate([state, action], axis=1))[..., 0]

    next_action, log_next = squashed_normal(forward(fixed(trained.actor), batch.next_observation), uniforms[0])
    next_q = jnp.min(critic(targets, batch.next_state, next_action), axis=0)
    target = batch.reward + settings.discount * (1.0 - batch.ended) * (next_q - paid * alpha * log_next)
    q = critic(trained.critics, batch.state, batch.action)
    critic_loss = 0.5 * jnp.sum(jnp.mean((q - fixed(target)) ** 2, axis=-1))

    action, log_pi = squashed_normal(forward(trained.actor, batch.observation), uniforms[1])
    new_q = jnp.min(critic(fixed(trained.critics), batch.state, action), axis=0)
    actor_loss = jnp.mean(alpha * log_pi - new_q)

    alpha_loss = trained.log_alpha * jnp.mean(fixed(-log_pi) - settings.entropy_nats * action.shape[-1])
    return critic_loss, actor_loss, alpha_loss


# --- acting and learning --------------------------------------------------------------------------------------------


def begin(environment: EpisodeLimit[Any], settings: SAC, key: PRNGKeyArray) -> Learner:
    """A new policy that has learned nothing yet; every random draw of its training follows from `key`."""
    weight_key, reset_key, key = jax.random.split(key, 3)
    n, n_actions, hidden = len(environment.observation_spec), environment.n_actions, settings.hidden
    n_drawn = environment.n_drawn
    inputs, values, outputs = (n + 1 + n_drawn, 1, 2 * n_drawn) if n_actions is None else (n + 1, n_actions, n_actions)
    actor, critics = initial_networks(
        weight_key, ((n, hidden, hidden, outputs), ()), ((inputs, hidden, hidden, values), (2,))
    )
    trained = Trained(actor, critics, jnp.float32(math.log(settings.initial_alpha)))
    return Learner(
        trained=trained,
        deployed=actor,
        targets=critics,
        optimiser=_adam(settings).init(trained),
        replay=jnp.zeros((settings.replay, 2 * (n + 1) + n_drawn + 2)),
        episodes=jax.vmap(environment.reset)(jax.random.split(reset_key, settings.environments)).carried,
        returns=jnp.zeros(settings.environments),
        exploration=nothing_held(settings.environments, n_drawn),
        key=key,
    )


def train_chunk(
    environment: EpisodeLimit[Any],
    settings: SAC,
    learner: Learner,
    simulator: NeuronSimulator | None,
    first_round: Int[Array, ""],
    last_round: Int[Array, ""],
) -> tuple[Learner, Finished]:
    """Act and learn for some rounds with one simulator; in a round every environment does one iteration.

    Args:
        environment: what the policy acts in (static).
        settings: of the algorithm (static).
        learner: the policy under training.
        simulator: the neurons' answers during this chunk; None without neurons.
        first_round, last_round: the chunk is the rounds from the first up to, not including, the last; the same for
            all policies that are trained side by side.

    Returns:
        The learner after the chunk, and the episodes that ended in it.
    """
    # The uniforms that a round acts with and learns with: one block, drawn at once.
    acting, learning = uniforms_of(environment, settings)
    n_acting = math.prod(acting)

    def one_round(index: Int[Array, ""], carry: tuple[Learner, Finished]) -> tuple[Learner, Finished]:
        learner, before = carry
        key, use, reset_key = jax.random.split(learner.key, 3)
        uniforms = jax.random.uniform(use, (n_acting + math.prod(learning),))
        written = index * settings.environments
        learner, finished = _act(
            environment, settings, learner, simulator, written, uniforms[:n_acting].reshape(acting), reset_key
        )
        available = jnp.minimum(written + settings.environments, settings.replay)
        learner = learn(environment, settings, learner, available, uniforms[n_acting:].reshape(learning))
        learner = learner._replace(key=key, deployed=average(settings, learner.deployed, learner.trained.actor, index))
        return learner, jax.tree.map(jnp.add, before, finished)

    nothing = Finished(jnp.float32(0.0), jnp.float32(0.0))
    trained: tuple[Learner, Finished] = jax.lax.fori_loop(first_round, last_round, one_round, (learner, nothing))
    return trained


def uniforms_of(environment: Environment[Any], settings: SAC) -> tuple[tuple[int, int], tuple[int, int, int]]:
    """The shapes of the uniforms that a round acts with, and learns with."""
    blocks = 1 if environment.n_actions is not None else 1 + 2 * environment.n_drawn
    acting = (settings.environments, environment.n_drawn + n_uniforms(environment) + environment.noise_size)
    return acting, (settings.gradient_steps, blocks, settings.batch)


def _act(
    environment: EpisodeLimit[Any],
    settings: SAC,
    learner: Learner,
    simulator: NeuronSimulator | None,
    written: Int[Array, ""],
    uniforms: Float[Array, "environments noise"],
    reset_key: PRNGKeyArray,
) -> tuple[Learner, Finished]:
    """One step of every environment, remembered in the replay; ended episodes start anew."""
    state = state_of(environment, learner.episodes)
    action, exploration, noise = choose(environment, learner, state[:, :-1], uniforms)
    after = jax.vmap(environment.advance, (0, 0, 0, None))(noise, learner.episodes, action, simulator)
    ended = jnp.logical_or(*after.ended)
    reward = net_reward(learner.episodes, after)
    reward = shaped(environment.robot, settings, learner.episodes.robot, after.robot, reward, ended)
    rows = transitions(settings, state, state_of(environment, after), action, reward, ended)

    returns = learner.returns + after.reward
    started = jax.vmap(environment.reset)(jax.random.split(reset_key, settings.environments))
    learner = learner._replace(
        replay=remember(learner.replay, rows, written % settings.replay),
        episodes=jax.tree.map(lambda new, old: jax.vmap(jnp.where)(ended, new, old), started.carried, after.carried),
        returns=jnp.where(ended, 0.0, returns),
        exploration=ended_episodes(exploration, ended, net_return(returns, after)),
    )
    return learner, finished_alone(exploration, ended, returns)


def shaped(
    robot: Robot[Any],
    settings: SAC,
    before: Any,
    after: Any,
    reward: Float[Array, " environments"],
    ended: Bool[Array, " environments"],
) -> Float[Array, " environments"]:
    """Rewards as they are learned from, where the robot has a `potential`; the best policy is that of the rewards.

        r + gamma (1 - d) potential(s') - potential(s)

    with d for ended, in either way, as the losses have it. Along any episode the discounted terms add up to
    -potential(s_0), whatever is done (Ng, Harada & Russell 1999). No return that is reported has them.

    Args:
        before, after: states of the robot, each number with an axis of environments.
    """
    if not hasattr(robot, "potential"):
        return reward
    potential = jax.vmap(robot.potential)
    shaping: Array = settings.discount * jnp.where(ended, 0.0, potential(after)) - potential(before)
    return reward + shaping


def choose(
    environment: Environment[Any],
    learner: Learner,
    observation: Float[Array, "environments observations"],
    uniforms: Float[Array, "environments uniforms"],
) -> tuple[Array, Exploration, Float[Array, "environments noise"]]:
    """The actions of an iteration, what is held after them, and the uniforms that are left for the environments."""
    n_drawn = environment.n_drawn
    n_before = n_drawn + n_uniforms(environment)
    action = draw_action(environment, learner.trained.actor, observation, uniforms[:, :n_drawn])
    action, exploration = explore(environment, learner.exploration, action, uniforms[:, n_drawn:n_before])
    return action, exploration, uniforms[:, n_before:]


def finished_alone(
    exploration: Exploration, ended: Bool[Array, " environments"], returns: Float[Array, " environments"]
) -> Finished:
    """The episodes that the policy ended in an iteration, those apart in which actions were held."""
    alone = ended & ~exploration.was_held
    return Finished(jnp.sum(alone, dtype=jnp.float32), jnp.sum(jnp.where(alone, returns, 0.0)))


def state_of(environment: Environment[Any], episodes: State) -> Float[Array, "environments state"]:
    """What the critics see of episodes: scaled observations, and the time left."""
    left = 1.0 - 2.0 * episodes.iteration[:, None] / environment.robot.episode_limit
    return jnp.concatenate([jax.vmap(environment.observe)(episodes) / environment.scales, left], axis=1)


def learn(
    environment: Environment[Any],
    settings: SAC,
    learner: Learner,
    available: Int[Array, ""],
    uniforms: Float[Array, "gradient_steps blocks batch"],
) -> Learner:
    """`settings.gradient_steps` gradient steps on transitions drawn from the replay."""
    adam = _adam(settings)
    n_drawn, is_continuous = environment.n_drawn, environment.n_actions is None
    paid = paid_for_entropy(learner.exploration)

    def losses(trained: Trained, targets: Network, batch: Batch, noise: Array) -> Float[Array, ""]:
        if is_continuous:
            return sum(continuous_losses(trained, targets, batch, noise, settings, paid), jnp.float32(0.0))
        return sum(discrete_losses(trained, targets, batch, settings, paid), jnp.float32(0.0))

    def update(carry: tuple[Trained, Network, Any], uniforms: Float[Array, "blocks batch"]) -> tuple[Any, None]:
        trained, targets, optimiser = carry
        batch = batch_of(environment, learner.replay, available, uniforms[0])
        noise = uniforms[1:].reshape(-1, n_drawn, settings.batch).swapaxes(1, 2)
        gradient = jax.grad(losses)(trained, targets, batch, noise)
        steps, optimiser = adam.update(gradient, optimiser)
        trained = optax.apply_updates(trained, steps)
        targets = jax.tree.map(lambda t, c: t + settings.tau * (c - t), targets, trained.critics)
        return (trained, targets, optimiser), None

    (trained, targets, optimiser), _ = jax.lax.scan(
        update, (learner.trained, learner.targets, learner.optimiser), uniforms
    )
    return learner._replace(trained=trained, targets=targets, optimiser=optimiser)


def average(settings: SAC, deployed: Network, actor: Network, index: Int[Array, ""]) -> Network:
    """Polynomial-decay averaging (Shamir and Zhang 2013, arXiv:1212.1824): it forgets in proportion to its age.

    The last actor of a training is as good as its last few updates were lucky; the average is not. With k the
    averaging and t the rounds done: average += (k + 1) / (t + k) (actor - average), so that the first is taken whole.
    """
    rate = (settings.averaging_exponent + 1.0) / (index + 1.0 + settings.averaging_exponent)
    moved: Network = jax.tree.map(lambda average, new: average + rate * (new - average), deployed, actor)
    return moved


def _adam(settings: SAC) -> optax.GradientTransformation:
    # Flat, as one long vector compiles faster than nineteen arrays and runs as fast.
    # Gradients of a policy that has found nothing yet are all but 0; with a smaller epsilon Adam makes whole steps of
    # their noise, and in one navigation policy of twenty these put out every unit of the second layer, for good.
    return optax.flatten(optax.adam(settings.learning_rate, eps=1e-5))
