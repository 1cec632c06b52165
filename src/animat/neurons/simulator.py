"""The neuron simulator: per condition a distribution of responses, drawn from instead of asking the culture."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Float64, Int, PRNGKeyArray

from animat.errors import InvalidArgument, UnusableData
from animat.neurons.history import INITIAL_HISTORY
from animat.responses.responses import Responses
from animat.tables import briefly

Stored: TypeAlias = Array | np.ndarray[Any, Any]
"""Arrays of a simulator: JAX's, or numpy's while it is on its way to another process."""

LARGEST_BINS = 10_000
"""Of a histogram: a draw compares with each edge, and a recording has some hundred responses."""

PERCENTILES = tuple(range(0, 101, 10))
"""Which percentiles of the pooled non-burst responses a simulator carries: P0 (smallest), P10, ..., P100 (largest)."""


class Answer(NamedTuple):
    """A response, and what is remembered after it.

    Attributes:
        rate_hz: x, Hz per channel; of several readouts one each, shape (readouts,).
        history: the history state, trace and load (`animat.neurons.history`), as `animat.neurons.memory` makes it.
    """

    rate_hz: Float[Array, "*readouts"]
    history: Float[Array, "2"]


class NeuronSimulator(abc.ABC):
    """What a culture answers to each condition, as a pytree of arrays; so a refresh changes data, never code.

    Where several readouts are read, one draw answers for all of them.

    Attributes:
        percentiles: P0, P10, ..., P100 of the non-burst responses of all conditions together, in Hz, shape (11,); of
            several readouts shape (readouts, 11).
        has_memory: whether what it answers depends on what was before.
    """

    percentiles: Float[Stored, "*any percentiles"]
    has_memory: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def n_conditions(self) -> int:
        """How many conditions it answers to."""

    @property
    def n_readouts(self) -> int:
        """For how many readouts it answers at once."""
        return 1 if self.percentiles.ndim == 1 else int(self.percentiles.shape[0])

    @abc.abstractmethod
    def quantile(self, condition: Int[Array, ""], uniform: Float[Array, ""]) -> Float[Array, "*readouts"]:
        """The response x, in Hz per channel, below which the share `uniform` (in [0, 1)) of a condition's lies.

        Of several readouts, which have no order, any function of a uniform that has their joint law.
        """

    def answer(self, condition: Int[Array, ""], uniform: Float[Array, ""], history: Float[Array, "2"]) -> Answer:
        """What is answered to a condition, by a uniform in [0, 1), after a history state (see `Answer`).

        A simulator without memory answers the same whatever was before, and leaves the history as it is.
        """
        return Answer(self.quantile(condition, uniform), history)

    def evenly_drawn(self, n: int) -> Float[Array, "conditions n *readouts"]:
        """The responses to each condition at n evenly spaced quantiles, whatever was before."""
        uniforms = (jnp.arange(n, dtype=jnp.float32) + 0.5) / n
        quantile = jax.vmap(jax.vmap(self.quantile, (None, 0)), (0, None))
        return quantile(jnp.arange(self.n_conditions), uniforms)

    @final
    def sample(
        self, key: PRNGKeyArray, condition: Int[Array, ""], history: ArrayLike | tuple[float, float] = INITIAL_HISTORY
    ) -> Float[Array, "*readouts"]:
        """Draw one response x to a condition, in Hz per channel, after a history state (see `Answer`)."""
        return self.answer(condition, jax.random.uniform(key), jnp.asarray(history, jnp.float32)).rate_hz


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class HistogramSimulator(NeuronSimulator):
    """A normalised histogram per condition: draw a bin, then uniformly inside it (the paper, section 2.3).

    With c the cumulative shares at the edges e, and b the bin in which c_b <= q < c_(b+1):
    x(q) = e_b + (q - c_b) / (c_(b+1) - c_b) (e_(b+1) - e_b).

    Attributes:
        cumulative: share of a condition's responses below each edge, shape (conditions, bins + 1).
        edges_hz: the bins' edges, shape (bins + 1,).
    """

    __repr__ = briefly

    cumulative: Float[Stored, "*recordings conditions edges"]
    edges_hz: Float[Stored, "*recordings edges"]
    percentiles: Float[Stored, "*any percentiles"]

    @property
    def n_conditions(self) -> int:
        return self.cumulative.shape[-2]

    def quantile(self, condition: Int[Array, ""], uniform: Float[Array, ""]) -> Float[Array, ""]:
        return quantile_of(self.cumulative[condition], self.edges_hz, uniform)


def quantile_of(
    cumulative: Float[Stored, " edges"], edges_hz: Float[Stored, " edges"], uniform: Float[Array, ""]
) -> Float[Array, ""]:
    """The quantile of one histogram (see `HistogramSimulator`)."""
    # Twenty comparisons beat a binary search, and an empty bin is never chosen: its two edges share a value.
    bin_ = jnp.sum(uniform >= cumulative[1:-1])
    low, high = cumulative[bin_], cumulative[bin_ + 1]
    within = (uniform - low) / (high - low)
    return jnp.asarray(edges_hz[bin_] + within * (edges_hz[bin_ + 1] - edges_hz[bin_]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EmpiricalSimulator(NeuronSimulator):
    """The measured responses themselves: one of a condition's values is drawn, so nothing is lost to binning.

    x(q) = v_(floor(q n)), v the n sorted values of the condition. Of several readouts a value is a whole trial, and
    trials are sorted by the response of all channels together.

    Attributes:
        values_hz: each condition's responses, sorted, padded at the end, shape (conditions, most responses); of several
            readouts (conditions, most responses, readouts).
        counts: how many of them there are, shape (conditions,).
    """

    __repr__ = briefly

    values_hz: Float[Stored, "..."]
    counts: Int[Stored, "*recordings conditions"]
    percentiles: Float[Stored, "*any percentiles"]

    @property
    def n_conditions(self) -> int:
        return self.counts.shape[-1]

    def quantile(self, condition: Int[Array, ""], uniform: Float[Array, ""]) -> Float[Array, "*readouts"]:
        count = self.counts[condition]
        # float32 rounds a uniform just under 1 times a count up to the count.
        row = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        return self.values_hz[condition, row]


def check_binning(bins: int, range_hz: float | None) -> None:
    """Raise unless a histogram can have such bins, before there is anything to fit it to.

    Raises:
        InvalidArgument: for fewer bins than one or more than `LARGEST_BINS`, or a range that is not positive.
    """
    if not 1 <= bins <= LARGEST_BINS:
        raise InvalidArgument(f"bins: expected 1 to {LARGEST_BINS:,}, got {bins}; only histogram simulators have bins")
    if range_hz is not None and not 0 < range_hz < np.inf:
        raise InvalidArgument(f"range_hz: expected a positive frequency in Hz, got {range_hz:g}")


def fit_histogram(responses: Responses, *, bins: int = 20, range_hz: float | None = None) -> HistogramSimulator:
    """Fit a histogram per condition to the non-burst responses.

    The paper's bins are equally wide, over a range that was chosen for its culture. On another one a bin can hold
    several percentiles, and the differences between conditions that the mapping listens to are lost; responses that
    fall over the hours lose them later on. So by default the edges are percentiles of the responses themselves: with
    20 bins P0, P5, ..., P100 of all conditions together, and what lies on either side of P10, P20, ..., P90 is kept.

    Args:
        responses: of one recording, every condition with at least one non-burst response.
        bins: how many (the paper: 20); a multiple of ten keeps all shares that thresholds ask for.
        range_hz: equally wide bins from 0 to here instead (the paper: 120). Responses above it count into the last
            bin, and `fidelity` says how many they are.

    Raises:
        InvalidArgument: as `check_binning` does.
        UnusableData: if a condition has no non-burst response.
    """
    check_binning(bins, range_hz)
    if range_hz is None:
        edges = np.percentile(_non_burst(responses), np.linspace(0.0, 100.0, bins + 1))
    else:
        edges = np.linspace(0.0, range_hz, bins + 1)
    # Counted in the precision that thresholds are compared in: a response that is a percentile lies above its edge.
    edges = edges.astype(np.float32)
    values = [np.minimum(x.astype(np.float32), edges[-1]) for x in _by_condition(responses)]
    counts = np.array([np.histogram(x, edges)[0] for x in values])
    # Whole counts are added up before dividing, so that the last share is exactly 1 and no empty bin is ever drawn.
    below = np.pad(np.cumsum(counts, axis=1), ((0, 0), (1, 0)))
    cumulative = below / below[:, -1:]
    return HistogramSimulator(placed(cumulative), placed(edges), pooled_percentiles(responses))


def fit_empirical(responses: Responses, *, room: int | None = None) -> EmpiricalSimulator:
    """Keep the non-burst responses of every condition to draw from.

    Args:
        responses: of one recording, every condition with at least one non-burst response.
        room: how many values a condition has room for, so that simulators of several recordings stack; None: as many
            as the largest condition needs.

    Raises:
        UnusableData: if a condition has no non-burst response.
        InvalidArgument: if a condition has more responses than there is room for.
    """
    values = _by_condition(responses)
    counts = np.array([len(x) for x in values])
    room = int(counts.max()) if room is None else room
    if counts.max() > room:
        raise InvalidArgument(f"room: expected at least {counts.max()}, the largest condition's responses, got {room}")
    # Padded with the last one over and over.
    table = np.stack([np.concatenate([x, np.repeat(x[-1:], room - len(x), axis=0)]) for x in values])
    return EmpiricalSimulator(placed(table), placed(counts, np.int32), pooled_percentiles(responses))


def silenced(simulator: NeuronSimulator) -> EmpiricalSimulator:
    """A culture that always answers 0, beside the percentiles of the one that did not: the silent control."""
    conditions, readouts = simulator.n_conditions, simulator.percentiles.shape[:-1]
    zeros, counts = np.zeros((conditions, 1, *readouts)), np.ones(conditions)
    return EmpiricalSimulator(placed(zeros), placed(counts, np.int32), simulator.percentiles)


def indifferent(simulator: NeuronSimulator) -> EmpiricalSimulator:
    """A culture that answers every condition as this one answers all of them together: random spikes, of its rates.

    Responses at 512 evenly spaced quantiles stand for each condition, whatever was before.
    """
    each, n = simulator.evenly_drawn(512), simulator.n_conditions
    pooled = each.reshape(-1, *each.shape[2:])
    pooled = pooled[jnp.argsort(pooled if pooled.ndim == 1 else pooled.mean(axis=1))]
    values = jnp.broadcast_to(pooled, (n, *pooled.shape))
    return EmpiricalSimulator(values, placed(np.full(n, len(pooled)), np.int32), simulator.percentiles)


def pooled_percentiles(responses: Responses) -> Float[Array, "*readouts percentiles"]:
    """P0, P10, ..., P100 of the non-burst responses of all conditions together, interpolated linearly, in Hz."""
    return placed(np.percentile(_non_burst(responses), PERCENTILES, axis=0).T)


def placed(values: Any, kind: type[np.generic] | None = np.float32) -> Array:
    """Numbers of the host as JAX has them, made of this kind (None: as they are) before they get there.

    JAX would compile a program for each shape, also where it is not told the kind and nothing changes.
    """
    with np.errstate(over="ignore"):
        array = np.asarray(values, kind)
    return jnp.asarray(array, jax.dtypes.canonicalize_dtype(array.dtype))


def stacked(leaves: Sequence[Any]) -> Array:
    """`jnp.stack` of arrays that are ready, which are put together on the host: nothing is compiled."""
    return placed(np.stack(leaves), None)


def _non_burst(responses: Responses) -> Float64[np.ndarray, "responses *readouts"]:
    kept: Float64[np.ndarray, "responses *readouts"] = responses.read_hz[~responses.is_burst]
    if not len(kept):
        raise UnusableData("responses: expected at least one non-burst response, got none")
    return kept


def _by_condition(responses: Responses) -> list[Float64[np.ndarray, "responses *readouts"]]:
    """The non-burst responses of each condition, sorted by those of all channels together."""
    if not responses.conditions:
        raise UnusableData("conditions: expected one or more to fit, got none; choose what the stimuli belong to")
    order = np.argsort(responses.read_hz if responses.read_hz.ndim == 1 else responses.rate_hz, kind="stable")
    kept = order[~responses.is_burst[order]]
    values = [responses.read_hz[kept[responses.condition[kept] == c]] for c in range(len(responses.conditions))]
    for condition, x in zip(responses.conditions, values, strict=True):
        if not len(x):
            raise UnusableData(
                f"condition {condition.label}: expected non-burst responses to fit, got none; leave the condition out"
            )
    return values
