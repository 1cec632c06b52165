"""Raw traces in pieces, each with a margin on both sides and without artefacts: what is filtered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from animat.recordings.detection.artefacts import Cleaned, without_artefacts
from animat.recordings.detection.settings import Detection
from animat.recordings.raw import RawTraces


@dataclass(frozen=True, eq=False)
class Piece:
    """Raw traces of samples `start` to `stop`, with `margin` samples more on both sides.

    Attributes:
        start, stop: samples of the recording.
        margin: more on both sides; beyond the recording's ends, its last samples are repeated.
        voltage_uv: shape (samples + 2 margin, channels).
        stimulus: samples of the pulses in it, counted from the first row of `voltage_uv`.
    """

    start: int
    stop: int
    margin: int
    voltage_uv: Float32[np.ndarray, "samples channels"]
    stimulus: Int64[np.ndarray, " stimuli"]

    @property
    def owned(self) -> np.ndarray:
        """Which of its stimuli lie between `start` and `stop`, and not in a margin."""
        at = self.stimulus - self.margin
        return np.asarray((at >= 0) & (at < self.stop - self.start))

    def cleaned(
        self, columns: slice, noise_uv: Float32[np.ndarray, " channels"], rate_hz: float, settings: Detection
    ) -> Cleaned:
        """Some of its channels without artefacts, one a row; `noise_uv` is of these."""
        rows = self.rows(columns)
        if len(self.stimulus):
            # What removes artefacts changes what it is given.
            rows = rows.copy()
        return without_artefacts(rows, self.stimulus, noise_uv, rate_hz, settings)

    def rows(self, columns: slice) -> Float32[np.ndarray, "channels samples"]:
        """Some of its channels as they were recorded, one a row; not to be changed."""
        return np.ascontiguousarray(self.voltage_uv[:, columns].T)


def read_piece(traces: RawTraces, stimulus: Int64[np.ndarray, " stimuli"], start: int, stop: int, margin: int) -> Piece:
    """Read a piece.

    Args:
        stimulus: sample of every pulse of the recording, rising.
        start, stop: samples of the recording.
        margin: samples more on both sides.
    """
    first, last = max(start - margin, 0), min(stop + margin, traces.samples)
    voltage_uv = traces.read_uv(first, last)
    missing = (first - (start - margin), stop + margin - last)
    if any(missing):
        voltage_uv = np.pad(voltage_uv, (missing, (0, 0)), mode="edge")
    inside = stimulus[np.searchsorted(stimulus, start - margin) : np.searchsorted(stimulus, stop + margin)]
    return Piece(start, stop, margin, voltage_uv, inside - (start - margin))


def stimulus_samples(
    traces: RawTraces, stimulus_time_s: Float64[np.ndarray, " stimuli"]
) -> Int64[np.ndarray, " stimuli"]:
    """The sample that each pulse starts at, rising; pulses at one time are one."""
    at = np.rint((np.asarray(stimulus_time_s, np.float64) - traces.start_s) * traces.sampling_rate_hz)
    return np.unique(at).astype(np.int64)
