"""The whole of Soft Actor-Critic: losses, the loop of acting and learning as one jittable chunk, and its diagnosis.

Discrete actions after Christodoulou (2019, arXiv:1910.07207), continuous ones after Haarnoja et al. (2018,
arXiv:1812.05905), with two critics, slowly moving target critics, and an entropy bonus whose weight alpha is learned so
that the policy holds a target entropy.

An episode is judged by its whole return up to a fixed length, and the best action depends on how much of it is left:
near the end a cart may roll to where it would be lost later. The critics therefore see the time left, and the return
ends with the episode (Pardo et al. 2018, arXiv:1712.00378). The actor, which is deployed, does not see it, and learns
what is best on average over the times at which a state occurs (critics that see more than the actor: Pinto et al. 2018,
arXiv:1710.06542).

Designed for many small policies: one policy is one pytree (`Learner`), so `jax.vmap` trains several side by side; a
transition is one packed row; the random numbers of a round are one block.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from animat.compilation import jit_side_by_side
from animat.environment import Environment, Neurons, State
from animat.neurons.simulator import Index
from animat.robots.base import Robot
from animat.training.exploration import Exploration, count_ended, entropy_factor, explore, n_uniforms, nothing_held
from animat.training.networks import Network, draw_action, forward, initial_networks, squashed_normal
from animat.training.replay import Batch, Flags, PerEnvironment, Rows, States, draw_batch, pack_transitions, remember
from animat.training.settings import SAC
from animat.wrappers import EpisodeLimit, net_return, net_reward

_TRANSITIONS = 512
"""Number of transitions drawn for a diagnosis, which then takes less than 1 % of a chunk of the usual length."""


class Parameters(NamedTuple):
    """The trained parameters: the actor, two stacked critics, and the log of the entropy bonus's weight."""

    actor: Network
    critics: Network
    log_alpha: Float[Array, ""]


class Learner(NamedTuple):
    """One policy during training: everything that the next iteration depends on, and the actor to be deployed."""

    trained: Parameters
    deployed: Network
    targets: Network
    optimiser: Any
    replay: Float[Array, "transitions row"]
    episodes: State
    returns: PerEnvironment
    exploration: Exploration
    key: PRNGKeyArray


class Finished(NamedTuple):
    """The number of the policy's episodes that ended in a chunk, and the sum of their returns, in the task's units.

    Costs of trials (`TrialCosts`) are not subtracted; episodes in which actions were held (`Exploration`) are excluded.
    """

    episodes: Float[Array, ""]
    returns: Float[Array, ""]


def discrete_losses(
    trained: Parameters, targets: Network, batch: Batch, settings: SAC, paid: Float[Array, ""] | float = 1.0
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The losses of critics, actor and alpha; each has gradients only with respect to its own parameters.

    With Q the smaller of the two critics (Q_target: of the two target critics), d for ended, s a state including the
    time left and o the observation in it:

    critics: sum_i mean (Q_i(s, a) - r - gamma (1 - d) sum_a' pi(a'|o') (Q_target(s', a') - k alpha log pi(a'|o')))^2/2
    actor:   mean sum_a pi(a|o) (alpha log pi(a|o) - Q(s, a))
    alpha:   mean log alpha (H(pi(.|o)) - H_target)

    with k = `paid`: 0 while held actions are useful, else 1 (`animat.training.exploration.entropy_factor`).
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
    trained: Parameters,
    targets: Network,
    batch: Batch,
    uniforms: Float[Array, "2 batch commands"],
    settings: SAC,
    paid: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The same for continuous actions, with a' and a_new drawn from the policy (reparameterised).

    critics: sum_i mean (Q_i(s, a) - r - gamma (1 - d) (Q_target(s', a') - k alpha log pi(a'|o')))^2 / 2
    actor:   mean alpha log pi(a_new|o) - Q(s, a_new)
    alpha:   mean log alpha (-log pi(a_new|o) - H_target)
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


def begin(environment: Environment[Any], settings: SAC, key: PRNGKeyArray) -> Learner:
    """A new, untrained policy; every random draw of its training follows from `key`."""
    weight_key, reset_key, key = jax.random.split(key, 3)
    n, n_actions, hidden = len(environment.observation_spec), environment.n_actions, settings.hidden
    n_drawn = environment.n_drawn
    inputs, values, outputs = (n + 1 + n_drawn, 1, 2 * n_drawn) if n_actions is None else (n + 1, n_actions, n_actions)
    actor, critics = initial_networks(
        weight_key, ((n, hidden, hidden, outputs), ()), ((inputs, hidden, hidden, values), (2,))
    )
    trained = Parameters(actor, critics, jnp.float32(math.log(settings.initial_alpha)))
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
    environment: Environment[Any], settings: SAC, learner: Learner, simulator: Neurons, first: Index, last: Index
) -> tuple[Learner, Finished]:
    """Act and learn for some rounds with one simulator; in a round every environment does one iteration.

    Environment and settings are static, and episodes are cut off at the robot's limit. The last round is excluded;
    policies trained side by side have the same rounds.
    """

    def one_round(index: Index, carry: tuple[Learner, Finished]) -> tuple[Learner, Finished]:
        learner, finished = carry
        key, use, reset_key = jax.random.split(learner.key, 3)
        for_acting, for_learning = draw_uniforms(environment, settings, use)
        before = learner.episodes
        state = critic_state(environment, before)
        learner, action, noise = choose_actions(environment, learner._replace(key=key), state[:, :-1], for_acting)
        after = jax.vmap(EpisodeLimit(environment).advance, (0, 0, 0, None))(noise, before, action, simulator)
        ended = jnp.logical_or(*after.ended)
        reward = shaped(environment.robot, settings, before.robot, after.robot, net_reward(before, after), ended)
        rows = pack_transitions(settings, state, critic_state(environment, after), action, reward, ended)
        started = jax.vmap(environment.reset)(jax.random.split(reset_key, settings.environments))
        episodes = jax.tree.map(lambda new, old: jax.vmap(jnp.where)(ended, new, old), started.carried, after.carried)
        learner, of_round = end_round(settings, learner, index, rows, after, ended, episodes)
        learner = learn(environment, settings, learner, index, for_learning)
        return learner, jax.tree.map(jnp.add, finished, of_round)

    nothing = Finished(jnp.float32(0.0), jnp.float32(0.0))
    trained: tuple[Learner, Finished] = jax.lax.fori_loop(first, last, one_round, (learner, nothing))
    return trained


def draw_uniforms(
    environment: Environment[Any], settings: SAC, key: PRNGKeyArray
) -> tuple[Float[Array, "environments uniforms"], Float[Array, "gradient_steps blocks batch"]]:
    """The uniforms of a round for acting and for learning, drawn as one block."""
    acting = settings.environments, environment.n_drawn + n_uniforms(environment) + environment.noise_size
    blocks = 1 if environment.n_actions is not None else 1 + 2 * environment.n_drawn
    learning = settings.gradient_steps, blocks, settings.batch
    uniforms = jax.random.uniform(key, (math.prod(acting) + math.prod(learning),))
    for_acting, for_learning = jnp.split(uniforms, [math.prod(acting)])
    return for_acting.reshape(acting), for_learning.reshape(learning)


def shaped(
    robot: Robot[Any], settings: SAC, before: Any, after: Any, reward: PerEnvironment, ended: Flags
) -> PerEnvironment:
    """Shaped rewards for learning, if the robot has a `potential`; they leave the optimal policy unchanged.

        r + gamma (1 - d) potential(s') - potential(s)

    with d for ended (terminated or truncated), as in the losses. Over any episode the discounted terms add up to
    -potential(s_0), regardless of the actions (Ng, Harada & Russell 1999). Reported returns do not include them.
    """
    if not hasattr(robot, "potential"):
        return reward
    potential = jax.vmap(robot.potential)
    shaping: Array = settings.discount * jnp.where(ended, 0.0, potential(after)) - potential(before)
    return reward + shaping


def choose_actions(
    environment: Environment[Any],
    learner: Learner,
    observation: Float[Array, "environments observations"],
    uniforms: Float[Array, "environments uniforms"],
) -> tuple[Learner, Array, Float[Array, "environments noise"]]:
    """The learner after exploring, the actions of a round, and the remaining uniforms for the environments."""
    n_drawn = environment.n_drawn
    n_before = n_drawn + n_uniforms(environment)
    action = draw_action(environment, learner.trained.actor, observation, uniforms[:, :n_drawn])
    action, exploration = explore(environment, learner.exploration, action, uniforms[:, n_drawn:n_before])
    return learner._replace(exploration=exploration), action, uniforms[:, n_before:]


def critic_state(environment: Environment[Any], episodes: State) -> States:
    """The critics' inputs: scaled observations, and the time left."""
    left = 1.0 - 2.0 * episodes.iteration[:, None] / environment.robot.episode_limit
    return jnp.concatenate([jax.vmap(environment.observe)(episodes) / environment.scales, left], axis=1)


def end_round(
    settings: SAC, learner: Learner, index: Index, rows: Rows, after: State, ended: Flags, episodes: State
) -> tuple[Learner, Finished]:
    """Store a round's transitions (`rows`), and count the episodes that ended in it; all go on from `episodes`."""
    returns = learner.returns + after.reward
    alone = ended & ~learner.exploration.was_held
    learner = learner._replace(
        replay=remember(learner.replay, rows, index * settings.environments % settings.replay),
        episodes=episodes,
        returns=jnp.where(ended, 0.0, returns),
        exploration=count_ended(learner.exploration, ended, net_return(returns, after)),
    )
    return learner, Finished(jnp.sum(alone, dtype=jnp.float32), jnp.sum(jnp.where(alone, returns, 0.0)))


def learn(
    environment: Environment[Any],
    settings: SAC,
    learner: Learner,
    index: Index,
    uniforms: Float[Array, "gradient_steps blocks batch"],
) -> Learner:
    """Take `settings.gradient_steps` gradient steps after round `index`, and average the deployed actor.

    Polynomial-decay averaging (Shamir and Zhang 2013, arXiv:1212.1824), whose window grows with the training. With k
    the averaging exponent and t the rounds done: average += (k + 1) / (t + k) (actor - average).
    """
    adam = _adam(settings)
    n_drawn, is_continuous = environment.n_drawn, environment.n_actions is None
    paid = entropy_factor(learner.exploration)
    available = jnp.minimum(index * settings.environments + settings.environments, settings.replay)

    def losses(trained: Parameters, targets: Network, batch: Batch, noise: Array) -> Float[Array, ""]:
        if is_continuous:
            return sum(continuous_losses(trained, targets, batch, noise, settings, paid), jnp.float32(0.0))
        return sum(discrete_losses(trained, targets, batch, settings, paid), jnp.float32(0.0))

    def update(carry: tuple[Parameters, Network, Any], uniforms: Float[Array, "blocks batch"]) -> tuple[Any, None]:
        trained, targets, optimiser = carry
        batch = draw_batch(environment, learner.replay, available, uniforms[0])
        noise = uniforms[1:].reshape(-1, n_drawn, settings.batch).swapaxes(1, 2)
        gradient = jax.grad(losses)(trained, targets, batch, noise)
        steps, optimiser = adam.update(gradient, optimiser)
        trained = optax.apply_updates(trained, steps)
        targets = jax.tree.map(lambda t, c: t + settings.tau * (c - t), targets, trained.critics)
        return (trained, targets, optimiser), None

    before = learner.trained, learner.targets, learner.optimiser
    (trained, targets, optimiser), _ = jax.lax.scan(update, before, uniforms)
    rate = (settings.averaging_exponent + 1.0) / (index + 1.0 + settings.averaging_exponent)
    deployed = jax.tree.map(lambda average, new: average + rate * (new - average), learner.deployed, trained.actor)
    return learner._replace(trained=trained, deployed=deployed, targets=targets, optimiser=optimiser)


def _adam(settings: SAC) -> optax.GradientTransformation:
    # Flattened: one long vector compiles faster than nineteen arrays, and runs as fast.
    # Before any reward is found, gradients are almost 0. With a smaller epsilon Adam turns their noise into full steps,
    # which can switch off all units of a layer for good.
    return optax.flatten(optax.adam(settings.learning_rate, eps=1e-5))


class Diagnosis(NamedTuple):
    """The diagnosis of one policy, on transitions drawn from its replay, to explain its learning curve.

    Attributes:
        entropy: mean of H(pi(.|o)), nats; for continuous actions the mean of -log pi(a|o), one action drawn per state.
    """

    entropy: Float[Array, ""]
    alpha: Float[Array, ""]
    critic_loss: Float[Array, ""]


def diagnose(environment: Environment[Any], settings: SAC, learner: Learner, available: Index) -> Diagnosis:
    """Diagnose a learner, always with the same random numbers; NaN if its replay has no transitions available."""
    n_drawn = environment.n_drawn
    uniforms = jax.random.uniform(jax.random.key(0), (1 + 2 * n_drawn, _TRANSITIONS))
    batch = draw_batch(environment, learner.replay, available, uniforms[0])
    noise = uniforms[1:].reshape(2, n_drawn, _TRANSITIONS).swapaxes(1, 2)
    outputs = forward(learner.trained.actor, batch.observation)
    paid = entropy_factor(learner.exploration)
    if environment.n_actions is None:
        critic_loss, _, _ = continuous_losses(learner.trained, learner.targets, batch, noise, settings, paid)
        _, log_pi = squashed_normal(outputs, noise[1])
    else:
        critic_loss, _, _ = discrete_losses(learner.trained, learner.targets, batch, settings, paid)
        log_pi = jnp.sum(jax.nn.softmax(outputs) * jax.nn.log_softmax(outputs), axis=-1)
    numbers = -jnp.mean(log_pi), jnp.exp(learner.trained.log_alpha), critic_loss
    return Diagnosis(*(jnp.where(available > 0, number, jnp.nan) for number in numbers))


@lru_cache(maxsize=8)
def diagnosis_program(environment: Environment[Any], algorithm: SAC) -> Callable[..., Any]:
    """`diagnose` for several policies, compiled when it is first called."""
    return jit_side_by_side(partial(diagnose, environment, algorithm), (0, None))
