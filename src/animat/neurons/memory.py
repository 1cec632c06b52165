"""A neuron simulator that remembers: what a culture answers depends on what it answered just before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from animat.neurons.responses import Responses
from animat.neurons.simulator import EmpiricalSimulator, Stored, fit_empirical


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MemorySimulator(EmpiricalSimulator):
    """Draws one of the measured responses to the condition that came after a response like the last one.

    Of a condition's n responses, ordered by the response before each of them, one of the k nearest in that order to
    the last response is drawn, all k equally likely; k = sqrt(n). No distribution and no dependence is assumed. With
    k = n it would be the empirical simulator, which its `quantile` is: what it answers when nothing is known of
    the last response.

    Attributes:
        before_hz: the response before each of a condition's responses, rising, padded with infinity, shape
            (conditions, most responses).
        after_hz: the response itself, in that order, shape (conditions, most responses).
        nearest: k of each condition, shape (conditions,).

    Source: the nearest-neighbour bootstrap of Lall and Sharma 1996 (doi:10.1029/95WR02966), with one response as its
    memory and without its weights.
    """

    before_hz: Float[Stored, "*recordings conditions values"]
    after_hz: Float[Stored, "*recordings conditions values"]
    nearest: Int[Stored, "*recordings conditions"]

    has_memory: ClassVar[bool] = True

    def answer(
        self, condition: Int[Array, ""], uniform: Float[Array, ""], last_hz: Float[Array, ""]
    ) -> Float[Array, ""]:
        before, count, nearest = self.before_hz[condition], self.counts[condition], self.nearest[condition]
        # Twice the middle of the rows that have this response before them: there are many of 0 spikes.
        middle = jnp.sum(before < last_hz) + jnp.sum(before <= last_hz)
        first = jnp.clip((middle - nearest) // 2, 0, count - nearest)
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = first + jnp.minimum((uniform * nearest).astype(jnp.int32), nearest - 1)
        return self.after_hz[condition, row]


def fit_memory(responses: Responses, *, room: int | None = None) -> MemorySimulator:
    """Keep every condition's non-burst responses, and what was before them, to draw from.

    Args:
        responses: of one recording, every condition with at least one non-burst response. What comes before one may be
            a burst.
        room: how many values a condition has room for, so that simulators of several recordings stack; None: as many
            as the largest condition needs.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.
    """
    values = fit_empirical(responses, room=room)
    shape = values.values_hz.shape
    before, after = np.full(shape, np.inf), np.zeros(shape)
    for condition in range(len(responses.conditions)):
        rows = np.flatnonzero(~responses.is_burst & (responses.condition == condition))
        rows = rows[np.argsort(responses.before_hz[rows], kind="stable")]
        before[condition, : len(rows)] = responses.before_hz[rows]
        after[condition, : len(rows)] = responses.rate_hz[rows]
    counts = np.asarray(values.counts)
    return MemorySimulator(
        values.values_hz,
        values.counts,
        values.percentiles,
        jnp.asarray(before, jnp.float32),
        jnp.asarray(after, jnp.float32),
        jnp.asarray(np.rint(np.sqrt(counts)), jnp.int32),
    )
