"""What a scan of spontaneous activity measured at each electrode, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import UnusableData
from animat.tables import freeze


@dataclass(frozen=True, eq=False)
class ScannedActivity:
    """Spontaneous activity of scanned electrodes, one row per electrode. Arrays are read-only.

    Attributes:
        electrode: number on the array, each once, shape (electrodes,).
        rate_hz: spikes per second, shape (electrodes,).
        amplitude_uv: mean size of the spikes' negative peak, NaN without spikes, shape (electrodes,).
        noise_uv: root mean square of the noise, shape (electrodes,).
        trough_to_peak_ms: of the mean waveform, NaN without spikes, shape (electrodes,).
        recovery_ms: from its peak back to half of it, NaN without spikes, shape (electrodes,).
    """

    electrode: Int64[np.ndarray, " electrodes"]
    rate_hz: Float64[np.ndarray, " electrodes"]
    amplitude_uv: Float64[np.ndarray, " electrodes"]
    noise_uv: Float64[np.ndarray, " electrodes"]
    trough_to_peak_ms: Float64[np.ndarray, " electrodes"]
    recovery_ms: Float64[np.ndarray, " electrodes"]

    def __post_init__(self) -> None:
        measured = (field.name for field in fields(self) if field.name != "electrode")
        freeze(self, "the scan", electrode=np.int64, **dict.fromkeys(measured, np.float64))
        if len(np.unique(self.electrode)) != len(self.electrode):
            raise UnusableData("scan.electrode: expected each electrode once, got some twice or more")

    def __len__(self) -> int:
        return len(self.electrode)

    @property
    def signal_to_noise(self) -> Float64[np.ndarray, " electrodes"]:
        """Mean spike amplitude over noise; 0 without spikes."""
        ratio = np.zeros(len(self))
        np.divide(self.amplitude_uv, self.noise_uv, out=ratio, where=self.noise_uv > 0)
        return np.nan_to_num(ratio, nan=0.0)

    @property
    def excitatory_score(self) -> Float64[np.ndarray, " electrodes"]:
        """How closely the waveform resembles an excitatory neuron's, from 0 to 1; 0 without spikes.

            score = 1 / (1 + exp(-((trough_to_peak - 0.35 ms) / 0.05 ms + (recovery - 0.35 ms) / 0.1 ms) / 2))

        Excitatory neurons have a longer trough-to-peak time (0.4-0.5 ms is a common threshold) and recover more slowly.
        Whether waveforms tell types apart is contested, especially in culture, so this is a soft score and not a label.
        """
        longer = (self.trough_to_peak_ms - 0.35) / 0.05
        slower = (self.recovery_ms - 0.35) / 0.1
        return np.nan_to_num(1 / (1 + np.exp(-np.clip((longer + slower) / 2, -50, 50))), nan=0.0)

    @staticmethod
    def from_blocks(blocks: list[ScannedActivity]) -> ScannedActivity:
        """The blocks of a scan as one table."""
        columns = zip(*(vars(block).values() for block in blocks), strict=True)
        return ScannedActivity(*map(np.concatenate, columns))
