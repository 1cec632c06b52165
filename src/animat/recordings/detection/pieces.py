"""Raw traces in pieces with a margin on both sides, from which artefacts are removed before they are filtered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from animat.recordings.detection.artefacts import Cleaned, Levels, Pulses, without_artefacts
from animat.recordings.detection.settings import Detection
from animat.recordings.raw import RawTraces

FOLLOWED_S, CLOSE_S, REST_S = 1.0, 0.025, 0.005
"""How long before a piece a pulse may have saturated an amplifier that still is saturated; how long after a pulse a
trace is not yet at rest; and how much of the trace before a pulse shows its resting voltage."""

REST_PULSES = 5
"""Most pulses at which the resting voltage is looked up, as an amplifier may be saturated at some of them."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Raw traces of samples `start` to `stop` of a recording, with `margin` samples more on both sides.

    Beyond the ends of the recording its first or last sample is repeated. The `lead` before the first margin, from just
    before the last pulse, is only for the removal of artefacts. Samples that were not finite are interpolated
    (`is_lost`). Pulses count from the first row of `voltage_uv`; `rests_uv` are resting voltages at a few earlier ones.
    """

    start: int
    stop: int
    margin: int
    lead: int
    voltage_uv: Float32[np.ndarray, "samples channels"]
    is_lost: Bool[np.ndarray, "samples channels"] | None
    stimulus: Pulses
    first_stimulus: int
    rests_uv: Float32[np.ndarray, "pulses channels"] | None

    def cleaned(
        self, columns: slice, noise_uv: Levels, level_uv: Levels, rate_hz: float, settings: Detection
    ) -> Cleaned:
        """Some of the channels, one per row, without artefacts and without the lead; lost samples are blank.

        Their usual voltage `level_uv` is closer to that of an amplifier at rest than to that of a saturated one.
        """
        rows = np.array(self.voltage_uv[:, columns].T, order="C")
        rest_uv = None
        if self.rests_uv is not None:
            rests_uv = self.rests_uv[:, columns]
            # A pulse without finite samples before it (NaN) is never the nearest.
            nearest = np.nan_to_num(np.abs(rests_uv - level_uv), nan=np.inf).argmin(axis=0)
            rest_uv = rests_uv[nearest, np.arange(len(nearest))]
        cleaned = without_artefacts(rows, self.stimulus, noise_uv, rate_hz, settings, rest_uv)
        is_blank = cleaned.is_blank if self.is_lost is None else cleaned.is_blank | self.is_lost[:, columns].T
        voltage_uv = np.ascontiguousarray(cleaned.voltage_uv[:, self.lead :])
        return replace(cleaned, voltage_uv=voltage_uv, is_blank=is_blank[:, self.lead :])


def read_piece(traces: RawTraces, stimulus: Pulses, start: int, stop: int, margin: int) -> Piece:
    """Read a piece, with a lead if there was a pulse in the second before.

    An amplifier may be saturated since an even earlier pulse, so resting voltages are read before some of these.
    `stimulus` is the sample of every pulse of the recording, ascending.
    """
    begin = start - margin
    followed, close, rest = (round(seconds * traces.sampling_rate_hz) for seconds in (FOLLOWED_S, CLOSE_S, REST_S))
    first_stimulus, last_stimulus = np.searchsorted(stimulus, [begin, stop + margin]).tolist()
    earliest = int(np.searchsorted(stimulus, begin - followed, side="right"))
    rests_uv = None
    if earliest < first_stimulus:
        first_stimulus -= 1
        if earliest < first_stimulus and stimulus[first_stimulus] - stimulus[first_stimulus - 1] < close:
            first_stimulus -= 1
        rests_uv = _rests_uv(traces, stimulus[earliest:first_stimulus], rest)
    if first_stimulus < last_stimulus:
        begin = min(max(int(stimulus[first_stimulus]) - rest, 0), begin)
    first, last = max(begin, 0), min(stop + margin, traces.samples)
    voltage_uv = traces.read_uv(first, last)
    is_lost = None
    if not np.isfinite(voltage_uv).all():
        is_lost = ~np.isfinite(voltage_uv)
        voltage_uv = _finite(voltage_uv, is_lost)
    missing = (first - begin, stop + margin - last)
    if any(missing):
        voltage_uv = np.pad(voltage_uv, (missing, (0, 0)), mode="edge")
        is_lost = None if is_lost is None else np.pad(is_lost, (missing, (0, 0)))
    inside = stimulus[first_stimulus:last_stimulus] - begin
    return Piece(start, stop, margin, start - margin - begin, voltage_uv, is_lost, inside, first_stimulus, rests_uv)


def _rests_uv(traces: RawTraces, stimulus: Pulses, rest: int) -> Float32[np.ndarray, "pulses channels"] | None:
    """The voltage of each channel before a few of these pulses, evenly chosen; None if there are none."""
    chosen = stimulus[np.linspace(0, len(stimulus) - 1, min(len(stimulus), REST_PULSES)).astype(int)]
    before = [traces.read_uv(at - rest, at - rest // 2) for at in chosen.tolist() if at >= rest]
    return np.array([np.median(voltage_uv, axis=0) for voltage_uv in before]) if before else None


def _finite(
    voltage_uv: Float32[np.ndarray, "samples channels"], is_lost: Bool[np.ndarray, "samples channels"]
) -> Float32[np.ndarray, "samples channels"]:
    """The voltage with lost samples interpolated; 0 on a channel without finite samples."""
    voltage_uv = voltage_uv.copy(order="K")
    at = np.arange(len(voltage_uv))
    for column in np.flatnonzero(is_lost.any(axis=0)).tolist():
        lost = is_lost[:, column]
        voltage_uv[lost, column] = 0.0 if lost.all() else np.interp(at[lost], at[~lost], voltage_uv[~lost, column])
    return voltage_uv
