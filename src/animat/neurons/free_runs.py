"""Free runs of a simulator under a recorded sequence of conditions, and statistics of series of responses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int64

from animat.neurons.history import Ranked
from animat.neurons.memory import MemorySimulator
from animat.neurons.prediction import Halves, Prediction
from animat.neurons.simulator import NeuronSimulator

LAGS = 10
"""The largest lag of correlations, and the largest run length counted separately."""


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
    does not answer (bursts, trials without a condition or in the first half) the recorded history is used.

    Returns:
        Responses in Hz at the places of the recorded ones, NaN elsewhere.
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
    rate_hz = _remembering(simulator, np.float32(traces[since]), tuple(each[since:] for each in trials), uniforms)
    runs[:, places] = halves.read(np.asarray(rate_hz))[places - since].T
    return runs


@jax.jit
def _remembering(
    simulator: MemorySimulator, trace: Float[Array, ""], trials: tuple[Array, ...], uniforms: Float[Array, "trials n"]
) -> Float[Array, "trials n *readouts"]:
    """Answers of n runs to the trials, whose arrays are those of `free_runs`, from one trace on."""
    answer = jax.vmap(simulator.answer_at, (None, 0, 0, None))

    def trial(trace: Float[Array, " n"], inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        condition, load, left, is_answered, is_burst, is_rested, uniform = inputs
        trace = jnp.where(is_rested, 0.0, trace)
        rate_hz, after = answer(condition, uniform, trace, load)
        after = jnp.where(is_answered, after, jnp.asarray(simulator.decay) * trace + left)
        # As in `history.Ranked`: the trace after a burst is not known.
        return jnp.where(is_burst, 0.5, after), rate_hz

    return jax.lax.scan(trial, jnp.full(uniforms.shape[1], trace), (*trials, uniforms))[1]


def autocorrelation(series: Float64[np.ndarray, "*n trials"]) -> Float64[np.ndarray, "*n lags"]:
    """The correlation of responses with those 1 to `LAGS` trials before, over the existing pairs; NaN without any."""
    is_known = ~np.isnan(series)
    count = is_known.sum(axis=-1, keepdims=True)
    filled = np.where(is_known, series, 0.0)
    centred = np.where(is_known, filled - filled.sum(axis=-1, keepdims=True) / count, 0.0)
    variance = np.sum(centred**2, axis=-1) / count[..., 0]
    of_lags = []
    for lag in range(1, LAGS + 1):
        pairs = np.sum(is_known[..., :-lag] & is_known[..., lag:], axis=-1)
        products = np.sum(centred[..., :-lag] * centred[..., lag:], axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            of_lags.append(products / pairs / variance)
    return np.stack(of_lags, axis=-1)


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
