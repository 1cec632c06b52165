"""Raw traces in pieces, each with a margin on both sides and without artefacts: what is filtered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from animat.recordings.detection.artefacts import Cleaned, without_artefacts
from animat.recordings.detection.settings import Detection
from animat.recordings.raw import RawTraces

FOLLOWED_S, CLOSE_S, REST_S = 1.0, 0.025, 0.005
"""How long before a piece a pulse may have saturated an amplifier that still is; how soon after another pulse the
trace is not yet at rest; and how much of the trace before a pulse shows where it rests."""

REST_PULSES = 5
"""An amplifier may be saturated before some of them."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Raw traces of samples `start` to `stop`, with `margin` samples more on both sides.

    Attributes:
        start, stop: samples of the recording.
        margin: more on both sides; beyond the recording's ends, its last samples are repeated.
        lead: samples before the first margin, from just before the last pulse; they are only cleaned, not searched.
        voltage_uv: finite, shape (lead + samples + 2 margin, channels).
        is_lost: where it was not, and is a straight line, of the same shape; None where it always was.
        stimulus: samples of the pulses in it, counted from the first row of `voltage_uv`.
        first_stimulus: which of all pulses the first of these is.
        rests_uv: where each channel was before a few pulses of the last second that are not in the piece, shape
            (pulses, channels); None if there are none.
    """

    start: int
    stop: int
    margin: int
    lead: int
    voltage_uv: Float32[np.ndarray, "samples channels"]
    is_lost: Bool[np.ndarray, "samples channels"] | None
    stimulus: Int64[np.ndarray, " stimuli"]
    first_stimulus: int
    rests_uv: Float32[np.ndarray, "pulses channels"] | None = None

    @property
    def owned(self) -> np.ndarray:
        """Which of its stimuli lie between `start` and `stop`, and not in a margin."""
        at = self.stimulus - self.lead - self.margin
        return np.asarray((at >= 0) & (at < self.stop - self.start))

    def cleaned(
        self,
        columns: slice,
        noise_uv: Float32[np.ndarray, " channels"],
        level_uv: Float32[np.ndarray, " channels"],
        rate_hz: float,
        settings: Detection,
    ) -> Cleaned:
        """Some of its channels without artefacts, one a row, and without the lead; lost samples are blank in it.

        Args:
            columns: the channels.
            noise_uv, level_uv: their noise, and where they usually are: an amplifier at rest is nearer to that than a
                saturated one.
        """
        rows = np.array(self.voltage_uv[:, columns].T, order="C")
        rest_uv = None
        if self.rests_uv is not None:
            rests_uv = self.rests_uv[:, columns]
            # Lost samples are nowhere.
            nearest = np.nan_to_num(np.abs(rests_uv - level_uv), nan=np.inf).argmin(axis=0)
            rest_uv = rests_uv[nearest, np.arange(len(nearest))]
        cleaned = without_artefacts(rows, self.stimulus, noise_uv, rate_hz, settings, rest_uv)
        is_blank = cleaned.is_blank
        if self.is_lost is not None:
            lost = self.is_lost[:, columns].T
            is_blank = lost if is_blank is None else is_blank | lost
        return replace(
            cleaned,
            voltage_uv=np.ascontiguousarray(cleaned.voltage_uv[:, self.lead :]),
            is_blank=None if is_blank is None else is_blank[:, self.lead :],
        )

    def rows(self, columns: slice) -> Float32[np.ndarray, "channels samples"]:
        """Some of its channels as they were recorded, one a row and without the lead; not to be changed."""
        return np.ascontiguousarray(self.voltage_uv[self.lead :, columns].T)

    @property
    def lost(self) -> Int64[np.ndarray, " channels"]:
        """How many samples of each channel between `start` and `stop` are no finite numbers."""
        first = self.lead + self.margin
        inside = slice(first, first + self.stop - self.start)
        n_channels = self.voltage_uv.shape[1]
        return (
            np.zeros(n_channels, np.int64) if self.is_lost is None else np.count_nonzero(self.is_lost[inside], axis=0)
        )


def read_piece(traces: RawTraces, stimulus: Int64[np.ndarray, " stimuli"], start: int, stop: int, margin: int) -> Piece:
    """Read a piece, with a lead where a pulse came in the second before.

    An amplifier may be saturated since an earlier pulse than the lead begins with. Where it was before shows that.

    Args:
        stimulus: sample of every pulse of the recording, rising.
        start, stop: samples of the recording.
        margin: samples more on both sides.
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


def _rests_uv(
    traces: RawTraces, stimulus: Int64[np.ndarray, " stimuli"], rest: int
) -> Float32[np.ndarray, "pulses channels"] | None:
    """Where each channel was before a few of these pulses, evenly chosen; None without any."""
    chosen = stimulus[np.linspace(0, len(stimulus) - 1, min(len(stimulus), REST_PULSES)).astype(int)]
    before = [traces.read_uv(at - rest, at - rest // 2) for at in chosen.tolist() if at >= rest]
    return np.array([np.median(voltage_uv, axis=0) for voltage_uv in before]) if before else None


def _finite(
    voltage_uv: Float32[np.ndarray, "samples channels"], is_lost: Bool[np.ndarray, "samples channels"]
) -> Float32[np.ndarray, "samples channels"]:
    """The voltage with a straight line over what is not finite; 0 on a channel that never is."""
    voltage_uv = voltage_uv.copy(order="K")
    at = np.arange(len(voltage_uv))
    for column in np.flatnonzero(is_lost.any(axis=0)).tolist():
        lost = is_lost[:, column]
        voltage_uv[lost, column] = 0.0 if lost.all() else np.interp(at[lost], at[~lost], voltage_uv[~lost, column])
    return voltage_uv


def stimulus_samples(
    traces: RawTraces, stimulus_time_s: Float64[np.ndarray, " stimuli"]
) -> Int64[np.ndarray, " stimuli"]:
    """The sample that each pulse starts at, rising; pulses at one time are one."""
    at = np.rint((np.asarray(stimulus_time_s, np.float64) - traces.start_s) * traces.sampling_rate_hz)
    return np.unique(at).astype(np.int64)
