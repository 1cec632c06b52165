"""The outcome of an episode: how far each objective was met, whether it succeeded, and by what margin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from animat.goals.goal import Margins, Objective, of_kind
from animat.lazy import Array, jax, jnp


class Tally(NamedTuple):
    """The running record of an episode, without its start; nothing in it affects how the episode continues.

    Attributes:
        inside, is_inside: for each objective, the number of iterations in its region; whether the last state is there.
        margins: for each: to avoid, the smallest distance from the region; to reach, the best margin; else the last.
        failed, reached: whether it has ended in this way; nothing after that is counted.
    """

    iterations: Int[Array, ""]
    inside: Int[Array, " objectives"]
    is_inside: Bool[Array, " objectives"]
    margins: Float[Array, " objectives"]
    failed: Bool[Array, ""]
    reached: Bool[Array, ""]


class Outcome(NamedTuple):
    """The outcome of an episode.

    Attributes:
        succeeded: whether it did not fail and reached a region to reach; with nothing to reach, whether it ended in
            the regions of all objectives except those to avoid.
        satisfaction: for each objective, %. To avoid: 100, or the share of the episode's limit completed before its
            region was entered. To reach: 100, or how near the robot came, 0 from a whole scale on. Others: the share
            of iterations in the region (of the episode's limit if it failed).
        margin: in scales of the quantities, the smallest of all objectives that decide: above 0 if the episode
            succeeded, below 0 if not.
    """

    succeeded: Bool[Array, "*episodes"]
    satisfaction: Float[Array, "*episodes objectives"]
    margin: Float[Array, "*episodes"]

    def means(self) -> dict[str, Any]:
        """Over all episodes, as plain data."""
        satisfaction = np.asarray(self.satisfaction)
        return {
            "success_share": float(np.mean(self.succeeded)),
            "satisfaction_percent": satisfaction.reshape(-1, satisfaction.shape[-1]).mean(axis=0).tolist(),
            "margin": float(np.mean(self.margin)),
        }


MEANS = ("success", "satisfied", "margin")
"""Column heads of `Outcome.means` in a table."""


def cells_of(means: Mapping[str, Any]) -> list[str]:
    """`Outcome.means` as table cells; empty for no episodes."""
    if not means:
        return [""] * len(MEANS)
    satisfied = f"{np.mean(means['satisfaction_percent']):.0f} %"
    return [f"{100 * means['success_share']:.0f} %", satisfied, f"{means['margin']:+z.2f}"]


def satisfaction_line(objectives: Sequence[str], means: Mapping[str, Any]) -> str:
    """How far each objective was met, in one line."""
    pairs = zip(objectives, means["satisfaction_percent"], strict=True)
    return f"satisfied: {'; '.join(f'{objective}: {percent:.0f} %' for objective, percent in pairs)}"


def empty_tally(objectives: Sequence[Objective]) -> Tally:
    """The tally at the start of an episode."""
    n, no = len(objectives), jnp.bool_(False)
    margins = jnp.where(of_kind(objectives, "avoid"), jnp.float32(1.0), -1.0)
    return Tally(jnp.int32(0), jnp.zeros(n, jnp.int32), jnp.zeros(n, bool), margins, no, no)


def add_iteration(
    objectives: Sequence[Objective], tally: Tally, margins: Margins, failed: Bool[Array, ""], reached: Bool[Array, ""]
) -> Tally:
    """Add one iteration, unless the episode has ended before it."""
    margin, inside = margins
    best = jnp.where(of_kind(objectives, "reach"), jnp.maximum(tally.margins, margin), margin)
    kept = jnp.where(of_kind(objectives, "avoid"), jnp.minimum(tally.margins, -margin), best)
    after = Tally(tally.iterations + 1, tally.inside + inside, inside, kept, failed, reached)
    ended = tally.failed | tally.reached
    updated: Tally = jax.tree.map(lambda old, new: jnp.where(ended, old, new), tally, after)
    return updated


def outcome(objectives: Sequence[Objective], tally: Tally, episode_limit: int) -> Outcome:
    """The outcome of an episode by its tally at the end."""
    avoids, reaches, margins = of_kind(objectives, "avoid"), of_kind(objectives, "reach"), tally.margins
    avoided = jnp.where(tally.inside > 0, (tally.iterations - 1) / episode_limit, 1.0)
    out_of = jnp.maximum(jnp.where(tally.failed, episode_limit, tally.iterations), 1)
    # One division each: to divide an array by a number, XLA multiplies by the rounded reciprocal.
    there = jnp.stack([inside / out_of for inside in tally.inside])
    satisfaction = jnp.where(avoids, avoided, jnp.where(reaches, 1.0 + jnp.minimum(margins, 0.0), there))
    if reaches.any():
        # Reaching a region ends the episode, and suffices unless the episode has failed.
        # An episode that failed without entering a region to avoid was too long outside of one to drive to.
        limited = np.array([objective.within is not None for objective in objectives])
        is_late = tally.failed & ~jnp.any(avoids & (tally.inside > 0))
        decides = avoids | (limited & is_late)
        met, margin = tally.reached, jnp.min(margins, where=decides, initial=jnp.max(margins[reaches]))
    else:
        met, margin = jnp.all(tally.is_inside | avoids), jnp.min(margins)
    return Outcome(met & ~tally.failed, 100 * satisfaction, margin)
