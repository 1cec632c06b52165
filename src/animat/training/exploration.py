"""Exploration in time: random actions that are held for a while, as long as the policy alone does no better.

A policy that has learned nothing draws its actions one by one, and a body averages them: a pendulum that is to be swung
up stays where it hangs, and where reward is rare none is ever seen. Held for a time, random actions get far (Dabney,
Ostrovski and Barreto 2021, arXiv:2006.01782). In half of the environments random actions are held now and then, until
the policy's own episodes pay more. On the paper's tasks they soon do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from animat.environment import Environment

BEGINNING = 0.2
"""Chance of an iteration in which nothing is held that something is from then on."""
LONGEST = 0.25
"""Of an episode at most that an action is held; lengths of every order below it are equally likely."""
REMEMBERED = 0.98
"""Weight of an episode in its kind's mean return beside the one after it: about the last fifty count."""


class Exploration(NamedTuple):
    """What is held in each environment of a policy, and what has come of it.

    Attributes:
        action: the one that is held, or was last.
        left: iterations that it is still held for; 0 or less for none.
        was_held: whether any action of the episode under way was.
        episodes: how many of late, of the policy alone and of those with actions held; the older, the less they count.
        returns: the sums of their returns.
    """

    action: Float[Array, "environments drawn"]
    left: Float[Array, " environments"]
    was_held: Bool[Array, " environments"]
    episodes: Float[Array, "2"]
    returns: Float[Array, "2"]


def n_uniforms(environment: Environment[Any]) -> int:
    """How many uniforms one environment's exploration takes in an iteration."""
    return 2 + environment.n_drawn


def nothing_held(environments: int, n_drawn: int) -> Exploration:
    """At the start of a training."""
    none = jnp.zeros(environments)
    return Exploration(jnp.zeros((environments, n_drawn)), none, none > 0, jnp.zeros(2), jnp.zeros(2))


def explore(
    environment: Environment[Any],
    exploration: Exploration,
    action: Array,
    uniforms: Float[Array, "environments uniforms"],
) -> tuple[Array, Exploration]:
    """The actions that are taken: the policy's, or one that is held.

    A held action is drawn uniformly. It is held for k iterations or more with a chance of 1 - ln k / ln L, for k up to
    L, a quarter of the episode limit. Only the second half of the environments hold any; a single one never does.

    Args:
        environment: what is acted in.
        exploration: so far.
        action: what the policy drew, as `animat.training.sac.draw_action` gives it.
        uniforms: in [0, 1), `n_uniforms` for each environment.
    """
    n, n_drawn = exploration.action.shape
    longest = max(environment.robot.episode_limit * LONGEST, 1.0)
    begins = (uniforms[:, 0] < BEGINNING) & (exploration.left <= 0) & is_worth_it(exploration)
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


def ended_episodes(
    exploration: Exploration, ended: Bool[Array, " environments"], returns: Float[Array, " environments"]
) -> Exploration:
    """After an iteration: episodes that ended are counted by their kind, and nothing is held in the next ones."""
    kinds = jnp.stack([~exploration.was_held, exploration.was_held]) & ended
    episodes = kinds.sum(axis=1, dtype=jnp.float32)
    kept = REMEMBERED**episodes
    return exploration._replace(
        left=jnp.where(ended, 0.0, exploration.left),
        was_held=exploration.was_held & ~ended,
        episodes=kept * exploration.episodes + episodes,
        returns=kept * exploration.returns + jnp.where(kinds, returns, 0.0).sum(axis=1),
    )


def is_worth_it(exploration: Exploration) -> Bool[Array, ""]:
    """Whether the policy alone does no better, as far as is known: of no episodes the mean is NaN.

    Never of a single environment, in which nothing is ever held.
    """
    if len(exploration.left) < 2:
        return jnp.array(False)
    alone, with_held = exploration.returns / exploration.episodes
    is_better: Bool[Array, ""] = alone > with_held
    return ~is_better


def paid_for_entropy(exploration: Exploration) -> Float[Array, ""]:
    """1 where the critics' target has entropy in it, 0 as long as nothing is known to pay.

    Values would be of entropy alone then, and hide the first rewards for long.
    """
    return jnp.where(is_worth_it(exploration), 0.0, 1.0)
