"""How faithfully a simulator reproduces the responses it was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from animat.neurons.memory import MemorySimulator
from animat.neurons.simulator import Histograms, Index, NeuronSimulator, Rates
from animat.recordings.findings import Finding
from animat.responses.responses import Responses

LARGEST_LOSS = 0.05
"""A difference in P(x >= P50) between data and simulator above which `findings` warns."""
_evenly_drawn = jax.jit(NeuronSimulator.evenly_drawn, static_argnums=1)
"""Compiled once for all simulators of a shape."""


@dataclass(frozen=True)
class Fidelity:
    """How often each condition passes the pooled median, in the data and in the simulator.

    Attributes:
        in_data: P(x >= P50) of each condition's non-burst responses, shape (conditions,) or (conditions, readouts).
        in_simulator: the same for the simulator, in the same shape.
        n_above_range: non-burst responses, of any readout, above a histogram's range, counted in its last bin.
    """

    labels: tuple[str, ...]
    in_data: Float[np.ndarray, "conditions *readouts"]
    in_simulator: Float[np.ndarray, "conditions *readouts"]
    n_above_range: int
    readouts: tuple[str, ...] = ("all",)

    @property
    def largest_loss(self) -> float:
        """The largest change of P(x >= P50) of any condition."""
        return float(np.abs(self.in_data - self.in_simulator).max())

    def findings(self, *, of_memory: bool = False) -> tuple[Finding, ...]:
        """Warnings if P(x >= P50) moves by more than `LARGEST_LOSS`, or responses lie above a histogram's range."""
        found = []
        loss = np.abs(self.in_data - self.in_simulator)
        worst = np.unravel_index(np.argmax(loss), loss.shape)
        if (value := float(loss[worst])) > LARGEST_LOSS:
            of = self.labels[worst[0]] + (f" on {self.readouts[worst[1]]}" if loss.ndim == 2 else "")
            changed = f"changes P(x >= P50) of {of} from {self.in_data[worst]:.2f} to {self.in_simulator[worst]:.2f}"
            if of_memory:
                remedy = "with so few responses some are drawn too often; record more"
                message = f"drawing from similar histories {changed}: {remedy}"
                found.append(Finding("few-neighbours", "warning", message, value))
            else:
                remedy = "use more bins, no range (edges are then percentiles) or the empirical simulator"
                found.append(Finding("binning", "warning", f"the histogram {changed}: {remedy}", value))
        if self.n_above_range:
            message = f"responses above the histogram's range, which are counted in its last bin: {self.n_above_range}"
            found.append(Finding("above-range", "warning", message, float(self.n_above_range)))
        return tuple(found)


def fidelity(responses: Responses, simulator: NeuronSimulator) -> Fidelity:
    """Compare a simulator with the responses it was fitted to, at the pooled median P50.

    The simulator's share is computed, not drawn: it is the share of 20,000 evenly spaced quantiles that pass P50; for a
    simulator with memory, the mean share over the neighbours of each history that it holds.
    """
    median_hz = np.asarray(simulator.percentiles, np.float32)[..., 5]
    kept, read_hz = ~responses.is_burst, responses.read_hz.astype(np.float32)
    conditions = range(len(responses.conditions))
    in_data = np.array([np.mean(read_hz[kept & (responses.condition == c)] >= median_hz, axis=0) for c in conditions])
    above = 0
    if isinstance(simulator, Histograms):
        above = int(np.count_nonzero(read_hz[kept] > np.asarray(simulator.edges_hz)[..., -1]))
    labels = tuple(condition.label for condition in responses.conditions)
    if isinstance(simulator, MemorySimulator):
        shares = _shares_above_median(simulator, median_hz)
    else:
        shares = np.mean(np.asarray(_evenly_drawn(simulator, 20_000)) >= median_hz, axis=1, dtype=np.float32)
    return Fidelity(labels, in_data, np.asarray(shares, np.float64), above, responses.readouts.names)


@jax.jit
def _shares_above_median(simulator: MemorySimulator, median_hz: Rates) -> Float[Array, "conditions *readouts"]:
    """The share of answers to every condition that reach the median, over the histories of its own responses."""
    rows = jnp.arange(simulator.before.shape[1])

    def of_condition(condition: Index) -> Rates:
        above = jnp.asarray(simulator.after_hz)[condition] >= median_hz
        before_each = jnp.concatenate([jnp.zeros((1, *above.shape[1:]), jnp.int32), jnp.cumsum(above, axis=0)])
        trace, load = jnp.asarray(simulator.histories)[condition].T
        near = jax.vmap(simulator.rows_near, (None, 0, 0))
        first, end = near(condition, trace, jnp.asarray(simulator.kept)[condition] * load)
        per_row = (-1, *[1] * (above.ndim - 1))
        shares = (before_each[end] - before_each[first]) / (end - first).reshape(per_row)
        return shares.mean(axis=0, where=(rows < simulator.followers[condition]).reshape(per_row))

    return jax.vmap(of_condition)(jnp.arange(simulator.n_conditions))
