"""Goal information: how much the chosen stimulus depends on the goal, given the sensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float64, Int

from animat.environment import Environment, Neurons
from animat.errors import InvalidArgument
from animat.evaluation.rollouts import Actor, trajectories
from animat.evaluation.statistics import Interval, interval_of_mean
from animat.robots.base import capability

EPISODES = 64
"""Episodes of each actor: a state from each is combined with the goal of each other one."""
DRAWS = 128
"""Actions drawn at each state with each goal."""
PERMUTATIONS = 199
"""Permutations among the goals, of two actions with each goal at a state: p is at least 0.005."""


@dataclass(frozen=True)
class GoalInformation:
    """I(action; goal | sensors) in bits, with its interval over states and actors.

    Attributes:
        p: share of permutations of the actions at each state among the goals with at least as large an estimate.
        most: log2 of the number of actions, or of goals if there are fewer.
    """

    bits: Interval
    p: float
    most: float

    def to_text(self) -> str:
        """One line."""
        bits, test = self.bits, f"permutation test of no dependence on the goal: p = {self.p:.2g}"
        return f"goal information {bits.value:.2f} of {self.most:.2f} bits ({bits.low:.2f} to {bits.high:.2f}; {test})"


def goal_information(
    environment: Environment[Any], simulator: Neurons, actors: Actor, *, draws: int = DRAWS, seed: int = 1
) -> GoalInformation:
    """How much information the chosen stimulus carries about the goal, given the sensors.

        I(A; G | S) = E_s[H(A | s) - E_g H(A | s, g)]

    with s a state of each episode at a random iteration, and g the goals of the other episodes, each substituted for
    the state's own: sensors and all else stay the same. So goals do not depend on s, as they would if an actor had
    been moving towards its own goal. `draws` are the actions drawn at each state with each goal; 2 are enough for
    deterministic actors. Raises InvalidArgument for continuous actions, or a robot without `with_goal_of`.
    """
    switch = capability(environment.robot, "with_goal_of")
    if environment.n_actions is None:
        raise InvalidArgument("environment: expected discrete actions for goal information, got continuous ones")
    rng = np.random.default_rng([seed, 41])
    ran = trajectories(environment, simulator, actors, episodes=EPISODES, seed=seed)
    when = (rng.random(ran.lengths.shape) * ran.lengths).astype(np.int64)
    rows, columns = np.indices(when.shape)
    states = jax.tree.map(lambda x: x[rows, columns, when], ran.states)
    key = jax.random.key(int(rng.integers(2**31)))
    actions = np.asarray(_at_each_goal(environment, draws, states, actors, jax.random.split(key, actors.n_actors)))
    bits = conditional_information(actions.reshape(-1, *actions.shape[2:]), environment.n_actions)
    # The samples are the actors, or the states of a single actor.
    samples = bits.reshape(when.shape).mean(axis=1) if len(when) > 1 else bits
    # Permutations leave H(A | s) as it is, and the entropy of two actions is 1 bit if they differ, else 0: the fewer
    # pairs with a goal differ, the larger the estimate.
    pairs = actions[..., :2].reshape(len(bits), -1)
    differing = [_n_differing(rng.permuted(pairs, axis=1)) for _ in range(PERMUTATIONS)]
    p = float((1 + np.sum(np.array(differing) <= _n_differing(pairs))) / (1 + PERMUTATIONS))
    # The number of goals is that of different observations when each state's goal is substituted at the first state.
    robots = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states.robot)
    switched = jax.vmap(switch, (None, 0))(jax.tree.map(lambda x: x[0], robots), robots)
    n_goals = len(np.unique(np.asarray(jax.vmap(environment.robot.observe)(switched)), axis=0))
    most = float(np.log2(min(environment.n_actions, n_goals)))
    return GoalInformation(interval_of_mean(samples), p, most)


def conditional_information(
    actions: Int[np.ndarray, "states goals draws"], n_actions: int
) -> Float64[np.ndarray, " states"]:
    """H(A) - E_g H(A | g) at each state in bits, corrected for few draws and few goals.

    The entropy of the actions (from 0 on) with one goal is Miller and Madow's; that of all goals a jackknife over them.

    Source: Miller 1955, in Information Theory in Psychology, 95; Efron & Stein 1981, doi:10.1214/aos/1176345462.
    """
    shares = _shares(actions, n_actions)
    goals, draws = actions.shape[1:]
    mixture = shares.mean(axis=1)
    without = (goals * mixture[:, None] - shares) / (goals - 1)
    entropy = goals * _entropy(mixture) - (goals - 1) * _entropy(without).mean(axis=1)
    with_goal = _entropy(shares) + ((shares > 0).sum(axis=-1) - 1) / (2 * draws * np.log(2))
    return np.asarray(entropy - with_goal.mean(axis=1))


def _n_differing(pairs: Int[np.ndarray, "states actions"]) -> int:
    return int(np.count_nonzero(pairs[:, ::2] != pairs[:, 1::2]))


def _shares(actions: Int[np.ndarray, "*any draws"], n_actions: int) -> Float64[np.ndarray, "*any actions"]:
    return np.stack([(actions == action).mean(axis=-1) for action in range(n_actions)], axis=-1)


def _entropy(shares: Float64[np.ndarray, "*any actions"]) -> Float64[np.ndarray, "*any"]:
    return np.asarray(-(shares * np.log2(np.where(shares > 0, shares, 1.0))).sum(axis=-1))


@partial(jax.jit, static_argnums=(0, 1))
def _at_each_goal(environment: Environment[Any], draws: int, states: Any, actors: Actor, keys: Any) -> Array:
    """Actions at each state with the goal of each other one, shape (actors, states, goals, draws)."""
    switched = capability(environment.robot, "with_goal_of")

    def of_actor(states: Any, actor: Actor, key: Any) -> Array:
        def at(state: Any, other: Any, key: Any) -> Array:
            seen = environment.observe(state._replace(robot=switched(state.robot, other)))
            uniforms = jax.random.uniform(key, (draws, environment.n_drawn), jnp.float32)
            return actor.act(environment, jnp.tile(seen / environment.scales, (draws, 1)), uniforms)

        def with_others(number: Array, state: Any, key: Any) -> Array:
            others = (number + 1 + jnp.arange(EPISODES - 1)) % EPISODES
            goals = jax.tree.map(lambda x: x[others], states.robot)
            return jax.vmap(at, (None, 0, 0))(state, goals, jax.random.split(key, EPISODES - 1))

        each = jnp.arange(EPISODES), states, jax.random.split(key, EPISODES)
        # State after state: all at once would take gigabytes.
        return jax.lax.map(lambda one: with_others(*one), each)  # type: ignore[no-any-return]

    return jax.vmap(of_actor)(states, actors, keys)
