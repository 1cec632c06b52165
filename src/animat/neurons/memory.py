"""A neuron simulator that remembers: what a culture answers depends on what it was given and answered before."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int, Int64

from animat.brief import briefly
from animat.neurons.simulator import AT_FIRST, Answer, EmpiricalSimulator, Stored, fit_empirical
from animat.responses.conditions import NO_CONDITION
from animat.responses.responses import Presented, Responses


class Memory(NamedTuple):
    """How the history state is made of what was presented and answered, and how much of it an answer hangs on.

        p' = decay p + (1 - decay) (r + weight m) / (1 + weight)

    with p the history state before a response, p' after it, r the response's rank (the share of all responses below it)
    and m the mean rank of its condition. All are in [0, 1]; 0 after silence. Ranks are of the response of all channels,
    also where several readouts are read.

    Attributes:
        decay: of the history before; 0: only the last presentation is remembered.
        weight: of what was presented beside what was answered; 0: only the answer is remembered.
        neighbour_exponent: of n responses the n^neighbour_exponent with the nearest histories may be drawn; 1: all of
            them, whatever the history.
    """

    decay: float
    weight: float
    neighbour_exponent: float


NO_MEMORY = Memory(0.0, 0.0, 1.0)

_DECAYS = (0.0, 0.15, 0.3, 0.45)
_WEIGHTS = (0.0, 0.5, 1.0)
_EXPONENTS = (0.5, 0.6, 0.7, 0.8, 0.9)
_CERTAIN = 2.0
"""Standard errors by which a memory must tell responses better than none: the best of many does by chance, a little."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MemorySimulator(EmpiricalSimulator):
    """Draws one of the measured responses to the condition that had a similar history.

    Of a condition's responses, ordered by their histories (see `Memory`), one of the k nearest in that order is drawn,
    all equally likely; where more than k had the very same history, one of these. No distribution is assumed, and no
    form in which an answer depends on the history. With all of them nearest it is the empirical simulator,
    which its `quantile` always is: what is answered when nothing is known of the history.

    Attributes:
        before: the history of each of a condition's responses, rising, padded with infinity, shape (conditions, most
            responses).
        after_hz: the response itself, in that order, shape (conditions, most responses); of several readouts of one
            trial each, shape (conditions, most responses, readouts).
        left: what it adds to the history, (1 - decay) (r + weight m) / (1 + weight), shape (conditions, most
            responses).
        followers: how many of them there are, shape (conditions,): those before which no burst came.
        nearest: k of each condition, shape (conditions,).
        decay, weight, neighbour_exponent: as in `Memory`.

    Source: the nearest-neighbour bootstrap of Lall and Sharma 1996 (doi:10.1029/95WR02966), with one number as its
    memory and without its weights.
    """

    __repr__ = briefly

    before: Float[Stored, "*recordings conditions values"]
    after_hz: Float[Stored, "..."]
    left: Float[Stored, "*recordings conditions values"]
    followers: Int[Stored, "*recordings conditions"]
    nearest: Int[Stored, "*recordings conditions"]
    decay: Float[Stored, "*recordings"]
    weight: Float[Stored, "*recordings"]
    neighbour_exponent: Float[Stored, "*recordings"]

    has_memory: ClassVar[bool] = True

    @property
    def memory(self) -> Memory:
        """Of a single recording's simulator, as `fit_memory` takes it."""
        return Memory(float(self.decay), float(self.weight), float(self.neighbour_exponent))

    def answer(self, condition: Int[Array, ""], uniform: Float[Array, ""], history: Float[Array, ""]) -> Answer:
        before, count, nearest = self.before[condition], self.followers[condition], self.nearest[condition]
        smaller, no_larger = jnp.sum(before < history), jnp.sum(before <= history)
        first = jnp.clip((smaller + no_larger - nearest) // 2, 0, count - nearest)
        # Small arrays count few spikes, and many responses may have the same history.
        first, end = jnp.minimum(first, smaller), jnp.maximum(first + nearest, no_larger)
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = jnp.minimum(first + (uniform * (end - first)).astype(jnp.int32), end - 1)
        left = jnp.asarray(self.left)[condition, row]
        return Answer(jnp.asarray(self.after_hz)[condition, row], jnp.asarray(self.decay) * history + left)


def fit_memory(responses: Responses, *, room: int | None = None, memory: Memory | None = None) -> MemorySimulator:
    """Keep every condition's non-burst responses, and what was before them, to draw from.

    What is remembered, and the neighbour exponent, are found by leaving out each response in turn and telling it, in
    rank, by the mean of its neighbours. Of twelve ways to make a history the one with the smallest error is taken, and
    of its exponents the largest that is as good as the best, up to one standard error of the difference. Where nothing
    tells responses better than no history at all does, by two standard errors, there is no memory in the simulator
    either.

    Args:
        responses: of one recording, every condition with at least one non-burst response. Those that came after a
            burst, which the simulator never answers itself, are only drawn where a condition has no others.
        room: how many values a condition has room for, so that simulators of several recordings stack; None: as many
            as the largest condition needs.
        memory: to be used in place of the one that is found: for responses that are drawn from others.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.

    Source: the rule of one standard error, Breiman, Friedman, Olshen and Stone 1984.
    """
    values = fit_empirical(responses, room=room)
    ranked = _Ranked(responses)
    memory = memory or _found(ranked)
    history = ranked.histories(memory)
    shape = values.values_hz.shape[:2]
    before, after, left = np.full(shape, np.inf), np.zeros(values.values_hz.shape), np.zeros(shape)
    for condition, rows in enumerate(ranked.rows):
        in_order = rows[np.argsort(history[rows], kind="stable")]
        before[condition, : len(rows)] = history[in_order]
        after[condition, : len(rows)] = responses.read_hz[in_order]
        left[condition, : len(rows)] = _left(ranked.rank[in_order], ranked.means[condition], memory)
    followers = np.array([len(rows) for rows in ranked.rows])
    return MemorySimulator(
        values.values_hz,
        values.counts,
        values.percentiles,
        jnp.asarray(before, jnp.float32),
        jnp.asarray(after, jnp.float32),
        jnp.asarray(left, jnp.float32),
        jnp.asarray(followers, jnp.int32),
        jnp.asarray(np.rint(followers**memory.neighbour_exponent), jnp.int32),
        *(jnp.float32(each) for each in memory),
    )


class _Ranked:
    """Responses by rank.

    Attributes:
        rank: of each, the share of non-burst responses below it, ties half, shape (responses,).
        means: the mean rank of each condition's non-burst responses, shape (conditions,).
        rows: of each condition, the responses that can be drawn.
    """

    def __init__(self, responses: Responses) -> None:
        self._presented, self._place = responses.presentations
        self._sorted_hz = np.sort(responses.non_burst_rate_hz)
        self.rank = self._ranks(responses.rate_hz)
        conditions = range(len(responses.conditions))
        usable = [np.flatnonzero(~responses.is_burst & (responses.condition == c)) for c in conditions]
        self.means = np.array([self.rank[rows].mean() for rows in usable])
        known = ~np.isnan(responses.last_hz)
        self.rows = [rows[known[rows]] if known[rows].any() else rows for rows in usable]

    def _ranks(self, rate_hz: Float64[np.ndarray, " values"]) -> Float64[np.ndarray, " values"]:
        below, no_larger = (np.searchsorted(self._sorted_hz, rate_hz, side=side) for side in ("left", "right"))
        return np.asarray((below + no_larger) / (2 * len(self._sorted_hz)))

    def histories(self, memory: Memory) -> Float64[np.ndarray, " responses"]:
        """What was before each response."""
        presented: Presented = self._presented
        # Of what has no condition of its own the middle one's is as good as any.
        means = np.where(presented.condition == NO_CONDITION, AT_FIRST, self.means[presented.condition])
        left = _left(self._ranks(presented.rate_hz), means, memory)
        history, histories = 0.0, []
        for is_rested, is_burst, more in zip(
            presented.is_rested.tolist(), presented.is_burst.tolist(), left.tolist(), strict=True
        ):
            history = 0.0 if is_rested else history
            histories.append(history)
            # What a burst leaves is not known: what comes right after one is not drawn, and begins anew.
            history = AT_FIRST if is_burst else memory.decay * history + more
        return np.asarray(np.array(histories, np.float64)[self._place])


def _left(
    rank: Float64[np.ndarray, " responses"], mean: Float64[np.ndarray, "#responses"] | float, memory: Memory
) -> Float64[np.ndarray, " responses"]:
    """What responses add to the history."""
    return np.asarray((1 - memory.decay) * (rank + memory.weight * mean) / (1 + memory.weight))


def _found(ranked: _Ranked) -> Memory:
    """The memory that tells responses best, as `fit_memory` says."""
    rows = [rows for rows in ranked.rows if len(rows) > 1]
    if not rows:
        return NO_MEMORY
    # With all of them nearest, every history is as good as any.
    errors = {NO_MEMORY: _errors(ranked.rank, rows, 1.0)}
    for decay, weight in itertools.product(_DECAYS, _WEIGHTS):
        history = ranked.histories(Memory(decay, weight, 1.0))
        in_order = [each[np.argsort(history[each], kind="stable")] for each in rows]
        for neighbour_exponent in _EXPONENTS:
            errors[Memory(decay, weight, neighbour_exponent)] = _errors(ranked.rank, in_order, neighbour_exponent)
    best = min(errors, key=lambda memory: float(errors[memory].mean()))

    def is_as_good(memory: Memory, standard_errors: float) -> bool:
        worse = errors[memory] - errors[best]
        return bool(worse.mean() <= standard_errors * worse.std() / np.sqrt(len(worse)))

    if is_as_good(NO_MEMORY, _CERTAIN):
        return NO_MEMORY
    return max(
        (
            memory
            for memory in errors
            if memory[:2] == best[:2] and memory.neighbour_exponent < 1 and is_as_good(memory, 1.0)
        ),
        key=lambda memory: memory.neighbour_exponent,
    )


def _errors(
    rank: Float64[np.ndarray, " responses"], in_order: Sequence[Int64[np.ndarray, " rows"]], neighbour_exponent: float
) -> Float64[np.ndarray, " rows"]:
    """Squared differences between each response's rank and the mean of the nearest others', in a fixed order.

    Args:
        rank: of all responses.
        in_order: the responses to each condition in the order of their histories.
        neighbour_exponent: of n, n^neighbour_exponent are nearest.
    """
    errors = np.full(len(rank), np.nan)
    for rows in in_order:
        n = len(rows)
        k = int(min(np.rint(n**neighbour_exponent), n - 1))
        first = np.clip(np.arange(n) - k // 2, 0, n - k - 1)
        below = np.concatenate([[0.0], np.cumsum(rank[rows])])
        others = below[first + k + 1] - below[first] - rank[rows]
        errors[rows] = (rank[rows] - others / k) ** 2
    return np.asarray(errors[~np.isnan(errors)])
