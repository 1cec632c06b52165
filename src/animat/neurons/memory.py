"""A neuron simulator with memory: its responses depend on earlier stimuli and responses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Int64

from animat.arguments import checked_arguments
from animat.neurons.history import NO_MEMORY, Memory, Ranked, trace_after_silence, trace_increment
from animat.neurons.simulator import Answer, EmpiricalSimulator, Index, Rates, Scalar, Stored, fit_empirical, to_jax
from animat.responses.responses import Responses
from animat.tables import briefly

_DECAYS = (0.0, 0.15, 0.3, 0.45)
_WEIGHTS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""The larger ones suit few channels, whose response says less about the network than the stimulus does."""
_DECAYS_BELOW_0 = (*_DECAYS, 0.6)
_WEIGHTS_BELOW_0 = (-1.0, -0.75, -0.5, -0.25)
"""For conditions of one frequency: a large response to a strong stimulus says little about the network."""
_EXPONENTS = (0.5, 0.6, 0.7, 0.8, 0.9)
_LOAD_S = 1.0
"""Chosen on virtual cultures 1 to 5: of 0.5, 1, 2 and 4 s it predicted the responses in their closed loops best."""
_FEWEST = 30
"""Responses needed for a condition to have its own slopes; with fewer it has those of all conditions."""
_UNLIKELY = 0.01
"""The largest probability that a load explains as much by chance."""
_CERTAIN = 2.0
"""Standard errors by which a memory must predict better than none, as the best of many is a little better by chance."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MemorySimulator(EmpiricalSimulator):
    """Draws one of the measured responses to the condition that had a similar history.

    Of a condition's responses, ordered by their histories (see `Memory`), one of the k nearest in that order is drawn,
    all equally likely; if more than k had exactly the same history, one of these. The order is that of the trace; with
    a load, it is that of the rank expected from trace and load, a p + b l, with a and b of each condition by
    regression. No distribution is assumed. If all responses are neighbours it is the empirical simulator, as its
    `quantile` always is: the response if nothing is known about the history.

    Attributes:
        before: each response's position in that order, rising, infinity as padding, shape (conditions, most responses).
        histories: the history state before them, trace and load (`Answer`), shape (conditions, most responses, 2).
        after_hz: the responses in that order, shape (conditions, most responses), or with a last axis of readouts.
        left: what each adds to the trace (`Memory`), in the shape of `before`.
        followers: the number of these responses, which are those not preceded by a burst, shape (conditions,).
        nearest: k of each condition, shape (conditions,).
        toward: a and b of each condition, shape (conditions, 2).
        kept: the share of the load that is left when a trial of each condition comes, shape (conditions,).
        added: c, what a trial adds to the load.
        decay, weight, neighbour_exponent, load_s: as in `Memory`.
        rests: whether trials of each condition come after silence, so that the trace is `silence`; None: none do.

    Source: the nearest-neighbour bootstrap of Lall and Sharma 1996 (doi:10.1029/95WR02966), of one number, unweighted.
    """

    __repr__ = briefly

    before: Float[Stored, "*recordings conditions values"]
    histories: Float[Stored, "*recordings conditions values 2"]
    after_hz: Float[Stored, "..."]
    left: Float[Stored, "*recordings conditions values"]
    followers: Int[Stored, "*recordings conditions"]
    nearest: Int[Stored, "*recordings conditions"]
    toward: Float[Stored, "*recordings conditions 2"]
    kept: Float[Stored, "*recordings conditions"]
    added: Float[Stored, "*recordings"]
    decay: Float[Stored, "*recordings"]
    weight: Float[Stored, "*recordings"]
    neighbour_exponent: Float[Stored, "*recordings"]
    load_s: Float[Stored, "*recordings"]
    rests: Bool[Stored, "*recordings conditions"] | None = None

    has_memory: ClassVar[bool] = True

    @property
    def memory(self) -> Memory:
        """The memory of a single recording's simulator, as `fit_memory` takes it."""
        return Memory(float(self.decay), float(self.weight), float(self.neighbour_exponent), float(self.load_s))

    @property
    def silence(self) -> Scalar:
        """The trace after silence, as in `Memory`."""
        return jnp.asarray(trace_after_silence(self.weight))

    def answer(self, condition: Index, uniform: Scalar, history: Float[Array, "2"]) -> Answer:
        load = jnp.asarray(self.kept)[condition] * history[1]
        trace = history[0]
        if self.rests is not None:
            trace = jnp.where(jnp.asarray(self.rests)[condition], self.silence, trace)
        rate_hz, trace = self.answer_at(condition, uniform, trace, load)
        return Answer(rate_hz, jnp.stack([trace, load + jnp.asarray(self.added)]))

    def answer_at(self, condition: Index, uniform: Scalar, trace: Scalar, load: Scalar) -> tuple[Rates, Scalar]:
        """The response for the trace and load at the trial, and the trace after it."""
        first, end = self.rows_near(condition, trace, load)
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = jnp.minimum(first + (uniform * (end - first)).astype(jnp.int32), end - 1)
        trace = jnp.asarray(self.decay) * trace + jnp.asarray(self.left)[condition, row]
        return jnp.asarray(self.after_hz)[condition, row], trace

    def rows_near(self, condition: Index, trace: Scalar, load: Scalar) -> tuple[Index, Index]:
        """The first row of `after_hz` to draw from for a trace and a load, and the row after the last."""
        count, nearest = self.followers[condition], self.nearest[condition]
        toward = jnp.asarray(self.toward)[condition]
        position = toward[0] * trace + toward[1] * load
        before = jnp.asarray(self.before)
        smaller, no_larger = (_n_before(before, condition, position, or_equal=each) for each in (False, True))
        first = jnp.clip((smaller + no_larger - nearest) // 2, 0, count - nearest)
        # Small arrays count few spikes, so many responses may have the same history.
        return jnp.minimum(first, smaller), jnp.maximum(first + nearest, no_larger)


# Under `jit`, so that it is traced once and not in every program that uses it.
@partial(jax.jit, static_argnames="or_equal")
def _n_before(before: Float[Stored, "conditions values"], condition: Index, position: Scalar, or_equal: bool) -> Index:
    """The number of a condition's rows, the first ones, whose position is below a given one, or equal to it too.

    By bisection: comparing all rows, or copying them as `jnp.searchsorted` does, takes many times as long. Unrolled, as
    a GPU would launch each step of a JAX loop separately.
    """
    length = before.shape[-1]
    n: Array = jnp.int32(0)
    for step in (1 << bit for bit in reversed(range(length.bit_length()))):
        middle = n + (step - 1)
        value = before[condition, jnp.minimum(middle, length - 1)]
        is_below = value <= position if or_equal else value < position
        n = jnp.where((middle < length) & is_below, n + step, n)
    return n


@checked_arguments
def fit_memory(responses: Responses, *, room: int | None = None, memory: Memory | None = None) -> MemorySimulator:
    """Keep every condition's non-burst responses, with their histories, to draw from.

    The form of the trace and the neighbour exponent are found by leaving out each response in turn and predicting its
    rank by the mean of its neighbours. Of twenty forms of the trace the one with the smallest error is taken, and of
    its exponents the largest that is as good as the best, within one standard error of the difference. If none predicts
    better than no history at all by two standard errors, the simulator has no memory. If one does, and the times of the
    trials are known, a load with a time constant of one second is added if it explains ranks beyond the trace
    (p < 0.01, F test of linear regressions).

    If all conditions have one frequency, another twenty forms with weights below 0 are tried. If one of these is the
    best, decay and weight are those with which regressions of each condition's ranks on the trace explain most.

    The weight is from 0 to 4 and the decay from 0 to 0.45; with weights from -1 to below 0 the decay is up to 0.6. The
    exponent is from 0.5 to 0.9. How strongly the responses to a condition depend on trace and load, a slope for each,
    is moved towards the slopes of all conditions together, the more so the less certain it is (empirical Bayes).

    Args:
        responses: of one recording, every condition with at least one non-burst response. Those after a burst, which
            the simulator itself never gives, are only drawn if a condition has no others.
        room: as in `fit_empirical`.
        memory: to use instead of fitting one: for bootstrap samples of responses.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.

    Source: the rule of one standard error, Breiman, Friedman, Olshen and Stone 1984.
    """
    values = fit_empirical(responses, room=room)
    ranked = Ranked(responses)
    memory = memory or _find_memory(ranked)
    trace, load = ranked.traces(memory), ranked.loads(memory.load_s)
    memory = memory if load.added else memory._replace(load_s=0.0)
    history, state = (np.stack([trace, each], axis=-1) for each in (load.at, load.after))
    shape = values.values_hz.shape[:2]
    before, after, left = np.full(shape, np.inf), np.zeros(values.values_hz.shape), np.zeros(shape)
    histories, toward = np.zeros((*shape, 2)), np.tile([1.0, 0.0], (shape[0], 1))
    if memory.load_s:
        toward = _slopes([ranked.rank[rows] for rows in ranked.rows], [history[rows] for rows in ranked.rows])
    for condition, rows in enumerate(ranked.rows):
        at = history[rows] @ toward[condition]
        in_order = rows[np.argsort(at, kind="stable")]
        before[condition, : len(rows)] = np.sort(at)
        histories[condition, : len(rows)] = state[in_order]
        after[condition, : len(rows)] = responses.read_hz[in_order]
        left[condition, : len(rows)] = trace_increment(ranked.rank[in_order], ranked.means[condition], memory)
    followers = np.array([len(rows) for rows in ranked.rows])
    return MemorySimulator(
        values_hz=values.values_hz,
        counts=values.counts,
        percentiles=values.percentiles,
        before=to_jax(before),
        histories=to_jax(histories),
        after_hz=to_jax(after),
        left=to_jax(left),
        followers=to_jax(followers, np.int32),
        nearest=to_jax(np.rint(followers**memory.neighbour_exponent), np.int32),
        toward=to_jax(toward),
        kept=to_jax(load.kept),
        added=to_jax(load.added),
        rests=to_jax(ranked.rests, np.bool_),
        **{name: to_jax(value) for name, value in memory._asdict().items()},
    )


def _find_memory(ranked: Ranked) -> Memory:
    rows = [rows for rows in ranked.rows if len(rows) > 1]
    if not rows:
        return NO_MEMORY
    # With all responses as neighbours the history does not matter.
    errors = {NO_MEMORY: _errors(ranked.rank, np.zeros(len(ranked.rank)), rows, [1.0])[0]}

    def of_form(decay: float, weight: float) -> dict[Memory, Float64[np.ndarray, " rows"]]:
        of_exponents = _errors(ranked.rank, ranked.traces(Memory(decay, weight, 1.0)), rows, _EXPONENTS)
        return {Memory(decay, weight, each): of for each, of in zip(_EXPONENTS, of_exponents, strict=True)}

    def best_of(errors: dict[Memory, Float64[np.ndarray, " rows"]]) -> Memory:
        return min(errors, key=lambda memory: float(errors[memory].mean()))

    def is_as_good(memory: Memory, standard_errors: float) -> bool:
        worse = errors[memory] - errors[best]
        return bool(worse.mean() <= standard_errors * worse.std() / np.sqrt(len(worse)))

    for form in itertools.product(_DECAYS, _WEIGHTS):
        errors |= of_form(*form)
    if ranked.has_one_frequency:
        for form in itertools.product(_DECAYS_BELOW_0, _WEIGHTS_BELOW_0):
            errors |= of_form(*form)
    best = best_of(errors)
    if is_as_good(NO_MEMORY, _CERTAIN):
        return NO_MEMORY
    if best.weight < 0:
        errors = of_form(*_refined(ranked))
        best = best_of(errors)
    alike = [memory for memory in errors if memory[:2] == best[:2] and is_as_good(memory, 1.0)]
    found = max(alike, key=lambda memory: memory.neighbour_exponent)
    return found._replace(load_s=_LOAD_S if _has_load(ranked, found) else 0.0)


def _refined(ranked: Ranked) -> tuple[float, float]:
    """The decay and the weight below 0 with which regressions of each condition's ranks on the trace explain most.

    Errors of neighbours' means hardly tell -1 from -0.5, and returns depend on it.
    """

    # Apart from its scale the trace is linear in the weight.
    of_ends = {of: [ranked.traces(Memory(of, end, 1.0)) for end in (0.0, -1.0)] for of in _DECAYS_BELOW_0}

    def explained(form: tuple[float, float]) -> float:
        alone, less_mean = of_ends[form[0]]
        trace = (1 + form[1]) * alone - 2 * form[1] * less_mean
        centred = ((of[rows] - of[rows].mean() for of in (trace, ranked.rank)) for rows in ranked.rows)
        return sum(float(x @ y) ** 2 / (float(x @ x) or 1.0) for x, y in centred)

    return max(itertools.product(_DECAYS_BELOW_0, (-np.arange(1, 21) / 20).tolist()), key=explained)


def _has_load(ranked: Ranked, memory: Memory) -> bool:
    """Whether a load explains ranks that the trace does not."""
    from scipy.stats import f

    trace, load = ranked.traces(memory), ranked.loads(_LOAD_S)
    if not load.added:
        return False
    # Each condition has its own coefficients, so that differences between their means have no influence.
    one = np.concatenate([np.eye(len(ranked.rows))[[c] * len(rows)] for c, rows in enumerate(ranked.rows)])
    every = np.concatenate(ranked.rows)
    rank = ranked.rank[every]

    def squares_left(*regressors: Float64[np.ndarray, " responses"]) -> float:
        design = np.concatenate([one * x[every, None] for x in (np.ones_like(trace), *regressors)], axis=1)
        return float(np.sum((rank - design @ np.linalg.lstsq(design, rank, rcond=None)[0]) ** 2))

    without, with_load = squares_left(trace), squares_left(trace, load.at)
    more, left = len(ranked.rows), len(every) - 3 * len(ranked.rows)
    if left <= 0 or with_load <= 0:
        return False
    return bool(f.sf((without - with_load) / more / (with_load / left), more, left) < _UNLIKELY)


def _slopes(
    ranks: Sequence[Float64[np.ndarray, " rows"]], histories: Sequence[Float64[np.ndarray, "rows 2"]]
) -> Float64[np.ndarray, "conditions 2"]:
    """Slopes of each condition's ranks over trace and load, shrunk towards those of all conditions together.

    The error of a slope from some hundred responses is about as large as the slope. How much the true slopes differ
    between conditions is estimated from all of them (empirical Bayes), and each is moved towards the common one.

    Source: Morris 1983 (doi:10.1080/01621459.1983.10477920).
    """
    pairs = zip(ranks, histories, strict=True)
    centred = [(rank - rank.mean(), history - history.mean(axis=0)) for rank, history in pairs]
    squares = np.array([x.T @ x for _, x in centred])
    products = np.array([x.T @ y for y, x in centred])
    common = np.linalg.lstsq(squares.sum(axis=0), products.sum(axis=0), rcond=None)[0]
    n = sum(map(len, ranks)) - len(ranks) - 2
    variance = sum(float(np.sum((y - x @ common) ** 2)) for y, x in centred) / max(n, 1)
    slopes = np.tile(common, (len(ranks), 1))
    # Slopes from a few responses would reflect chance more than differences between conditions.
    known = [i for i, of in enumerate(squares) if len(ranks[i]) >= _FEWEST and np.linalg.matrix_rank(of) == 2]
    if len(known) < 2 or variance <= 0:
        return slopes
    errors = variance * np.linalg.inv(squares[known])
    alone = np.stack([np.linalg.solve(squares[i], products[i]) for i in known])
    apart = alone.var(axis=0, ddof=1) - np.diagonal(errors, axis1=1, axis2=2).mean(axis=0)
    between = np.diag(1 / np.maximum(apart, 1e-9))
    for i, of_error, of_condition in zip(known, errors, alone, strict=True):
        precision = np.linalg.inv(of_error)
        slopes[i] = np.linalg.solve(precision + between, precision @ of_condition + between @ common)
    return slopes


def _errors(
    rank: Float64[np.ndarray, " responses"],
    history: Float64[np.ndarray, " responses"],
    of_conditions: Sequence[Int64[np.ndarray, " rows"]],
    neighbour_exponents: Sequence[float],
) -> list[Float64[np.ndarray, " rows"]]:
    """Squared differences of each rank from the mean rank of its n^exponent neighbours by history, for each exponent.

    If more have the same history, all of these are neighbours, as in `MemorySimulator.rows_near`: their order is that
    of time, in which drift would look like a memory.
    """
    errors = np.full((len(neighbour_exponents), len(rank)), np.nan)
    for of_condition in of_conditions:
        rows = of_condition[np.argsort(history[of_condition], kind="stable")]
        n, at, own = len(rows), history[rows], rank[rows]
        smaller, no_larger = at.searchsorted(at, "left"), at.searchsorted(at, "right")
        alike, here = no_larger - smaller, np.arange(n)
        below = np.concatenate([[0.0], np.cumsum(own)])
        for of_exponent, neighbour_exponent in zip(errors, neighbour_exponents, strict=True):
            k = int(min(np.rint(n**neighbour_exponent), n - 1))
            first = np.minimum(np.maximum(here - k // 2, 0), n - k - 1)
            is_common = alike > k + 1
            begin, end = np.where(is_common, smaller, first), np.where(is_common, no_larger, first + k + 1)
            others = below[end] - below[begin] - own
            of_exponent[rows] = (own - others / (end - begin - 1)) ** 2
    return [np.asarray(each[~np.isnan(each)]) for each in errors]
