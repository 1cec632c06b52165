"""The neuron simulator: a distribution of responses per condition, to draw from in place of the culture."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Float32, Float64, Int, Int64, PRNGKeyArray

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, UnusableData
from animat.neurons.history import INITIAL_HISTORY
from animat.responses.responses import Responses
from animat.tables import briefly

Stored: TypeAlias = Array | np.ndarray[Any, Any]
"""Arrays of a simulator: JAX's, or numpy's while it travels to another process."""
Scalar: TypeAlias = Float[Array, ""]
Index: TypeAlias = Int[Array, ""]
Rates: TypeAlias = Float[Array, "*readouts"]
LARGEST_BINS = 10_000
"""Most bins of a histogram: a draw compares with each edge, and a recording has some hundred responses."""
PERCENTILES = tuple(range(0, 101, 10))
"""The percentiles of the pooled non-burst responses that a simulator carries."""
_BELOW_ONE = float(np.nextafter(np.float32(1.0), np.float32(0.0)))


class Answer(NamedTuple):
    """A response, and the history state after it.

    Attributes:
        rate_hz: x, Hz per channel; with several readouts one each, shape (readouts,).
        history: the history state, trace and load (`animat.neurons.history`), as `animat.neurons.memory` updates it.
    """

    rate_hz: Rates
    history: Float[Array, "2"]


class NeuronSimulator(abc.ABC):
    """A culture's responses to each condition, as a pytree of arrays, so that a refresh changes data, never code.

    With several readouts, one draw answers for all of them.

    Attributes:
        percentiles: P0, P10, ..., P100 of all non-burst responses together, in Hz, shape (11,), or (readouts, 11).
        has_memory: whether its answers depend on the history.
    """

    percentiles: Float[Stored, "*any percentiles"]
    has_memory: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def n_conditions(self) -> int:
        """The number of conditions."""

    @property
    def n_readouts(self) -> int:
        """The number of readouts that it answers for together."""
        return 1 if self.percentiles.ndim == 1 else int(self.percentiles.shape[0])

    @abc.abstractmethod
    def quantile(self, condition: Index, uniform: Scalar) -> Rates:
        """The response x, in Hz per channel, below which the share `uniform` (in [0, 1)) of a condition's lies.

        With several readouts, which have no order, any function of a uniform that has their joint distribution.
        """

    def answer(self, condition: Index, uniform: Scalar, history: Float[Array, "2"]) -> Answer:
        """The answer to a condition, from a uniform in [0, 1), after a history state (see `Answer`).

        A simulator without memory answers the same after any history, and leaves the history unchanged.
        """
        return Answer(self.quantile(condition, uniform), history)

    def evenly_drawn(self, n: int) -> Float[Array, "conditions n *readouts"]:
        """The responses to each condition at n evenly spaced quantiles, ignoring the history."""
        uniforms = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
        quantile = jax.vmap(jax.vmap(self.quantile, (None, 0)), (0, None))
        return quantile(jnp.arange(self.n_conditions), uniforms)

    @final
    def sample(
        self, key: PRNGKeyArray, condition: Index, history: ArrayLike | tuple[float, float] = INITIAL_HISTORY
    ) -> Rates:
        """Draw one response x to a condition, in Hz per channel, after a history state (see `Answer`)."""
        uniform = jax.random.uniform(key, dtype=jnp.float32)
        return self.answer(condition, uniform, jnp.asarray(history, jnp.float32)).rate_hz


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HistogramSimulator(NeuronSimulator):
    """A normalised histogram per condition: draw a bin, then uniformly inside it (the paper, section 2.3).

    With c the cumulative shares at the edges e, and b the bin in which c_b <= q < c_(b+1):
    x(q) = e_b + (q - c_b) / (c_(b+1) - c_b) (e_(b+1) - e_b).

    Attributes:
        cumulative: share of a condition's responses below each edge, shape (conditions, bins + 1).
    """

    __repr__ = briefly

    cumulative: Float[Stored, "*recordings conditions edges"]
    edges_hz: Float[Stored, "*recordings edges"]
    percentiles: Float[Stored, "*any percentiles"]

    @property
    def n_conditions(self) -> int:
        return self.cumulative.shape[-2]

    def quantile(self, condition: Index, uniform: Scalar) -> Scalar:
        return _quantile_of(self.cumulative[condition], self.edges_hz, uniform)


def _quantile_of(cumulative: Float[Stored, " edges"], edges_hz: Float[Stored, " edges"], uniform: Scalar) -> Scalar:
    """The quantile of one histogram (see `HistogramSimulator`)."""
    # Twenty comparisons beat a binary search, and an empty bin is never chosen, as its two edges share a value.
    bin_ = jnp.sum(uniform >= cumulative[1:-1])
    low, high = cumulative[bin_], cumulative[bin_ + 1]
    within = (uniform - low) / (high - low)
    return jnp.asarray(edges_hz[bin_] + within * (edges_hz[bin_ + 1] - edges_hz[bin_]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JointHistogramSimulator(NeuronSimulator):
    """A histogram per condition and readout, drawn together by the ranks of one recorded trial (an empirical copula).

    One of the n trials of a condition is drawn, all equally likely. With r_d the rank of readout d in it, from 0, and w
    uniform in [0, 1), the same for all readouts of the trial:

        x_d = Q_d((r_d + w) / n),    Q_d: the quantiles of the histogram of readout d

    So each readout alone has the distribution of its histogram (the paper's), and the readouts have the rank
    correlation of the recording. Tied responses are ranked at random, separately for each readout.

    Attributes:
        cumulative: share of a condition's responses below each edge, shape (readouts, conditions, bins + 1).
        ranks: of the readouts in each trial, padded with 0, shape (conditions, most trials, readouts).
        counts: trials of each condition, shape (conditions,).

    Source: coupling by an empirical copula, Schefzik, Thorarinsdottir and Gneiting 2013, doi:10.1214/13-STS443.
    """

    __repr__ = briefly

    cumulative: Float[Stored, "*recordings readouts conditions edges"]
    edges_hz: Float[Stored, "*recordings readouts edges"]
    ranks: Float[Stored, "*recordings conditions trials readouts"]
    counts: Int[Stored, "*recordings conditions"]
    percentiles: Float[Stored, "*recordings readouts percentiles"]

    @property
    def n_conditions(self) -> int:
        return self.counts.shape[-1]

    def quantile(self, condition: Index, uniform: Scalar) -> Float[Array, " readouts"]:
        count = jnp.asarray(self.counts)[condition]
        # float32 rounds a uniform just under 1 times a count up to the count.
        trial = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        shares = (jnp.asarray(self.ranks)[condition, trial] + (uniform * count - trial)) / count
        cumulative, edges_hz = jnp.asarray(self.cumulative)[:, condition], jnp.asarray(self.edges_hz)
        return jax.vmap(_quantile_of)(cumulative, edges_hz, jnp.clip(shares, 0.0, _BELOW_ONE))


Histograms: TypeAlias = HistogramSimulator | JointHistogramSimulator


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EmpiricalSimulator(NeuronSimulator):
    """The measured responses themselves: one of a condition's values is drawn, so nothing is lost to binning.

    x(q) = v_(floor(q n)), v the n sorted values of the condition. With several readouts a value is a whole trial, and
    trials are sorted by the response of all channels together.

    Attributes:
        values_hz: sorted responses, padded, shape (conditions, most responses), or with a last axis of readouts.
        counts: the number of responses, shape (conditions,).
    """

    __repr__ = briefly

    values_hz: Float[Stored, "..."]
    counts: Int[Stored, "*recordings conditions"]
    percentiles: Float[Stored, "*any percentiles"]

    @property
    def n_conditions(self) -> int:
        return self.counts.shape[-1]

    def quantile(self, condition: Index, uniform: Scalar) -> Rates:
        count = self.counts[condition]
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        return self.values_hz[condition, row]


def check_binning(bins: int, range_hz: float | None) -> None:
    """Raise InvalidArgument for a number of bins or a range that no histogram can have."""
    if not 1 <= bins <= LARGEST_BINS:
        raise InvalidArgument(f"bins: expected 1 to {LARGEST_BINS:,}, got {bins}; only histogram simulators have bins")
    if range_hz is not None and not 0 < range_hz < np.inf:
        raise InvalidArgument(f"range_hz: expected a positive frequency in Hz, got {range_hz:g}")


@checked_arguments
def fit_histogram(responses: Responses, *, bins: int = 20, range_hz: float | None = None) -> HistogramSimulator:
    """Fit a histogram per condition to the non-burst responses.

    The paper's bins are equally wide, over a range chosen for its culture; for another one, or later, a bin can hold
    several percentiles, and the differences between conditions that the mapping uses are lost. So by default the edges
    are percentiles of the responses: with 20 bins P0, P5, ..., P100 of all conditions together.

    Args:
        responses: of one recording, every condition with at least one non-burst response.
        bins: how many (the paper: 20); a multiple of ten keeps all shares that thresholds use.
        range_hz: equally wide bins from 0 to here instead (the paper: 120); responses above it count in the last bin.

    Raises:
        InvalidArgument: as `check_binning` does.
        UnusableData: if a condition has no non-burst response.
    """
    check_binning(bins, range_hz)
    if range_hz is None:
        edges = np.percentile(_non_burst(responses), np.linspace(0.0, 100.0, bins + 1))
    else:
        edges = np.linspace(0.0, range_hz, bins + 1)
    # Counted in the precision in which thresholds are compared: a response that equals a percentile is above its edge.
    edges = edges.astype(np.float32)
    values = [np.minimum(x.astype(np.float32), edges[-1]) for x in _by_condition(responses)]
    counts = np.array([np.bincount(_bins_of(x, edges), minlength=bins) for x in values])
    # Counts are added up before dividing, so that the last share is exactly 1 and no empty bin is ever drawn.
    below = np.pad(np.cumsum(counts, axis=1), ((0, 0), (1, 0)))
    cumulative = below / below[:, -1:]
    return HistogramSimulator(to_jax(cumulative), to_jax(edges), pooled_percentiles(responses))


def _bins_of(x_hz: Float32[np.ndarray, " n"], edges_hz: Float32[np.ndarray, " edges"]) -> Int64[np.ndarray, " n"]:
    """The bin of each response: from an edge up to the next; where edges are equal, that between the last two of them.

    A response that many others equal, such as 0 with few channels, is then drawn as it is.
    """
    place = np.searchsorted(edges_hz, x_hz, side="right") - 1
    is_tied = (place > 0) & (edges_hz[np.maximum(place - 1, 0)] == x_hz)
    return np.asarray(np.minimum(place - is_tied, len(edges_hz) - 2))


def fit_joint_histogram(
    responses: Responses, *, bins: int = 20, range_hz: float | None = None, room: int | None = None
) -> JointHistogramSimulator:
    """Fit a histogram per condition to each of several readouts, and keep their ranks in each trial.

    Arguments and errors are those of `fit_histogram` and `fit_empirical`.
    """
    each_alone = (responses.of_readout(d) for d in range(len(responses.readouts)))
    alone = [fit_histogram(each, bins=bins, range_hz=range_hz) for each in each_alone]
    of_condition = [responses.read_of(c) for c in range(len(responses.conditions))]
    counts = np.array([len(read_hz) for read_hz in of_condition])
    ranks = np.zeros((len(counts), max(int(counts.max()), room or 0), len(alone)))
    # A fixed seed: the same responses give the same simulator.
    rng = np.random.default_rng(0)
    for condition, read_hz in enumerate(of_condition):
        for d, x_hz in enumerate(read_hz.T):
            order = np.lexsort((rng.random(len(x_hz)), x_hz))
            ranks[condition, order, d] = np.arange(len(x_hz))
    together: HistogramSimulator = jax.tree.map(stacked, *alone)
    joint = to_jax(ranks), to_jax(counts, np.int32)
    return JointHistogramSimulator(together.cumulative, together.edges_hz, *joint, together.percentiles)


@checked_arguments
def fit_empirical(responses: Responses, *, room: int | None = None) -> EmpiricalSimulator:
    """Keep the non-burst responses of every condition to draw from.

    Args:
        responses: of one recording, every condition with at least one non-burst response.
        room: values that each condition has room for, so that simulators stack; None: as many as the largest needs.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.
    """
    values = _by_condition(responses)
    counts = np.array([len(x) for x in values])
    room = int(counts.max()) if room is None else room
    if counts.max() > room:
        raise InvalidArgument(f"room: expected at least {counts.max()}, the largest condition's responses, got {room}")
    # Padded by repeating the last value.
    table = np.stack([np.concatenate([x, np.repeat(x[-1:], room - len(x), axis=0)]) for x in values])
    return EmpiricalSimulator(to_jax(table), to_jax(counts, np.int32), pooled_percentiles(responses))


def silenced(simulator: NeuronSimulator) -> EmpiricalSimulator:
    """A culture that always answers 0, with the percentiles of the original: the silent control."""
    conditions, readouts = simulator.n_conditions, simulator.percentiles.shape[:-1]
    zeros, counts = np.zeros((conditions, 1, *readouts)), np.ones(conditions)
    return EmpiricalSimulator(to_jax(zeros), to_jax(counts, np.int32), simulator.percentiles)


def indifferent(simulator: NeuronSimulator) -> EmpiricalSimulator:
    """A culture that answers every condition with the responses to all, those to each equally often: random spikes.

    Responses at 512 evenly spaced quantiles represent each condition, ignoring the history.
    """
    each, n = simulator.evenly_drawn(512), simulator.n_conditions
    pooled = each.reshape(-1, *each.shape[2:])
    pooled = pooled[jnp.argsort(pooled if pooled.ndim == 1 else pooled.mean(axis=1))]
    values = jnp.broadcast_to(pooled, (n, *pooled.shape))
    return EmpiricalSimulator(values, to_jax(np.full(n, len(pooled)), np.int32), simulator.percentiles)


def pooled_percentiles(responses: Responses) -> Float[Array, "*readouts percentiles"]:
    """P0, P10, ..., P100 of the non-burst responses of all conditions together, interpolated linearly, in Hz."""
    return to_jax(np.percentile(_non_burst(responses), PERCENTILES, axis=0).T)


def to_jax(values: Any, kind: type[np.generic] | None = np.float32) -> Array:
    """A JAX array of the host's numbers, converted to a type (None: unchanged) by numpy.

    JAX would compile a program for each shape, even if no type is given and nothing changes.
    """
    with np.errstate(over="ignore"):
        array = np.asarray(values, kind)
    return jnp.asarray(array, jax.dtypes.canonicalize_dtype(array.dtype))


def stacked(*leaves: Any) -> Array:
    """`jnp.stack` of computed arrays, but stacked on the host, so that nothing is compiled."""
    return to_jax(np.stack(leaves), None)


def _non_burst(responses: Responses) -> Float64[np.ndarray, "responses *readouts"]:
    kept: Float64[np.ndarray, "responses *readouts"] = responses.read_hz[~responses.is_burst]
    if not len(kept):
        raise UnusableData("responses: expected at least one non-burst response, got none")
    return kept


def _by_condition(responses: Responses) -> list[Float64[np.ndarray, "responses *readouts"]]:
    """The non-burst responses of each condition, sorted by those of all channels together."""
    if not responses.conditions:
        raise UnusableData("conditions: expected one or more to fit, got none; choose the conditions of the stimuli")
    order = np.argsort(responses.read_hz if responses.read_hz.ndim == 1 else responses.rate_hz, kind="stable")
    kept = order[~responses.is_burst[order]]
    values = [responses.read_hz[kept[responses.condition[kept] == c]] for c in range(len(responses.conditions))]
    for condition, x in zip(responses.conditions, values, strict=True):
        if not len(x):
            got = "none, which --allow cannot change: leave it out, or choose others (--conditions)"
            raise UnusableData(f"condition {condition.label}: expected non-burst responses to fit, got {got}")
    return values
