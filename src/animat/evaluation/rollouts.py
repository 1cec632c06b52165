"""Episodes of policies and controls on a simulator, many at once."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Int64, Key, PRNGKeyArray, Shaped

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment, Neurons, State
from animat.errors import InvalidArgument, expect_at_least, shown
from animat.evaluation.commands import mean_commands
from animat.evaluation.controllers import Called, CalledEpisodes
from animat.evaluation.host_rollouts import look, roll_out_on_host
from animat.goals.robot import RobotWithGoal
from animat.goals.tally import Outcome
from animat.neurons.simulator import stacked
from animat.robots.base import MOST_AT_ONCE, capability
from animat.robots.host import HostRobot
from animat.robots.starts import Starts
from animat.tables import briefly
from animat.training.networks import Layer, Network, as_commands, draw_action, likeliest_action
from animat.training.policy import Policy

Seen = Float[Array, "episodes observations"]
Uniforms = Float[Array, "episodes drawn"]


class Actor(abc.ABC):
    """What chooses the actions of episodes; a pytree, so that several can run side by side."""

    @abc.abstractmethod
    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        """An action for each observation (scaled), from uniforms in [0, 1), as `draw_action` does."""

    @property
    def n_actors(self) -> int:
        """How many run side by side: the length of the first axis of all its arrays; 1 without arrays."""
        arrays = jax.tree.leaves(self)
        return len(arrays[0]) if arrays else 1


@final
@partial(jax.tree_util.register_dataclass, data_fields=["network", "scales"], meta_fields=["greedy"])
@dataclass(frozen=True)
class Networks(Actor):
    """Trained policies: their stacked networks, which act greedily or by drawing.

    Attributes:
        scales: by which observations were divided in each policy's training, whatever robot it now drives.
    """

    network: Network
    scales: Float[Array, "*actors observations"]
    greedy: bool = False

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        # The factor is exactly 1 on the robot of the training.
        observation = observation * (environment.scales / self.scales)
        if not self.greedy:
            return draw_action(environment, self.network, observation, uniforms)
        return likeliest_action(environment, self.network, observation)


# Static: JAX confuses registered dataclasses without fields.
@final
@jax.tree_util.register_static
@dataclass(frozen=True)
class Uniform(Actor):
    """All actions equally likely, whatever is observed: the random control."""

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        if environment.n_actions is None:
            return as_commands(environment, 2.0 * uniforms - 1.0)
        return jnp.minimum((uniforms[:, 0] * environment.n_actions).astype(jnp.int32), environment.n_actions - 1)


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Constant(Actor):
    """Always the same action: the constant control."""

    action: Int[Array, "*actors"]

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        return jnp.broadcast_to(self.action, uniforms.shape[:1])


def nearest_action(
    actions: Array | None, means: Float[Array, "actions *commands"] | None, wanted: Float[Array, "episodes *commands"]
) -> Array:
    """The action whose mean command is nearest (Euclidean) to the wanted one; without actions, the wanted command."""
    if actions is None or means is None:
        return wanted
    apart = means - wanted[:, None]
    distance = jnp.abs(apart) if apart.ndim == 2 else jnp.linalg.norm(apart, axis=2)
    return actions[jnp.argmin(distance, axis=1)]


@final
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HeuristicPolicy(Actor):
    """The action whose mean command is nearest to that of the robot's `heuristic`, which sees only the robot.

    Attributes:
        actions: the environment's input for each action, shape (1, actions), for one actor; None for any command.
        means: the mean command of each action, the same shape, or (1, actions, commands) for several commands.
    """

    actions: Array | None = None
    means: Float[Array, "..."] | None = None

    def act(self, environment: Environment[Any], observation: Seen, uniforms: Uniforms) -> Array:
        of_robot = (observation * environment.scales)[:, : len(environment.robot.observation_spec)]
        wanted: Array = jax.vmap(capability(environment.robot, "heuristic"))(of_robot)
        return nearest_action(self.actions, self.means, wanted)


def heuristic_policy(environment: Environment[Any], simulator: Neurons) -> HeuristicPolicy:
    """The heuristic policy for an environment, as one actor; InvalidArgument for a robot without a `heuristic`."""
    capability(environment.robot, "heuristic")
    if environment.n_actions is None:
        return HeuristicPolicy()
    actions, means = mean_commands(environment, simulator)
    return HeuristicPolicy(jnp.asarray(actions)[None], jnp.asarray(means, jnp.float32)[None])


@dataclass(frozen=True, eq=False)
class Episodes:
    """Results of episodes of several actors.

    Attributes:
        returns: sum of rewards of each episode, in the task's own units.
        terminated: whether it ended by itself and not at the episode limit.
        delivered: how often each condition was delivered in each episode; no conditions without neurons.
        commanded: the sum of the commands that each condition led to in all episodes; several commands separately.
        outcome: of each episode, for a robot with a goal; shape (actors, episodes), and with a last axis of objectives.
    """

    __repr__ = briefly

    returns: Float64[np.ndarray, "actors episodes"]
    lengths: Int64[np.ndarray, "actors episodes"]
    terminated: Bool[np.ndarray, "actors episodes"]
    delivered: Int64[np.ndarray, "actors episodes conditions"]
    commanded: Float64[np.ndarray, "actors conditions *commands"]
    outcome: Outcome | None = None

    @property
    def presented(self) -> Int64[np.ndarray, "actors conditions"]:
        """How often each condition was delivered, in all episodes together."""
        return np.asarray(self.delivered.sum(axis=1))

    @property
    def half_way(self) -> int:
        """Half of the median episode, in iterations; at least one."""
        return max(1, int(np.median(self.lengths)) // 2)


def check_seed(seed: int) -> None:
    """Refuse a seed of more than 32 bits (InvalidArgument): JAX uses no more, so two could give the same draws."""
    if not 0 <= seed < 2**32:
        raise InvalidArgument(f"seed: expected a whole number from 0 to 4294967295, got {seed}")


def check_at_once(name: str, episodes: int, n_actors: int) -> None:
    """Refuse fewer than one episode, or more than fit side by side (InvalidArgument, with the argument's name)."""
    expect_at_least(name, episodes, 1)
    if episodes * n_actors > MOST_AT_ONCE:
        most = f"{MOST_AT_ONCE // n_actors:,} each, as {n_actors} run side by side"
        raise InvalidArgument(f"{name}: expected at most {most}, got {shown(episodes)}")


def networks_of(policies: Sequence[Policy], *, greedy: bool = False) -> Networks:
    """Stack the networks of policies; raises InvalidArgument if there are none, or their shapes differ."""
    if not policies:
        raise InvalidArgument("policies: expected at least one, got none")
    if len({tuple(w.shape for w in policy.weights) for policy in policies}) > 1:
        raise InvalidArgument("policies: expected networks of one shape, got several: evaluate them one by one")
    layers = [[(w, b[None]) for w, b in zip(p.weights, p.biases, strict=True)] for p in policies]
    network = tuple(Layer(*layer) for layer in jax.tree.map(stacked, *layers))
    return Networks(network, stacked(*(np.asarray(p.scales, np.float32) for p in policies)), greedy)


def roll_out(
    environment: Environment[Any],
    simulator: Neurons,
    actors: Actor | Called,
    *,
    episodes: int,
    seed: int,
    alike: bool = False,
    starts: Starts | None = None,
) -> Episodes:
    """Run episodes of several actors on one simulator.

    Args:
        actors: one kind of actor, its arrays with a leading axis of actors; or a controller outside JAX.
        seed: decides every random draw, together with an actor's place.
        alike: whether all actors get the same random numbers, so that only their actions differ.
        starts: where episodes start, those of the first round first; None: as the robot draws them.

    Raises InvalidArgument for fewer than one episode or more than fit, or a seed of more than 32 bits.
    """
    n_actors = actors.n_actors
    check_at_once("episodes", episodes, n_actors)
    check_seed(seed)
    keys = jax.random.split(jax.random.key(seed), 1 if alike else n_actors)
    keys = jnp.repeat(keys, n_actors, axis=0) if alike else keys
    if isinstance(environment.robot, HostRobot):
        return Episodes(
            *roll_out_on_host(environment, episodes, simulator, actors, keys, seed, alike=alike, starts=starts)
        )
    of_episodes = None if starts is None else starts.of_episodes(episodes)
    if isinstance(actors, Called):
        ran = _roll_out_called(environment, episodes, simulator, actors, keys[0], of_episodes)
    else:
        ran = _roll_out(environment, episodes, simulator, actors, keys, of_episodes)
    *counted, terminated, outcome = jax.device_get(ran)
    kinds = (np.float64, np.int64, np.int64, np.float64)
    returns, lengths, delivered, commanded = (x.astype(kind) for x, kind in zip(counted, kinds, strict=True))
    return Episodes(returns, lengths, terminated, delivered, commanded, outcome)


class _Course(NamedTuple):
    """An actor's episodes under way; those that have ended are carried along, but no longer counted."""

    state: State
    going: Bool[Array, " episodes"]
    returns: Float[Array, " episodes"]
    lengths: Int[Array, " episodes"]
    delivered: Int[Array, "episodes conditions"]
    commanded: Float[Array, "conditions *commands"]
    terminated: Bool[Array, " episodes"]


def _begin(
    environment: Environment[Any], episodes: int, simulator: Neurons, key: PRNGKeyArray, starts: Any
) -> tuple[_Course, Key[Array, " iterations"]]:
    """The episodes before their first iteration, and a key for each iteration."""
    n_conditions = 0 if simulator is None or environment.n_actions is None else environment.n_actions
    start, key = jax.random.split(key)
    course = _Course(
        jax.vmap(environment.reset)(jax.random.split(start, episodes) if starts is None else starts).carried,
        jnp.ones(episodes, bool),
        jnp.zeros(episodes),
        jnp.zeros(episodes, jnp.int32),
        jnp.zeros((episodes, n_conditions), jnp.int32),
        jnp.zeros((n_conditions, *environment.robot.command_shape)),
        jnp.zeros(episodes, bool),
    )
    return course, jax.random.split(key, environment.robot.episode_limit)


def _advance(
    environment: Environment[Any], simulator: Neurons, course: _Course, action: Array, noise: Array
) -> _Course:
    state, going, returns, lengths, delivered, commanded, terminated = course
    after = jax.vmap(environment.advance, (0, 0, 0, None))(noise, state, action, simulator)
    returns = returns + jnp.where(going, after.reward, 0.0)
    terminated = terminated | (going & after.ended.terminated)
    lengths = lengths + going
    if simulator is not None:
        now = going[:, None] & (after.info["delivered"][:, None] == jnp.arange(delivered.shape[1]))
        delivered = delivered + now
        commanded = commanded + jnp.tensordot(now.T.astype(jnp.float32), after.info["command"], 1)
    going = going & ~jnp.logical_or(*after.ended)
    return _Course(after.carried, going, returns, lengths, delivered, commanded, terminated)


def _results(environment: Environment[Any], course: _Course) -> tuple[Any, ...]:
    """What is counted, and the outcome for a robot with a goal."""
    robot = environment.robot
    outcome = jax.vmap(jax.vmap(robot.outcome))(course.state.robot) if isinstance(robot, RobotWithGoal) else None
    return *course[2:], outcome


@partial(jax.jit, static_argnums=(0, 1), compiler_options=COMPILER_OPTIONS)
def _roll_out(
    environment: Environment[Any],
    episodes: int,
    simulator: Neurons,
    actors: Actor,
    keys: Key[Array, " actors"],
    starts: Key[Array, " episodes"] | None,
) -> tuple[Any, ...]:
    def iteration(course: _Course, actor: Actor, key: PRNGKeyArray) -> _Course:
        observation, uniforms, noise = look(environment, course.state, key)
        return _advance(environment, simulator, course, actor.act(environment, observation, uniforms), noise)

    # The loop is outside the `vmap` and ends with the last episode: controls fail long before the limit.
    first, of_iteration = jax.vmap(lambda key: _begin(environment, episodes, simulator, key, starts))(keys)
    each = jax.vmap(iteration)
    _, last = jax.lax.while_loop(
        lambda at: (at[0] < environment.robot.episode_limit) & jnp.any(at[1].going),
        lambda at: (at[0] + 1, each(at[1], actors, of_iteration[:, at[0]])),
        (0, first),
    )
    return _results(environment, last)


def _roll_out_called(
    environment: Environment[Any],
    episodes: int,
    simulator: Neurons,
    called: Called,
    key: PRNGKeyArray,
    starts: Key[Array, " episodes"] | None,
) -> tuple[Any, ...]:
    """`roll_out` for a controller outside JAX, with the same random numbers."""
    called_episodes = CalledEpisodes(called, environment)
    course, of_iteration = _begin_in_jit(environment, episodes, simulator, key, starts)
    for each in of_iteration:
        observation, uniforms, noise = _look_in_jit(environment, course, each)
        chosen = called_episodes.choose(*map(np.asarray, (observation, uniforms, course.going)))
        course = _advance_in_jit(environment, simulator, course, chosen, noise)
        if not np.any(course.going):
            break
    called_episodes.end()
    return _results(environment, jax.tree.map(lambda part: part[None], course))


_begin_in_jit = jax.jit(_begin, static_argnums=(0, 1), compiler_options=COMPILER_OPTIONS)
_advance_in_jit = jax.jit(_advance, static_argnums=0, compiler_options=COMPILER_OPTIONS)


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _look_in_jit(environment: Environment[Any], course: _Course, key: PRNGKeyArray) -> tuple[Seen, Uniforms, Array]:
    """As `look`, with observations in the robot's own units."""
    observation, uniforms, noise = look(environment, course.state, key)
    return observation * environment.scales, uniforms, noise


class Trajectories(NamedTuple):
    """Episodes of several actors; entries after the end of an episode are meaningless.

    Attributes:
        states: before each iteration and after the last (`State.carried`), each array with the axes of `observations`.
    """

    states: State
    observations: Float[np.ndarray, "actors episodes iterations+1 observations"]
    actions: Shaped[np.ndarray, "actors episodes iterations *commands"]
    commands: Float[np.ndarray, "actors episodes iterations *commands"]
    lengths: Int[np.ndarray, "actors episodes"]


def trajectories(
    environment: Environment[Any], simulator: Neurons, actors: Actor, *, episodes: int, seed: int
) -> Trajectories:
    """Run episodes of each actor on a robot in JAX; arguments as in `roll_out`, InvalidArgument as in `check_seed`."""
    check_seed(seed)
    n_actors = actors.n_actors
    keys = jax.random.split(jax.random.key(seed), n_actors * episodes).reshape(n_actors, episodes)
    return jax.device_get(_trajectories(environment, simulator, actors, keys))  # type: ignore[no-any-return]


@partial(jax.jit, static_argnums=0)
def _trajectories(environment: Environment[Any], simulator: Neurons, actors: Actor, keys: Any) -> Trajectories:
    n_drawn = environment.n_drawn

    def one_episode(actor: Actor, key: Any) -> Trajectories:
        def iteration(carry: Any, key: Any) -> Any:
            state, going = carry
            uniforms = jax.random.uniform(key, (n_drawn + environment.noise_size,), jnp.float32)
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
        return Trajectories(states, observations, actions, commands, going.sum())

    return jax.vmap(lambda actor, of_actor: jax.vmap(partial(one_episode, actor))(of_actor))(actors, keys)
