"""How electrodes see the neurons of a virtual tissue: which ones, with what amplitude, and with what shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from animat.stimulation.array import ElectrodeArray, Electrodes
from animat.stimulation.scan import ScannedActivity

REACH_UM = 25.0
"""An electrode sees every neuron within this distance, and none beyond."""
HALF_UM = 15.0
"""Spikes are half as large at this distance from the soma."""
NOISE_UV = 2.4
"""Root mean square of the chip's noise in 100-3000 Hz (uncertain; see the reference page on the virtual culture)."""

Floats = Float64[np.ndarray, " neurons"]


class Pairs(NamedTuple):
    """Which electrode sees which neuron, sorted by electrode, then neuron; arrays of shape (pairs,)."""

    electrode: Int64[np.ndarray, " pairs"]
    neuron: Int64[np.ndarray, " pairs"]
    distance_um: Float64[np.ndarray, " pairs"]


class Visibility:
    """Spike shapes of neurons and how they fall off with distance d:

        amplitude(d) = amplitude(0) / (1 + (d / 15 um)^2)   up to 25 um.

    At the soma amplitudes are log-normal about 110 uV, between 60 and 300 uV, so that at 25 um the smallest is 16 uV,
    above five standard deviations of the noise: within its reach an electrode misses no spike. Trough-to-peak times
    are 0.45 +- 0.06 ms for excitatory and 0.25 +- 0.05 ms for inhibitory neurons, recovery times 0.45 +- 0.1 and
    0.25 +- 0.06 ms: they overlap, as in real cultures. Positions count from the tissue's corner, half a pitch from
    electrode 0.
    """

    def __init__(
        self, seed: int, array: ElectrodeArray, x_um: Floats, y_um: Floats, is_excitatory: Bool[np.ndarray, " neurons"]
    ) -> None:
        rng = np.random.default_rng([seed, 11])
        n = len(x_um)
        self.amplitude_uv = amplitudes_at_soma_uv(rng, n)
        trough, recovery = rng.standard_normal((2, n))
        trough_ms = np.where(is_excitatory, 0.45 + 0.06 * trough, 0.25 + 0.05 * trough)
        self.trough_to_peak_ms = np.clip(trough_ms, 0.12, 0.8)
        recovery_ms = np.where(is_excitatory, 0.45 + 0.1 * recovery, 0.25 + 0.06 * recovery)
        self.recovery_ms = np.clip(recovery_ms, 0.1, 0.9)
        self.pairs = _find_pairs(array, x_um, y_um)

    def pairs_of(self, electrodes: Electrodes) -> Pairs:
        """The pairs of some electrodes, in their order; `electrode` becomes the row in `electrodes`."""
        first = np.searchsorted(self.pairs.electrode, electrodes, side="left")
        counts = np.searchsorted(self.pairs.electrode, electrodes, side="right") - first
        row = np.repeat(np.arange(len(electrodes)), counts)
        pair = np.repeat(first, counts) + np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
        return Pairs(row, self.pairs.neuron[pair], self.pairs.distance_um[pair])

    def amplitude_at(self, pairs: Pairs) -> Float64[np.ndarray, " pairs"]:
        """Amplitude of a neuron's spike on an electrode, in uV."""
        return np.asarray(self.amplitude_uv[pairs.neuron] / (1 + (pairs.distance_um / HALF_UM) ** 2))

    def measure(
        self,
        electrodes: Electrodes,
        spikes_of: Int64[np.ndarray, " neurons"],
        duration_s: float,
        rng: np.random.Generator,
    ) -> ScannedActivity:
        """What electrodes measure of each neuron's spikes: means over spikes, blurred by the noise."""
        pairs, rows = self.pairs_of(electrodes), len(electrodes)
        weight = spikes_of[pairs.neuron].astype(np.float64)
        count = np.bincount(pairs.electrode, weight, rows)
        amplitude_uv = self.amplitude_at(pairs)

        def mean(of: Float64[np.ndarray, " pairs"]) -> Float64[np.ndarray, " electrodes"]:
            total = np.bincount(pairs.electrode, weight * of, rows)
            return np.asarray(np.divide(total, count, out=np.full(rows, np.nan), where=count > 0))

        blur = rng.standard_normal((3, rows)) / np.sqrt(np.maximum(count, 1))
        size_uv = mean(amplitude_uv)
        # The smaller a waveform, the less precise the times read from it.
        jitter_ms = 0.5 * NOISE_UV / size_uv
        return ScannedActivity(
            electrode=electrodes,
            rate_hz=count / duration_s,
            amplitude_uv=size_uv + NOISE_UV * blur[0],
            noise_uv=np.full(rows, NOISE_UV),
            trough_to_peak_ms=mean(self.trough_to_peak_ms[pairs.neuron]) + jitter_ms * blur[1],
            recovery_ms=mean(self.recovery_ms[pairs.neuron]) + jitter_ms * blur[2],
        )


def _find_pairs(array: ElectrodeArray, x_um: Floats, y_um: Floats) -> Pairs:
    pitch_um = array.pitch_um
    # Positions relative to electrode 0.
    x_um, y_um = x_um[:, None, None] - pitch_um / 2, y_um[:, None, None] - pitch_um / 2
    reach = int(np.ceil(REACH_UM / pitch_um))
    steps = np.arange(-reach, reach + 1)
    column = np.rint(x_um / pitch_um).astype(np.int64) + steps[:, None]
    row = np.rint(y_um / pitch_um).astype(np.int64) + steps
    distance_um = np.hypot(column * pitch_um - x_um, row * pitch_um - y_um)
    seen = (distance_um <= REACH_UM) & (column >= 0) & (column < array.columns) & (row >= 0) & (row < array.rows)
    electrode, neuron = (row * array.columns + column)[seen], np.nonzero(seen)[0]
    order = np.lexsort((neuron, electrode))
    return Pairs(electrode[order], neuron[order], distance_um[seen][order])


def amplitudes_at_soma_uv(rng: np.random.Generator, neurons: int) -> Floats:
    """Amplitude of each neuron's spikes at its soma: log-normal about 110 uV, between 60 and 300 uV."""
    return np.clip(110.0 * rng.lognormal(0.0, 0.4, neurons), 60.0, 300.0)
