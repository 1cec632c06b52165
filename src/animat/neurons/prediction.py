"""Predictions of the second half of a recording by simulators of the first: response by response, and in free runs."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Float64, Int64

from animat.errors import UnusableData
from animat.neurons.history import Ranked
from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import EmpiricalSimulator, Histograms, NeuronSimulator, pooled_percentiles
from animat.responses.responses import Responses

FEWEST = 20
"""Non-burst responses of each condition needed in each half: fewer do not make a distribution."""
CLASSES = 10
"""Between the percentiles P10 to P90: the commands of nine thresholds."""
LAGS = 10
"""The largest lag of correlations, and the largest run length counted separately."""


class Halves(NamedTuple):
    """A recording's responses in two parts.

    Attributes:
        first: those to fit to.
        rows: the non-burst responses of the second part, by their row in `whole`.
        condition, x_hz: of these, in the precision in which thresholds are compared.
        values_hz: all distinct values of responses in the recording, of any condition and half, rising.
        percentiles_hz: P0, P10, ..., P100 of the first part.
        readout: the readout of these responses; None: the only one.
    """

    whole: Responses
    first: Responses
    rows: Int64[np.ndarray, " held"]
    condition: Int64[np.ndarray, " held"]
    x_hz: Float32[np.ndarray, " held"]
    values_hz: Float32[np.ndarray, " values"]
    percentiles_hz: Float32[np.ndarray, " percentiles"]
    readout: int | None = None

    def read(self, every: Float[np.ndarray, "*some"]) -> Float[np.ndarray, "*others"]:
        """The readout's part of an array whose last axis, with several readouts, is that of readouts."""
        return every if self.readout is None else every[..., self.readout]

    def first_of(self, condition: int) -> Float64[np.ndarray, " fitted"]:
        """The non-burst responses to one condition in the first half, in Hz."""
        return self.read(self.first.read_of(condition))

    def commands_of(self, x_hz: Float[np.ndarray, " some"]) -> Int64[np.ndarray, " some"]:
        """The commands of responses with nine thresholds, from 0 to 9."""
        return np.searchsorted(self.percentiles_hz[1:10], x_hz, side="right")


def halved(responses: Responses, readout: int | None = None) -> Halves:
    """Split a recording's responses in the middle: by time, or within each condition if presented in blocks.

    Raises UnusableData for one condition, or a half with fewer than `FEWEST` non-burst responses to a condition.
    """
    labels = [condition.label for condition in responses.conditions]
    if len(labels) < 2:
        got = f"{', '.join(labels) or 'none'}; choose others (--conditions)"
        raise UnusableData(f"conditions: expected two or more, so that there is something to predict from, got {got}")
    is_held = np.arange(len(responses)) >= len(responses) // 2
    if responses.is_blocked:
        for c in range(len(labels)):
            of = np.flatnonzero(responses.condition == c)
            is_held[of] = np.arange(len(of)) >= len(of) // 2
    for c, label in enumerate(labels):
        usable = ~responses.is_burst & (responses.condition == c)
        n = [int(np.count_nonzero(usable & part)) for part in (~is_held, is_held)]
        if min(n) < FEWEST:
            got = f"{n[0]} and {n[1]}; leave it out (--conditions), or record more trials"
            raise UnusableData(f"condition {label}: expected {FEWEST} non-burst responses in each half, got {got}")
    rows, first = np.flatnonzero(is_held & ~responses.is_burst), responses.at_rows(np.flatnonzero(~is_held))
    x_hz = (responses.read_hz if readout is None else responses.read_hz[:, readout]).astype(np.float32)
    percentiles_hz = np.asarray(pooled_percentiles(first))[... if readout is None else readout]
    condition, values_hz = responses.condition[rows], np.unique(x_hz)
    return Halves(responses, first, rows, condition, x_hz[rows], values_hz, percentiles_hz, readout)


class Prediction(NamedTuple):
    """Distributions over the values of a recording, one for each held-out response, made from `n` responses each."""

    halves: Halves
    probability: Float64[np.ndarray, "held values"]
    n: Float64[np.ndarray, " held"]

    @property
    def at_most(self) -> Float64[np.ndarray, "held values"]:
        """The distribution functions."""
        return np.cumsum(self.probability, axis=1)

    def crps(self) -> Float64[np.ndarray, " held"]:
        """The continuous ranked probability score of each held-out response, in Hz; smaller is better.

            CRPS = integral of (F(z) - 1[z >= x])^2 dz

        Source: Gneiting and Raftery 2007, doi:10.1198/016214506000001437.
        """
        values_hz = self.halves.values_hz.astype(np.float64)
        passed = values_hz[:-1] >= self.halves.x_hz[:, None]
        return np.asarray((self.at_most[:, :-1] - passed) ** 2 @ np.diff(values_hz))

    def transforms(self) -> Float64[np.ndarray, "held 2"]:
        """The probability integral transform of each held-out response, F(x-) and F(x): below x, and up to it."""
        at = np.searchsorted(self.halves.values_hz, self.halves.x_hz)[:, None]
        mass = np.take_along_axis(self.probability, at, 1)
        up_to = np.take_along_axis(self.at_most, at, 1)
        return np.concatenate([up_to - mass, up_to], axis=1)

    def of_commands(self, prior: Float64[np.ndarray, "held classes"] | float) -> Float64[np.ndarray, "held classes"]:
        """The probability of each command with nine thresholds, for each held-out response.

        A command that was never drawn is not impossible. Ten responses, distributed as in a coarser prediction
        (`prior`), are added to the n that a prediction is made from: p = (n p_n + 10 prior) / (n + 10).
        """
        n, commands = self.n[:, None], np.eye(CLASSES)[self.halves.commands_of(self.halves.values_hz)]
        return np.asarray((n * (self.probability @ commands) + CLASSES * prior) / (n + CLASSES))


def predict(simulator: NeuronSimulator | None, halves: Halves) -> Prediction:
    """Predict each held-out response by a simulator of the first half; None: by the responses to all conditions.

    The condition is known and, if the simulator has a memory, everything recorded before. A histogram's draw counts as
    the largest value of the recording that is not above it, so that thresholds give the same commands.
    """
    if isinstance(simulator, MemorySimulator):
        return _predict_with_memory(simulator, halves)
    values_hz, n_conditions = halves.values_hz, len(halves.whole.conditions)
    if simulator is None:
        x_hz = halves.read(halves.first.read_hz)[~halves.first.is_burst].astype(np.float32)
        of_condition, counts = [_shares(x_hz, values_hz)] * n_conditions, np.full(n_conditions, len(x_hz))
    elif isinstance(simulator, EmpiricalSimulator):
        counts = np.asarray(simulator.counts)
        table = halves.read(np.asarray(simulator.values_hz))
        of_condition = [_shares(x[:n], values_hz) for x, n in zip(table, counts, strict=True)]
    else:
        assert isinstance(simulator, Histograms)
        counts = np.array([len(halves.first_of(c)) for c in range(n_conditions)])
        own = ... if halves.readout is None else halves.readout
        cumulatives, edges_hz = np.asarray(simulator.cumulative)[own], np.asarray(simulator.edges_hz)[own]
        of_condition = [np.diff(_p_below(each, edges_hz, values_hz[1:]), prepend=0, append=1) for each in cumulatives]
    return Prediction(halves, np.stack(of_condition)[halves.condition], counts[halves.condition].astype(np.float64))


def _predict_with_memory(simulator: MemorySimulator, halves: Halves) -> Prediction:
    places = halves.whole.presentations[1][halves.rows]
    ranked, memory = Ranked(halves.first), simulator.memory
    trace, load = ranked.recorded(memory)[0], ranked.loads(memory.load_s).every
    at = (each[places].astype(np.float32) for each in (trace, load))
    first, end = (np.asarray(each) for each in _rows_near(simulator, halves.condition, *at))
    after_hz, rows = halves.read(np.asarray(simulator.after_hz)), zip(halves.condition, first, end, strict=True)
    shares = [_shares(after_hz[c, a:b], halves.values_hz) for c, a, b in rows]
    return Prediction(halves, np.stack(shares), (end - first).astype(np.float64))


_rows_near = jax.jit(jax.vmap(MemorySimulator.rows_near, (None, 0, 0, 0)))


def _shares(x_hz: Float[np.ndarray, " n"], values_hz: Float[np.ndarray, " values"]) -> Float64[np.ndarray, " values"]:
    return np.bincount(np.searchsorted(values_hz, x_hz), minlength=len(values_hz)) / len(x_hz)


def _p_below(
    cumulative: Float[np.ndarray, " edges"], edges_hz: Float[np.ndarray, " edges"], x_hz: Float[np.ndarray, " some"]
) -> Float64[np.ndarray, " some"]:
    """P(draw < x) of a histogram; a bin between two equal edges is drawn as that value."""
    inside = np.interp(x_hz, edges_hz, cumulative, left=0.0, right=1.0)
    place = np.minimum(np.searchsorted(edges_hz, x_hz), len(edges_hz) - 1)
    return np.asarray(np.where(edges_hz[place] == x_hz, cumulative[place], inside), np.float64)


def share_below(
    transforms: Float64[np.ndarray, "held 2"], at: Float64[np.ndarray, " places"]
) -> Float64[np.ndarray, " places"]:
    """The mean distribution function of the transforms, each spread evenly from F(x-) to F(x).

    It is the diagonal if the predictions are calibrated, whether or not responses are tied.

    Source: the non-randomised transform of Czado, Gneiting and Held 2009, doi:10.1111/j.1541-0420.2009.01191.x.
    """
    low, high = transforms.T
    # Those with hardly any spread count as points: the difference below would not be exact.
    is_spread = high - low > 1e-6
    low, high, points = low[is_spread], high[is_spread], np.sort(low[~is_spread])
    density = 1 / (high - low)
    # A ramp from F(x-) to F(x) is the difference of two endless ramps that begin there.
    rising = _sum_of_ramps(low, density, at) - _sum_of_ramps(high, density, at)
    # 1e-12: a point at a place is not below it, but shares are rounded.
    return np.asarray((rising + np.searchsorted(points, at - 1e-12)) / len(transforms))


def _sum_of_ramps(
    since: Float64[np.ndarray, " n"], density: Float64[np.ndarray, " n"], at: Float64[np.ndarray, " places"]
) -> Float64[np.ndarray, " places"]:
    """The sum of density (at - since) over those that have begun."""
    order = np.argsort(since)
    sums = (np.concatenate([[0.0], np.cumsum(each[order])]) for each in (density, density * since))
    begun = np.searchsorted(since[order], at)
    slope, offset = (each[begun] for each in sums)
    return np.asarray(at * slope - offset)


def recorded_series(halves: Halves) -> Float64[np.ndarray, " presentations"]:
    """The held-out responses at their places among all trials, NaN elsewhere."""
    presented, place = halves.whole.presentations
    series = np.full(len(presented.rate_hz), np.nan)
    series[place[halves.rows]] = halves.x_hz
    return series


def free_runs(
    simulator: NeuronSimulator | None, prediction: Prediction, n: int, rng: np.random.Generator
) -> Float64[np.ndarray, "n presentations"]:
    """Draw n series of responses from a simulator in place of the held-out half.

    Conditions and times are the recorded ones. A simulator with memory remembers its own answers; for trials that it
    does not answer (bursts, trials without a condition or in the first half) the recorded history is used. Responses
    are at the places of the recorded ones; elsewhere is NaN.
    """
    halves = prediction.halves
    presented, place = halves.whole.presentations
    places = place[halves.rows]
    runs = np.full((n, len(presented.rate_hz)), np.nan)
    if not isinstance(simulator, MemorySimulator):
        at_most, uniform = prediction.at_most, rng.random((len(places), n))
        drawn = [np.searchsorted(row[:-1], u, side="right") for row, u in zip(at_most, uniform, strict=True)]
        runs[:, places] = halves.values_hz[np.stack(drawn, axis=1)]
        return runs
    ranked, since = Ranked(halves.first), int(places[0])
    traces, left = ranked.recorded(simulator.memory)
    trials = (
        np.maximum(presented.condition, 0),
        ranked.loads(simulator.memory.load_s).every.astype(np.float32),
        left.astype(np.float32),
        np.isin(np.arange(len(left)), places),
        presented.is_burst,
        presented.is_rested,
    )
    uniforms = rng.random((len(left) - since, n), np.float32)
    rate_hz = _runs_with_memory(simulator, np.float32(traces[since]), tuple(each[since:] for each in trials), uniforms)
    runs[:, places] = halves.read(np.asarray(rate_hz))[places - since].T
    return runs


@jax.jit
def _runs_with_memory(
    simulator: MemorySimulator, trace: Float[Array, ""], trials: tuple[Array, ...], uniforms: Float[Array, "trials n"]
) -> Float[Array, "trials n *readouts"]:
    """Answers of n runs to the trials, whose arrays are those of `free_runs`, from one trace on."""
    answer = jax.vmap(simulator.answer_at, (None, 0, 0, None))

    def trial(trace: Float[Array, " n"], inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        condition, load, left, is_answered, is_burst, is_rested, uniform = inputs
        trace = jnp.where(is_rested, simulator.silence, trace)
        rate_hz, after = answer(condition, uniform, trace, load)
        after = jnp.where(is_answered, after, jnp.asarray(simulator.decay) * trace + left)
        # As in `history.Ranked`: the trace after a burst is not known.
        return jnp.where(is_burst, 0.5, after), rate_hz

    return jax.lax.scan(trial, jnp.full(uniforms.shape[1], trace), (*trials, uniforms))[1]


def autocorrelation(series: Float64[np.ndarray, "*n trials"]) -> Float64[np.ndarray, "*n lags"]:
    """The correlation of responses with those 1 to `LAGS` trials before, over the existing pairs; NaN without any."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # Without pairs the mean is NaN.
        apart = series - np.nanmean(series, axis=-1, keepdims=True)
        of_lags = [np.nanmean(apart[..., :-lag] * apart[..., lag:], axis=-1) for lag in range(1, LAGS + 1)]
        return np.asarray(np.stack(of_lags, axis=-1) / np.nanvar(series, axis=-1)[..., None])


def run_lengths(series: Float64[np.ndarray, " trials"], threshold_hz: float) -> Int64[np.ndarray, " runs"]:
    """The lengths of runs of trials with responses at or above a threshold; a missing response ends a run."""
    passes = np.concatenate([[False], series >= threshold_hz, [False]])
    edges = np.flatnonzero(np.diff(passes.astype(np.int8))).reshape(-1, 2)
    return np.asarray(edges[:, 1] - edges[:, 0])


def shares_lasting(lengths: Int64[np.ndarray, " runs"]) -> Float64[np.ndarray, " lengths"]:
    """The shares of runs that last 1, 2, ..., `LAGS` trials or more; NaN without runs."""
    if not len(lengths):
        return np.full(LAGS, np.nan)
    return np.asarray(np.mean(lengths[:, None] >= np.arange(1, LAGS + 1), axis=0))


def in_time(series: Float64[np.ndarray, "n trials"], threshold_hz: float) -> tuple[Any, Any, Any]:
    """For each series its autocorrelation, the mean length of its runs, and `shares_lasting` of these."""
    lengths = [run_lengths(one, threshold_hz) for one in series]
    means = [runs.mean() if len(runs) else np.nan for runs in lengths]
    return autocorrelation(series), np.array(means), np.array([shares_lasting(runs) for runs in lengths])
