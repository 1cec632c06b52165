"""A neuron simulator that remembers: what a culture answers depends on what it answered just before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from animat.neurons.responses import Responses
from animat.neurons.simulator import EmpiricalSimulator, Stored, fit_empirical

_REACHES = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Of n responses n^reach count as nearest; 1: all of them, no memory."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MemorySimulator(EmpiricalSimulator):
    """Draws one of the measured responses to the condition that came after a response like the last one.

    Of a condition's responses, ordered by the response before each of them, one of the k nearest in that order to the
    last response is drawn, all equally likely; where more than k came after the very same response, one of these. No
    distribution and no form of dependence is assumed. With all of them nearest it is the empirical simulator, which its
    `quantile` always is: what is answered when nothing is known of the last response.

    Attributes:
        before_hz: the response before each of a condition's responses, rising, padded with infinity, shape
            (conditions, most responses).
        after_hz: the response itself, in that order, shape (conditions, most responses).
        followers: how many of them there are, shape (conditions,): those before which no burst came.
        nearest: k of each condition, shape (conditions,).

    Source: the nearest-neighbour bootstrap of Lall and Sharma 1996 (doi:10.1029/95WR02966), with one response as its
    memory and without its weights.
    """

    before_hz: Float[Stored, "*recordings conditions values"]
    after_hz: Float[Stored, "*recordings conditions values"]
    followers: Int[Stored, "*recordings conditions"]
    nearest: Int[Stored, "*recordings conditions"]

    has_memory: ClassVar[bool] = True

    def answer(
        self, condition: Int[Array, ""], uniform: Float[Array, ""], last_hz: Float[Array, ""]
    ) -> Float[Array, ""]:
        before, count, nearest = self.before_hz[condition], self.followers[condition], self.nearest[condition]
        smaller, no_larger = jnp.sum(before < last_hz), jnp.sum(before <= last_hz)
        first = jnp.clip((smaller + no_larger - nearest) // 2, 0, count - nearest)
        # Small arrays count few spikes, and many responses came after the same number.
        first, end = jnp.minimum(first, smaller), jnp.maximum(first + nearest, no_larger)
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = jnp.minimum(first + (uniform * (end - first)).astype(jnp.int32), end - 1)
        return self.after_hz[condition, row]


def fit_memory(responses: Responses, *, room: int | None = None) -> MemorySimulator:
    """Keep every condition's non-burst responses, and what was before them, to draw from.

    How far the nearest reach, k = n^reach of a condition's n responses, is the same for all conditions: the largest
    of 0.5, 0.6, ..., 1 with which a response is told by the mean of its neighbours' as well as with the best, up to one
    standard error of the difference, each left out in turn. Responses without memory end at 1, where there is none in
    the simulator either.

    Args:
        responses: of one recording, every condition with at least one non-burst response. Those that came after a
            burst, which the simulator never answers itself, are only drawn where a condition has no others.
        room: how many values a condition has room for, so that simulators of several recordings stack; None: as many
            as the largest condition needs.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.

    Source: the rule of one standard error, Breiman, Friedman, Olshen and Stone 1984.
    """
    values = fit_empirical(responses, room=room)
    shape = values.values_hz.shape
    before, after, followers = np.full(shape, np.inf), np.zeros(shape), np.zeros(shape[0], np.int64)
    last_hz = responses.last_hz
    for condition in range(len(responses.conditions)):
        rows = np.flatnonzero(~responses.is_burst & (responses.condition == condition))
        known = rows[~np.isnan(last_hz[rows])]
        rows = known if len(known) else rows
        rows = rows[np.argsort(last_hz[rows], kind="stable")]
        followers[condition] = len(rows)
        before[condition, : len(rows)] = np.nan_to_num(last_hz[rows])
        after[condition, : len(rows)] = responses.rate_hz[rows]
    reach = _reach([after[condition, :n] for condition, n in enumerate(followers)])
    return MemorySimulator(
        values.values_hz,
        values.counts,
        values.percentiles,
        jnp.asarray(before, jnp.float32),
        jnp.asarray(after, jnp.float32),
        jnp.asarray(followers, jnp.int32),
        jnp.asarray(_nearest(followers, reach), jnp.int32),
    )


def _nearest(followers: Int[np.ndarray, " conditions"], reach: float) -> Int[np.ndarray, " conditions"]:
    return np.rint(followers**reach).astype(np.int64)


def _reach(after_hz: list[Float64[np.ndarray, " followers"]]) -> float:
    """How far the nearest reach, by each condition's responses in the order of the responses before them."""
    pooled = np.sort(np.concatenate(after_hz))
    # In ranks, or the few largest responses would decide.
    ranks = [np.searchsorted(pooled, x) / len(pooled) for x in after_hz if len(x) > 1]
    if not ranks:
        return 1.0
    errors = np.array([np.concatenate([_errors(x, reach) for x in ranks]) for reach in _REACHES])
    worse = errors - errors[errors.mean(axis=1).argmin()]
    allowed = worse.std(axis=1) / np.sqrt(errors.shape[1])
    return max(reach for reach, row, limit in zip(_REACHES, worse, allowed, strict=True) if row.mean() <= limit)


def _errors(ranks: Float64[np.ndarray, " followers"], reach: float) -> Float64[np.ndarray, " followers"]:
    """Squared differences between each response and the mean of the nearest others."""
    n = len(ranks)
    k = int(min(np.rint(n**reach), n - 1))
    first = np.clip(np.arange(n) - k // 2, 0, n - k - 1)
    below = np.concatenate([[0.0], np.cumsum(ranks)])
    others = below[first + k + 1] - below[first] - ranks
    return np.asarray((ranks - others / k) ** 2)
