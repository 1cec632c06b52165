"""Episodes with bodies that are stepped outside JAX; actors and neurons are compiled."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from animat.compilation import COMPILER_OPTIONS
from animat.environment import Environment, Neurons, State
from animat.evaluation.controllers import Called, CalledEpisodes, expect_condition
from animat.robots.host import Bodies, HostRobot, StepResult
from animat.robots.starts import Starts

AT_ONCE = 64
"""Bodies side by side: each may take megabytes, and more would not make a step cheaper."""
_LAST = threading.local()
"""The bodies of a thread's last wave: creating new ones takes longer than many an episode."""


class Counts(NamedTuple):
    """Results of the episodes; shapes and meanings as in `animat.evaluation.rollouts.Episodes`."""

    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    delivered: np.ndarray
    commanded: np.ndarray


def roll_out_on_host(
    environment: Environment[Any],
    episodes: int,
    simulator: Neurons,
    actors: Any,
    keys: Key[Array, " actors"],
    seed: int,
    *,
    alike: bool,
    starts: Starts | None = None,
) -> Counts:
    """Run episodes of several actors, at most `AT_ONCE` side by side.

    `seed` is that of the bodies' episodes; `alike`: whether all actors have the same ones; `starts`: of a session whose
    episodes they have instead, as in `animat.evaluation.rollouts.roll_out`.
    """
    n_conditions = 0 if simulator is None or environment.n_actions is None else environment.n_actions
    shape = len(keys), episodes
    commanded = np.zeros((len(keys), n_conditions, *environment.robot.command_shape))
    delivered = np.zeros((*shape, n_conditions), np.int64)
    counts = Counts(np.zeros(shape), np.zeros(shape, np.int64), np.zeros(shape, bool), delivered, commanded)
    side_by_side = min(AT_ONCE, episodes)
    actors_at_once = max(1, AT_ONCE // side_by_side)
    for begin in range(0, len(keys), actors_at_once):
        some = slice(begin, begin + actors_at_once)
        acting = jax.tree.map(lambda part, some=some: part[some], actors)
        for first in range(0, episodes, side_by_side):
            # The last wave may run more episodes than requested: the program is compiled for one number.
            numbers = range(len(keys))[some]
            of_wave = range(first, first + side_by_side)
            seeds: Sequence[tuple[int, ...]] = [(seed, 0 if alike else n, i) for n in numbers for i in of_wave]
            if starts is not None:
                seeds = starts.seeds_of(of_wave) * len(numbers)
            folded = jax.vmap(jax.random.fold_in, (0, None))(keys[some], first)
            of_episodes = (each[some, first : first + side_by_side] for each in counts[:4])
            wave = Counts(*of_episodes, *(each[some] for each in counts[4:]))
            _run_wave(environment, simulator, acting, folded, seeds, wave)
    return counts


def paths_on_host(
    environment: Environment[Any], simulator: Neurons, actors: Any, keys: Key[Array, " actors"], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One episode of each actor: observations, commands and lengths, as in `animat.studies.episodes.Paths`."""
    robot, n = environment.robot, len(keys)
    assert isinstance(robot, HostRobot)
    observations = np.zeros((n, robot.episode_limit + 1, len(robot.observation_spec)), np.float32)
    commands = np.zeros((n, robot.episode_limit, *robot.command_shape), np.float32)
    lengths = np.zeros(n, np.int64)
    for number, key in enumerate(keys):
        actor, alone = jax.tree.map(lambda part, number=number: part[number : number + 1], actors), key[None]
        bodies = Bodies(robot, [(seed, number)])
        observations[number] = bodies.begin()
        for command, _, stepped in _iterations(environment, simulator, actor, alone, bodies, 1):
            commands[number, lengths[number]] = command[0].reshape(robot.command_shape)
            lengths[number] += 1
            observations[number, lengths[number] :] = stepped.observation
    return observations, commands, lengths


def _run_wave(
    environment: Environment[Any],
    simulator: Neurons,
    actors: Any,
    keys: Key[Array, " actors"],
    seeds: Sequence[tuple[int, ...]],
    counts: Counts,
) -> None:
    """Add to counts one episode of each of several bodies, equally many for each actor, of which the first count."""
    assert isinstance(environment.robot, HostRobot)
    bodies = _bodies(environment.robot, seeds)
    bodies.begin()
    n = counts.returns.shape[1]
    going = np.ones(counts.returns.shape, bool)
    n_conditions = counts.delivered.shape[2]
    commanded = np.zeros_like(counts.commanded)
    for command, delivered, stepped in _iterations(environment, simulator, actors, keys, bodies, n):
        of_bodies = stepped.reward, stepped.terminated, stepped.ended
        if (wrong := delivered[(delivered < 0) | (delivered >= n_conditions)]).size and n_conditions:
            expect_condition(wrong[0].item(), n_conditions)
        reward, terminated, ended = (each.reshape(len(keys), -1)[:, :n] for each in of_bodies)
        counts.returns[:] += np.where(going, reward, 0.0)
        counts.lengths[:] += going
        counts.terminated[:] |= going & terminated
        if counts.delivered.size:
            actor, episode = np.nonzero(going)
            condition = delivered[:, :n][going]
            np.add.at(counts.delivered, (actor, episode, condition), 1)
            np.add.at(commanded, (actor, condition), command[:, :n][going])
        going &= ~ended
    counts.commanded[:] += commanded


def _iterations(
    environment: Environment[Any], simulator: Neurons, actors: Any, keys: Key[Array, " actors"], bodies: Bodies, n: int
) -> Iterator[tuple[np.ndarray, np.ndarray, StepResult]]:
    """Commands, delivered conditions and results of each iteration of begun bodies; ended episodes begin again.

    Of each actor's bodies the first `n` count, until they first end; a controller is asked for those only.
    """
    shape = len(keys), len(bodies) // len(keys)
    state = _started(environment, keys, shape[1])
    going = np.tile(np.arange(shape[1]) < n, (len(keys), 1))
    called = CalledEpisodes(actors, environment) if isinstance(actors, Called) else None
    for iteration in range(environment.robot.episode_limit):
        state, number = state._replace(robot=bodies.observation.reshape(*shape, -1)), np.int32(iteration)
        if called is None:
            command, state, delivered = _iteration(environment, simulator, actors, keys, number, state)
        else:
            *seen, noise = _look_in_jit(environment, keys, number, state)
            chosen = called.choose(*(np.asarray(each[0]) for each in (*seen, going)))
            command, state, delivered = _respond_in_jit(environment, simulator, state, chosen[None], noise)
        stepped = bodies.step(np.asarray(command).reshape(len(bodies), -1))
        yield np.asarray(command), np.asarray(delivered), stepped
        going &= ~stepped.ended.reshape(shape)
        if not going.any():
            break
        if stepped.ended.any():
            bodies.begin(np.flatnonzero(stepped.ended).tolist())
    if called is not None:
        called.end()


def _bodies(robot: HostRobot, seeds: Sequence[tuple[int, ...]]) -> Bodies:
    """Bodies before their first episode; those of the last wave again, if earlier episodes leave no trace in them."""
    bodies: Bodies | None = getattr(_LAST, "bodies", None)
    if bodies is None or not robot.keeps_state or (bodies.robot, len(bodies)) != (robot, len(seeds)):
        bodies = _LAST.bodies = Bodies(robot, seeds)
    bodies.reseed(seeds)
    return bodies


@partial(jax.jit, static_argnums=(0, 2), compiler_options=COMPILER_OPTIONS)
def _started(environment: Environment[Any], keys: Key[Array, " actors"], episodes: int) -> State:
    return jax.vmap(lambda key: jax.vmap(environment.reset)(jax.random.split(key, episodes)).carried)(keys)


def look(
    environment: Environment[Any], state: State, key: PRNGKeyArray
) -> tuple[Float[Array, "episodes observations"], Float[Array, "episodes drawn"], Float[Array, "episodes noise"]]:
    """Observations (scaled) of episodes side by side, and uniforms for an actor and for the environment."""
    n_drawn = environment.n_drawn
    uniforms = jax.random.uniform(key, (len(state.iteration), n_drawn + environment.noise_size), np.float32)
    return jax.vmap(environment.observe)(state) / environment.scales, uniforms[:, :n_drawn], uniforms[:, n_drawn:]


def _respond(
    environment: Environment[Any], simulator: Neurons, state: State, action: Array, noise: Array
) -> tuple[Float[Array, "episodes *commands"], State, Array]:
    """Commands, the next state, and the delivered conditions."""
    responding = jax.vmap(environment.respond, (0, 0, 0, None))
    delivered, answer, command = responding(noise, state, action, simulator)
    return command, state._replace(iteration=state.iteration + 1, neurons=answer.history), delivered


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _iteration(
    environment: Environment[Any],
    simulator: Neurons,
    actors: Any,
    keys: Key[Array, " actors"],
    iteration: Array,
    state: State,
) -> tuple[Float[Array, "actors episodes *commands"], State, Array]:
    def of_actor(actor: Any, key: PRNGKeyArray, state: State) -> tuple[Array, State, Array]:
        observation, uniforms, noise = look(environment, state, jax.random.fold_in(key, iteration))
        return _respond(environment, simulator, state, actor.act(environment, observation, uniforms), noise)

    return jax.vmap(of_actor)(actors, keys, state)


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _look_in_jit(
    environment: Environment[Any], keys: Key[Array, " actors"], iteration: Array, state: State
) -> tuple[Array, ...]:
    """As `look` for each actor, with observations in the robot's own units."""
    folded = jax.vmap(jax.random.fold_in, (0, None))(keys, iteration)
    observation, *uniforms = jax.vmap(partial(look, environment))(state, folded)
    return observation * environment.scales, *uniforms


@partial(jax.jit, static_argnums=0, compiler_options=COMPILER_OPTIONS)
def _respond_in_jit(
    environment: Environment[Any], simulator: Neurons, state: State, action: Array, noise: Array
) -> tuple[Array, State, Array]:
    return jax.vmap(partial(_respond, environment, simulator))(state, action, noise)
