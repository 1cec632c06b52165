"""Histograms of several readouts that are drawn together: each keeps its distribution, and trials their correlation."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from animat.neurons.simulator import NeuronSimulator, Stored, fit_histogram, quantile_of, stacked, to_jax
from animat.responses.responses import Responses
from animat.tables import briefly

_BELOW_ONE = float(np.nextafter(np.float32(1.0), np.float32(0.0)))


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
        edges_hz: the bins' edges, shape (readouts, bins + 1).
        ranks: of the readouts in each trial, padded with 0, shape (conditions, most trials, readouts).
        counts: trials of each condition, shape (conditions,).
        percentiles: as in `NeuronSimulator`, shape (readouts, 11).

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

    def quantile(self, condition: Int[Array, ""], uniform: Float[Array, ""]) -> Float[Array, " readouts"]:
        """The responses of all readouts for the trial that a uniform in [0, 1) draws."""
        count = jnp.asarray(self.counts)[condition]
        # float32 rounds a uniform just under 1 times a count up to the count.
        trial = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        shares = (jnp.asarray(self.ranks)[condition, trial] + (uniform * count - trial)) / count
        cumulative, edges_hz = jnp.asarray(self.cumulative)[:, condition], jnp.asarray(self.edges_hz)
        return jax.vmap(quantile_of)(cumulative, edges_hz, jnp.clip(shares, 0.0, _BELOW_ONE))


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
    return JointHistogramSimulator(
        stacked([each.cumulative for each in alone]),
        stacked([each.edges_hz for each in alone]),
        to_jax(ranks),
        to_jax(counts, np.int32),
        stacked([each.percentiles for each in alone]),
    )
