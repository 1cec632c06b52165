"""Temporally extended exploration: random actions are held for a while, as long as the policy alone does no better.

An untrained policy draws each action independently, and a body averages them: a pendulum to be swung up stays where it
hangs, and a rare reward is never seen. Random actions that are held get far (Dabney, Ostrovski and Barreto 2021,
arXiv:2006.01782). In half of the environments random actions are occasionally held, until the policy's own episodes
return more. On the paper's tasks they soon do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from animat.environment import Environment

HOLD_PROBABILITY = 0.2
"""Probability that an action begins to be held in an iteration in which none is held."""
LONGEST_SHARE = 0.25
"""Largest share of an episode for which an action is held; the logarithm of the duration is uniform below it."""
DECAY = 0.98
"""Weight of an episode in the mean return relative to the next one of its kind: about the last fifty count."""


class Exploration(NamedTuple):
    """The held action of each environment of a policy, and the returns with and without held actions.

    Attributes:
        action: the action that is held, or was held last.
        left: iterations for which it is still held; 0 or less: none is held.
        was_held: whether any action of the current episode was held.
        episodes, returns: of the policy alone and with held actions, their number and sum; older ones count less.
    """

    action: Float[Array, "environments drawn"]
    left: Float[Array, " environments"]
    was_held: Bool[Array, " environments"]
    episodes: Float[Array, "2"]
    returns: Float[Array, "2"]


def n_uniforms(environment: Environment[Any]) -> int:
    """Number of uniforms that one environment's exploration uses per iteration."""
    return 2 + environment.n_drawn


def nothing_held(environments: int, n_drawn: int) -> Exploration:
    """The exploration at the start of a training."""
    zeros = jnp.zeros(environments)
    return Exploration(jnp.zeros((environments, n_drawn)), zeros, zeros > 0, jnp.zeros(2), jnp.zeros(2))


def explore(
    environment: Environment[Any], exploration: Exploration, action: Array, uniforms: Float[Array, "environments draws"]
) -> tuple[Array, Exploration]:
    """The actions to take: the policy's own, or a held one.

    A held action is drawn uniformly. It is held for k iterations or more with probability 1 - ln k / ln L, for k up to
    L, a quarter of the episode limit. Only the second half of the environments hold actions; a single one never does.
    """
    n, n_drawn = exploration.action.shape
    longest = max(environment.robot.episode_limit * LONGEST_SHARE, 1.0)
    begins = (uniforms[:, 0] < HOLD_PROBABILITY) & (exploration.left <= 0) & is_useful(exploration)
    begins &= jnp.arange(n) >= (n + 1) // 2
    if environment.n_actions is None:
        drawn = 2.0 * uniforms[:, 2:] - 1.0
    else:
        drawn = jnp.minimum(jnp.floor(uniforms[:, 2:] * environment.n_actions), environment.n_actions - 1)
    held = jnp.where(begins[:, None], drawn, exploration.action)
    left = jnp.where(begins, jnp.floor(longest ** uniforms[:, 1]), exploration.left)
    is_held = left > 0
    taken = jnp.where(is_held[:, None], held, action.reshape(n, n_drawn)).reshape(action.shape).astype(action.dtype)
    return taken, exploration._replace(action=held, left=left - 1.0, was_held=exploration.was_held | is_held)


def count_ended(
    exploration: Exploration, ended: Bool[Array, " environments"], returns: Float[Array, " environments"]
) -> Exploration:
    """After an iteration: count the episodes that ended, by their kind, and release what they held."""
    kinds = jnp.stack([~exploration.was_held, exploration.was_held]) & ended
    episodes = kinds.sum(axis=1, dtype=jnp.float32)
    kept = DECAY**episodes
    return exploration._replace(
        left=jnp.where(ended, 0.0, exploration.left),
        was_held=exploration.was_held & ~ended,
        episodes=kept * exploration.episodes + episodes,
        returns=kept * exploration.returns + jnp.where(kinds, returns, 0.0).sum(axis=1),
    )


def is_useful(exploration: Exploration) -> Bool[Array, ""]:
    """Whether holding actions is still useful: not once the policy alone does better, nor for a single environment."""
    if len(exploration.left) < 2:
        return jnp.array(False)
    alone, with_held = exploration.returns / exploration.episodes
    # The mean over no episodes is NaN, and not better.
    return ~(alone > with_held)  # type: ignore[no-any-return]


def entropy_factor(exploration: Exploration) -> Float[Array, ""]:
    """The factor k of the entropy term in the critics' targets: 0 while held actions are useful, otherwise 1.

    With 1 from the start, values would consist of entropy alone, and hide the first rewards for a long time.
    """
    return jnp.where(is_useful(exploration), 0.0, 1.0)
