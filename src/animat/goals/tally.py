"""What an episode comes to: how far each objective was met, whether it succeeded, and by what margin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from animat.goals.goal import Objective
from animat.lazy import Array, jax, jnp

Seen = Sequence[tuple["Float[Array, '']", "Bool[Array, '']"]]
"""Of each objective the margin in [-1, 1], and whether the robot is in its region."""


class Tally(NamedTuple):
    """What an episode has come to so far, its start apart; nothing in it decides how it goes on.

    Attributes:
        inside: of each objective, in how many the robot was in its region.
        is_inside: of each, whether it is in the last state.
        margins: of each: to avoid, the least distance from the region; to reach, the nearest to it or farthest within;
            of others, that of the last state.
        failed, reached: whether it has ended so; what comes after that is not counted.
    """

    iterations: Int[Array, ""]
    inside: tuple[Int[Array, ""], ...]
    is_inside: tuple[Bool[Array, ""], ...]
    margins: tuple[Float[Array, ""], ...]
    failed: Bool[Array, ""]
    reached: Bool[Array, ""]


class Outcome(NamedTuple):
    """What an episode came to.

    Attributes:
        succeeded: it did not fail, and reached what was to be reached; where nothing was, it ended in the regions of
            all objectives but those to avoid.
        satisfaction: of each objective, %. To avoid: 100, or the part of the episode's limit that was done before its
            region was entered. To reach: 100, or how near it came, 0 from a whole scale on. Of others: the part of
            the iterations in the region, of the episode's limit where it failed.
        margin: in scales of the quantities, the least of all objectives that decide: it succeeded where this is above
            0, and did not where it is below.
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
"""What a table calls `Outcome.means`."""


def cells_of(means: Mapping[str, Any]) -> list[str]:
    """`Outcome.means` in a table; of no episodes empty."""
    if not means:
        return [""] * len(MEANS)
    satisfied = f"{np.mean(means['satisfaction_percent']):.0f} %"
    return [f"{100 * means['success_share']:.0f} %", satisfied, f"{means['margin']:+.2f}"]


def told_satisfaction(objectives: Sequence[str], means: Mapping[str, Any]) -> str:
    """How far each objective was met, in a line."""
    of_each = zip(objectives, means["satisfaction_percent"], strict=True)
    return f"satisfied: {'; '.join(f'{objective}: {percent:.0f} %' for objective, percent in of_each)}"


def nothing_yet(objectives: Sequence[Objective]) -> Tally:
    """Of an episode at its start."""
    margins = tuple(jnp.float32(1.0 if each.kind == "avoid" else -1.0) for each in objectives)
    none, no = jnp.int32(0), jnp.bool_(False)
    return Tally(none, tuple(none for _ in objectives), tuple(no for _ in objectives), margins, no, no)


def counted(
    objectives: Sequence[Objective], tally: Tally, seen: Seen, failed: Bool[Array, ""], reached: Bool[Array, ""]
) -> Tally:
    """With one more iteration, where the episode has not ended before it."""

    def margin(kind: str, before: Array, now: Array) -> Array:
        if kind == "avoid":
            return jnp.minimum(before, -now)
        return jnp.maximum(before, now) if kind == "reach" else now

    after = Tally(
        tally.iterations + 1,
        tuple(before + inside for before, (_, inside) in zip(tally.inside, seen, strict=True)),
        tuple(inside for _, inside in seen),
        tuple(margin(of.kind, *m) for of, *m in zip(objectives, tally.margins, (m for m, _ in seen), strict=True)),
        failed,
        reached,
    )
    ended = tally.failed | tally.reached
    counts: Tally = jax.tree.map(lambda old, new: jnp.where(ended, old, new), tally, after)
    return counts


def outcome(objectives: Sequence[Objective], tally: Tally, episode_limit: int) -> Outcome:
    """What a tally says at the end of an episode."""
    out_of = jnp.maximum(jnp.where(tally.failed, episode_limit, tally.iterations), 1)

    def satisfaction(kind: str, inside: Array, margin: Array) -> Array:
        if kind == "avoid":
            return jnp.where(inside > 0, (tally.iterations - 1) / episode_limit, 1.0)
        return 1.0 + jnp.minimum(margin, 0.0) if kind == "reach" else inside / out_of

    told = list(zip((of.kind for of in objectives), tally.margins, tally.is_inside, strict=True))
    avoided = [margin for kind, margin, _ in told if kind == "avoid"]
    reaches = [margin for kind, margin, _ in told if kind == "reach"]
    others = [(margin, inside) for kind, margin, inside in told if kind not in ("avoid", "reach")]
    # What is reached ends the episode, and nothing else is then asked but that it has not failed.
    deciding = [reduce(jnp.maximum, reaches)] if reaches else [margin for margin, _ in others]
    met = tally.reached if reaches else reduce(jnp.logical_and, [inside for _, inside in others], jnp.bool_(True))
    each = zip(objectives, tally.inside, tally.margins, strict=True)
    return Outcome(
        met & ~tally.failed,
        100 * jnp.stack([jnp.float32(satisfaction(of.kind, *known)) for of, *known in each]),
        # What has failed may be another objective than those that decide where nothing failed.
        jnp.where(tally.failed, reduce(jnp.minimum, tally.margins), reduce(jnp.minimum, [*avoided, *deciding])),
    )
