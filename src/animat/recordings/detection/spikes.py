"""Detects spikes in raw traces as negative peaks, piece by piece on all cores, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy import fft, signal

from animat.errors import InvalidArgument, UnusableData
from animat.process import own_cores
from animat.progress import Progress, Silent
from animat.recordings.detection.artefacts import Counts, Flags, Levels, Pulses, Traces
from animat.recordings.detection.pieces import Piece, read_piece
from animat.recordings.detection.settings import Detection
from animat.recordings.findings import Finding, Severity
from animat.recordings.raw import RawTraces

ORDER = 3
MARGIN_S = 0.05
"""Margin that a piece needs on both sides: the filter's transform is circular, and the resulting transient at its ends
decays by e in 3 ms at 100 Hz."""
BLOCK = 64
"""Channels filtered at a time: few enough to fit into the processor's cache."""
NOISE_PIECES, NOISE_PIECE_S = 15, 0.2
NOISE_SAMPLES = 2500
"""Approximate number of samples used per channel."""
NORMAL = 0.6745
"""Ratio of the median of |x| to the standard deviation of x for a normal distribution."""
LEAST_SHARE = 0.1
"""Share of a channel's samples from which its noise can be estimated."""
LEVEL_STEP = 20
"""Every so many samples are enough for the median of the voltage."""
DEAD, NOISY = 0.1, 5.0
"""Multiples of the median channel's noise: a channel below is dead, one above is noisy."""
MUCH_LOST = 0.01
USUAL_UV = 0.2, 500.0
"""Noise between these is that of an amplifier in the right unit, with a wide margin."""
ENOUGH_BEYOND, TIMES_ABOVE = 1000.0, 2.0
"""Traces are inverted if the cubes of the samples above the noise, in multiples of the threshold, sum up to so much, or
more, and to so many times as much as those below it."""


@dataclass(frozen=True, eq=False)
class DetectedSpikes:
    """Spikes in order of time (that of their negative peaks) by row of the channel table, and each channel's noise."""

    time_s: Float64[np.ndarray, " spikes"]
    channel: Int64[np.ndarray, " spikes"]
    noise_uv: Levels
    findings: tuple[Finding, ...]


def detect_spikes(
    traces: RawTraces,
    stimulus_time_s: Float64[np.ndarray, " stimuli"] | None = None,
    settings: Detection | None = None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> DetectedSpikes:
    """Detect spikes in raw traces.

    A spike is a negative peak of the band-passed trace deeper than `threshold` standard deviations of its channel's
    noise, the deepest within the dead time on both sides (`find_negative_peaks`), outside the blanks around stimuli
    (`artefacts`).

    Args:
        stimulus_time_s: starts of the pulses on the recording's clock.
        workers: threads; by default one per core. Each takes some 200 MB of memory for 1,024 channels.
        progress: updated after each piece.

    Raises:
        InvalidArgument: for a band that does not lie below half the sampling rate.
        InvalidFile: if samples cannot be read.
        UnusableData: for traces without samples.
    """
    settings, progress, rate_hz = settings or Detection(), progress or Silent(), traces.sampling_rate_hz
    if not traces.samples:
        raise UnusableData("traces: expected samples, got none")
    if settings.band_hz is not None and settings.band_hz[1] >= rate_hz / 2:
        expected = f"less than half the sampling rate of {rate_hz:g} Hz"
        got = f"{settings.band_hz[1]:g} Hz: choose a lower upper end, such as {0.4 * rate_hz:g}"
        raise InvalidArgument(f"band_hz: expected {expected}, got {got}")
    times_s = np.asarray([] if stimulus_time_s is None else stimulus_time_s, np.float64)
    # Simultaneous pulses are one.
    stimulus = np.unique(np.rint((times_s - traces.start_s) * rate_hz)).astype(np.int64)
    workers = workers or len(own_cores())
    noise_uv, level_uv, below, above = _noise_and_level_uv(traces, stimulus, settings, workers)
    length = max(round(settings.chunk_s * rate_hz), 1)

    def search(start: int) -> _PieceResult:
        piece = read_piece(traces, stimulus, start, min(start + length, traces.samples), round(MARGIN_S * rate_hz))
        return _search(piece, noise_uv, level_uv, rate_hz, settings)

    samples, channels = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    saturations, lost = np.zeros((len(stimulus), 2)), np.zeros(len(noise_uv), np.int64)
    starts = range(0, traces.samples, length)
    with ThreadPoolExecutor(workers) as pool:
        # If one fails, or on Ctrl-C, the pieces that wait are given up.
        for done, found in enumerate(pool.map(search, starts), start=1):
            samples.append(found.sample)
            channels.append(found.channel)
            its = saturations[found.first_stimulus : found.first_stimulus + len(found.saturation)]
            its[:, 0] += found.saturation[:, 0]
            its[:, 1] = np.maximum(its[:, 1], found.saturation[:, 1])
            lost += found.lost
            progress.update(done, len(starts), f"{sum(map(len, samples)):,} spikes")
    sample, channel = np.concatenate(samples), np.concatenate(channels)
    order = np.lexsort((channel, sample))
    findings = *_lost(lost, traces.samples), *_findings(noise_uv, len(stimulus), saturations, settings)
    findings += tuple(_inverted_finding(float(below.sum()), float(above.sum())))
    return DetectedSpikes(traces.start_s + sample[order] / rate_hz, channel[order], noise_uv, findings)


def is_dead(noise_uv: Levels) -> np.ndarray:
    """Whether a channel has hardly any noise, so that no signal reaches it; shape (channels,).

    The usual noise is the upper quartile, as more than half of the channels may be dead.
    """
    return np.asarray(noise_uv <= DEAD * np.quantile(noise_uv, 0.75)) if len(noise_uv) else np.zeros(0, dtype=bool)


def blocks(channels: int) -> Iterator[slice]:
    """The columns in blocks."""
    return (slice(first, first + BLOCK) for first in range(0, channels, BLOCK))


def _noise_and_level_uv(
    traces: RawTraces, stimulus: Pulses, settings: Detection, workers: int
) -> Float32[np.ndarray, "4 channels"]:
    """The noise of each channel and its usual voltage: medians over pieces spread over the recording.

    And the sum of the cubes of their samples beyond the threshold, below the noise and above.
    """
    rate_hz, channels = traces.sampling_rate_hz, len(traces.channels)
    length, margin = round(NOISE_PIECE_S * rate_hz), round(MARGIN_S * rate_hz)
    n = max(1, min(NOISE_PIECES, traces.samples // max(length, 1)))
    starts = np.linspace(0, max(traces.samples - length, 0), n).astype(np.int64)

    def of_piece(start: int) -> np.ndarray:
        found = np.zeros((4, channels), np.float32)
        piece = read_piece(traces, stimulus, start, min(start + length, traces.samples), margin)
        for columns in blocks(channels):
            rows = np.ascontiguousarray(piece.voltage_uv[piece.lead :, columns].T)
            level_uv = np.median(rows[:, ::LEVEL_STEP], axis=1)
            filtered = band_pass(rows, settings.band_hz, rate_hz)
            first = median_noise_uv(filtered[:, margin:-margin])
            if len(piece.stimulus) or piece.is_lost is not None:
                cleaned = piece.cleaned(columns, first, level_uv, rate_hz, settings)
                filtered = band_pass(cleaned.voltage_uv, settings.band_hz, rate_hz)
                first = median_noise_uv(filtered[:, margin:-margin], cleaned.is_blank[:, margin:-margin])
                filtered[cleaned.is_blank] = 0.0
            # In multiples of the threshold; a channel without noise has none.
            beyond = filtered[:, margin:-margin] / np.where(first > 0, settings.threshold * first, np.inf)[:, None]
            beyond = np.where(np.abs(beyond) > 1, beyond, 0) ** 3
            found[:, columns] = first, level_uv, -beyond.clip(max=0).sum(axis=1), beyond.clip(min=0).sum(axis=1)
        return found

    with ThreadPoolExecutor(workers) as pool:
        pieces = np.array(list(pool.map(of_piece, starts.tolist())))
    # A channel that is blanked in all pieces is dead.
    pieces[:, np.isnan(pieces).all(axis=0)] = 0.0
    medians_uv = np.nanmedian(pieces[:, :2], axis=0)
    return np.asarray(np.concatenate([medians_uv, pieces[:, 2:].sum(axis=0)]), dtype=np.float32)


class _PieceResult(NamedTuple):
    """The spikes of a piece; how many channels each of its stimuli saturates, and for how many ms; lost samples."""

    sample: Int64[np.ndarray, " spikes"]
    channel: Int64[np.ndarray, " spikes"]
    first_stimulus: int
    saturation: Float64[np.ndarray, "stimuli 2"]
    lost: Counts


def _search(piece: Piece, noise_uv: Levels, level_uv: Levels, rate_hz: float, settings: Detection) -> _PieceResult:
    depth_uv = np.where(is_dead(noise_uv), np.inf, settings.threshold * noise_uv).astype(np.float32)
    apart = max(round(settings.dead_time_ms * 1e-3 * rate_hz), 1)
    first, last = piece.margin, piece.margin + piece.stop - piece.start
    is_owned = (piece.stimulus >= piece.lead + first) & (piece.stimulus < piece.lead + last)
    lost = np.zeros(len(noise_uv), np.int64)
    if piece.is_lost is not None:
        lost = np.count_nonzero(piece.is_lost[piece.lead + first : piece.lead + last], axis=0)
    samples, channels, saturation = [], [], np.zeros((len(piece.stimulus), 2))
    for columns in blocks(len(noise_uv)):
        cleaned = piece.cleaned(columns, noise_uv[columns], level_uv[columns], rate_hz, settings)
        filtered = band_pass(cleaned.voltage_uv, settings.band_hz, rate_hz)
        if cleaned.is_blank.any():
            filtered[cleaned.is_blank] = 0.0
        row, sample = find_negative_peaks(filtered, depth_uv[columns], apart, first, last)
        samples.append(sample - first + piece.start)
        channels.append(row + columns.start)
        # Channels are counted only in the piece that a pulse starts in; the duration is seen in any of them.
        saturation[:, 0] += cleaned.saturated * is_owned
        saturation[:, 1] = np.maximum(saturation[:, 1], cleaned.longest_ms)
    return _PieceResult(np.concatenate(samples), np.concatenate(channels), piece.first_stimulus, saturation, lost)


def median_noise_uv(voltage_uv: Traces, is_blank: Flags | None = None) -> Levels:
    """Standard deviation of each channel's noise, in filtered traces: median(|v - median(v)|) / 0.6745.

    NaN for a channel of which nearly everything is blanked.
    """
    if is_blank is not None and is_blank.any():
        # Use the samples in which no channel is blanked; if these are too few, each channel's own.
        kept, samples = ~is_blank.any(axis=0), voltage_uv.shape[1]
        if np.count_nonzero(kept) < 0.5 * samples:
            rows = [row[~blank] for row, blank in zip(voltage_uv, is_blank, strict=True)]
            least = LEAST_SHARE * samples
            each = [median_noise_uv(row[None])[0] if len(row) >= least else np.nan for row in rows]
            return np.array(each, dtype=np.float32)
        voltage_uv = voltage_uv[:, kept]
    # Neighbouring samples of a filtered trace are correlated: a subset of them is as informative.
    voltage_uv = voltage_uv[:, :: max(voltage_uv.shape[1] // NOISE_SAMPLES, 1)]
    return np.asarray(_median(np.abs(voltage_uv - _median(voltage_uv)[:, None])) / NORMAL, dtype=np.float32)


def _median(values: Float32[np.ndarray, "rows values"]) -> Float32[np.ndarray, " rows"]:
    """The (upper) median of each row by one partition; numpy's does three and takes several times as long."""
    middle = values.shape[1] // 2
    return np.asarray(np.partition(values, middle, axis=1)[:, middle], dtype=np.float32)


def find_negative_peaks(
    voltage_uv: Traces, depth_uv: Levels, apart: int, first: int, last: int
) -> tuple[Int64[np.ndarray, " peaks"], Int64[np.ndarray, " peaks"]]:
    """Rows and samples of the negative peaks from sample `first` on until `last`.

    A sample t is a peak if v(t) < -depth and v(t) <= v(s) for all s within `apart` samples, at least 1; of equal ones,
    the first. A channel of infinite depth has none.
    """
    inner = voltage_uv[:, first:last]
    # Only samples beyond the threshold, which are few, are compared with their neighbours.
    row, column = np.nonzero(inner < -depth_uv[:, None])
    column = column + first
    before, after = np.maximum(column - 1, 0), np.minimum(column + 1, voltage_uv.shape[1] - 1)
    peak_uv = voltage_uv[row, column]
    low = (peak_uv <= voltage_uv[row, before]) & (peak_uv <= voltage_uv[row, after])
    row, column, peak_uv = row[low], column[low], peak_uv[low]
    padded = np.pad(voltage_uv, ((0, 0), (apart, apart)), constant_values=np.inf)
    around = padded[row[:, None], column[:, None] + np.arange(2 * apart + 1)[None, :]]
    is_least = np.all(peak_uv[:, None] < around[:, :apart], axis=1)
    is_least &= np.all(peak_uv[:, None] <= around[:, apart + 1 :], axis=1)
    return row[is_least], column[is_least]


def band_pass(voltage_uv: Traces, band_hz: tuple[float, float] | None, rate_hz: float) -> Traces:
    """Filter each row, zero-phase, by Fourier transform; `MARGIN_S` at both ends is not usable.

    The gain at frequency f is |H(f)|^2, H being a Butterworth band-pass of order 3 whose |H|^2 is a half at the ends of
    the band: the result of filtering forwards and backwards, without the two passes. Without a band, for traces that
    are filtered already, only the median is subtracted.
    """
    if band_hz is None:
        return np.asarray(voltage_uv - np.median(voltage_uv, axis=1, keepdims=True), dtype=np.float32)
    samples = voltage_uv.shape[1]
    length = fft.next_fast_len(samples, real=True)
    spectrum = fft.rfft(voltage_uv, length, axis=1)
    spectrum *= _gain(length, band_hz, rate_hz)
    return np.asarray(fft.irfft(spectrum, length, axis=1)[:, :samples], dtype=np.float32)


@lru_cache(maxsize=8)
def _gain(length: int, band_hz: tuple[float, float], rate_hz: float) -> Float32[np.ndarray, " frequencies"]:
    sections = signal.butter(ORDER, band_hz, "bandpass", fs=rate_hz, output="sos")
    _, gain = signal.sosfreqz(sections, worN=fft.rfftfreq(length, 1 / rate_hz), fs=rate_hz)
    return np.asarray(np.abs(gain) ** 2, dtype=np.float32)


def _lost(lost: Counts, samples: int) -> Iterator[Finding]:
    if n := int(lost.sum()):
        n_channels = np.count_nonzero(lost)
        share = n / (samples * n_channels)
        of_theirs = f"{n_channels:,} of {len(lost):,} channels ({100 * share:.2g} % of theirs)"
        message = f"{n:,} samples on {of_theirs} are not finite: no spikes are looked for there"
        yield Finding("samples-lost", "note" if share < MUCH_LOST else "warning", message, float(n))


def _inverted_finding(below: float, above: float) -> Iterator[Finding]:
    """A finding on traces whose spikes point upwards, by the sums of the cubes of the samples beyond the threshold."""
    if above > ENOUGH_BEYOND and above > TIMES_ABOVE * below:
        message = (
            "peaks above the noise are higher than those below it are deep, but the deep phase of a spike outside a "
            "cell is negative: multiply the traces by -1 if they are inverted, or, for artefacts, state the stimuli"
        )
        yield Finding("inverted", "warning", message, above / max(below, 1))


def _findings(noise_uv: Levels, n_stimuli: int, saturation: np.ndarray, settings: Detection) -> Iterator[Finding]:
    n, living_uv = len(noise_uv), noise_uv[~is_dead(noise_uv)]
    middle = float(np.median(living_uv)) if len(living_uv) else 0.0
    level: Severity = "note" if not len(living_uv) or USUAL_UV[0] < middle < USUAL_UV[1] else "warning"
    asked = "" if level == "note" else ": are the traces in volts? State their unit, or conversion factor"
    message = (
        f"noise: {middle:.2f} uV on the median of {len(living_uv):,} channels; spikes are negative peaks of "
        f"{settings.threshold:g} times their channel's noise and more{asked}"
    )
    yield Finding("noise", level, message, middle)
    if dead := n - len(living_uv):
        what = "no spike can be detected there, and they count in rates per channel; leave them out of the routing"
        message = f"dead channels (less than {DEAD:g} of the usual noise): {dead:,} of {n:,}; {what}"
        yield Finding("dead-channels", "note" if dead < 0.1 * n else "warning", message, float(dead))
    if middle > 0 and (noisy := int(np.count_nonzero(noise_uv > NOISY * middle))):
        what = "only large spikes are detected there; look for loose contacts or air bubbles"
        message = f"noisy channels (more than {NOISY:g} times the median noise): {noisy:,} of {n:,}; {what}"
        yield Finding("noisy-channels", "note" if noisy < 0.1 * n else "warning", message, float(noisy))
    if n_stimuli:
        before, after = settings.blank_ms
        message = (
            f"no spikes are looked for from {before:g} ms before to {after:g} ms after each of {n_stimuli:,} stimuli"
            + ("" if after <= 2.0 else "; the response window usually begins at 2 ms, so part of it is lost")
        )
        yield Finding("blanked", "note" if after <= 2.0 else "warning", message, after)
    if len(saturation) and saturation[:, 0].any():
        mean, longest = float(saturation[:, 0].mean()), float(np.median(saturation[saturation[:, 0] > 0, 1]))
        share = mean / max(n, 1)
        of = f"median of {np.count_nonzero(saturation[:, 0]):,} stimuli; at most {saturation[:, 1].max():.1f} ms"
        message = f"after a stimulus {mean:.1f} of {n:,} channels are saturated on average, the longest until "
        message += f"{longest:.1f} ms ({of}); they are blanked until then"
        is_much = share >= 0.05 and longest > 2
        message += ": rates in an earlier window are too low; use a window that begins later" if is_much else ""
        yield Finding("saturated-channels", "warning" if is_much else "note", message, share)
