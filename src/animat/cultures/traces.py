"""Raw traces of a short stretch of a virtual culture, whose true spikes are known, for tests of spike detection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from animat.cultures.observed import Spikes
from animat.cultures.virtual import VirtualCulture
from animat.cultures.visibility import NOISE_UV
from animat.errors import InvalidArgument
from animat.stimulation.stimulus import Stimulus

BAND_HZ = (100.0, 3000.0)
SHAPE_MS = (1.0, 2.5)
"""Length of a spike's waveform before and after its trough."""
SATURATION_UV = 3200.0
"""The amplifier's range, at which stimulus artefacts are cut."""
ARTEFACT_UV = 200_000.0
ARTEFACT_REACH_UM = 40.0
ARTEFACT_MS = 1.0
"""The artefact at distance d from a site, t after its pulse, is 200 mV / (1 + (d / 40 um)^3) exp(-t / 1 ms), cut at the
range: at the site it saturates for 4 ms, at 500 um it has fallen to 14 uV after 2 ms (assumed, based on reports)."""
LARGEST_SAMPLES = 2**28

Voltage = Float32[np.ndarray, "samples channels"]


@dataclass(frozen=True, eq=False)
class Traces:
    """Voltage of some channels, and the spikes in it.

    Attributes:
        voltage_uv: shape (samples, channels).
        channels: row of the culture's channel table for each column.
        spikes: times of the true spikes' troughs from the first sample; `channel` is a column of `voltage_uv`.
        amplitude_uv: amplitude of each spike on its channel, shape (spikes,).
    """

    voltage_uv: Voltage
    channels: Int64[np.ndarray, " channels"]
    sampling_rate_hz: float
    spikes: Spikes
    amplitude_uv: Float64[np.ndarray, " spikes"]
    stimulus_time_s: Float64[np.ndarray, " stimuli"]


def record_traces(
    culture: VirtualCulture,
    duration_s: float,
    *,
    channels: Sequence[int] | None = None,
    stimuli: Sequence[Stimulus] = (),
    noise_uv: float = NOISE_UV,
    seed: int = 0,
) -> Traces:
    """Advance an open virtual culture and synthesise the raw signal of its electrodes.

    Every neuron within reach of an electrode adds its waveform, scaled by distance (`Visibility`), to Gaussian noise in
    100-3000 Hz and the artefact of each pulse. Spikes closer together than their waveforms overlap.

    Args:
        culture: open; its clock advances.
        channels: rows of its channel table; None: all.
        stimuli: to deliver meanwhile.
        noise_uv, seed: root mean square and seed of the noise.

    Raises:
        InvalidArgument: for a channel that does not exist, or more than a gigabyte of samples.
        UnsafeStimulus: as `Culture.deliver` does.
    """
    rows = np.arange(len(culture.channels)) if channels is None else np.asarray(channels, dtype=np.int64)
    if rows.ndim != 1 or len(np.unique(rows)) != len(rows) or np.any((rows < 0) | (rows >= len(culture.channels))):
        raise InvalidArgument(f"channels: expected different rows from 0 to {len(culture.channels) - 1}, got {rows}")
    rate_hz = culture.sampling_rate_hz
    samples = round(duration_s * rate_hz) if 0 < duration_s < 1e6 else 0
    if not 0 < samples * len(rows) <= LARGEST_SAMPLES:
        given = f"{duration_s:g} s of {len(rows)} channels: take a shorter stretch or fewer channels"
        raise InvalidArgument(f"duration_s, channels: expected up to {LARGEST_SAMPLES:,} samples, got {given}")
    stimulus_time_s = culture.deliver(stimuli, duration_s).stimulus_time_s
    fired_s, fired = culture.fired
    rng = np.random.default_rng([seed, 14])
    voltage_uv = _band_limited_noise(rng, samples, len(rows), rate_hz, noise_uv)
    recorded = culture.selection.recording[rows]
    visibility = culture.visibility
    pairs = visibility.pairs_of(recorded)
    amplitude_uv = visibility.amplitude_at(pairs)
    spikes = [np.empty((0, 3))]
    for neuron in np.unique(pairs.neuron):
        seen = pairs.neuron == neuron
        at = np.rint(fired_s[fired == neuron] * rate_hz).astype(np.int64)
        at = at[at < samples]
        shape, trough = waveform(visibility.trough_to_peak_ms[neuron], visibility.recovery_ms[neuron], rate_hz)
        sample = ((at - trough)[:, None] + np.arange(len(shape))).ravel()
        inside = (sample >= 0) & (sample < samples)
        sample, shapes = sample[inside], np.tile(shape, len(at))[inside]
        for column, size_uv in zip(pairs.electrode[seen].tolist(), amplitude_uv[seen].tolist(), strict=True):
            np.add.at(voltage_uv[:, column], sample, (size_uv * shapes).astype(np.float32))
            spikes.append(np.column_stack(np.broadcast_arrays(at / rate_hz, column, size_uv)))
    for stimulus, at_s in zip(stimuli, stimulus_time_s.tolist(), strict=True):
        distance_um = culture.selection.array.distance_um(np.array(stimulus.electrodes), recorded)
        size_uv = np.sum(ARTEFACT_UV / (1 + (distance_um / ARTEFACT_REACH_UM) ** 3), axis=0)
        stretch = voltage_uv[round(at_s * rate_hz) :][: round(0.02 * rate_hz)]
        decay = np.exp(-np.arange(len(stretch)) / rate_hz * 1e3 / ARTEFACT_MS)
        stretch -= (decay[:, None] * size_uv).astype(np.float32)
    np.clip(voltage_uv, -SATURATION_UV, SATURATION_UV, out=voltage_uv)
    time_s, column_of, spike_uv = np.concatenate(spikes).T
    order = np.lexsort((column_of, time_s))
    true = Spikes(time_s[order], column_of[order].astype(np.int64))
    return Traces(voltage_uv, rows, rate_hz, true, spike_uv[order], stimulus_time_s)


def waveform(
    trough_to_peak_ms: float, recovery_ms: float, rate_hz: float
) -> tuple[Float64[np.ndarray, " samples"], int]:
    """A spike of unit amplitude, a trough followed by a smaller, slower peak; and the sample of the trough.

        v(t) = -exp(-(t / w)^2 / 2) + 0.3 exp(-((t - p) / r)^2 / 2),   w = 0.09 ms, p trough to peak, r recovery / 1.18

    scaled so that its lowest point is -1.
    """
    before, after = round(SHAPE_MS[0] * 1e-3 * rate_hz), round(SHAPE_MS[1] * 1e-3 * rate_hz)
    t_ms = np.arange(-before, after + 1) / rate_hz * 1e3
    # The peak begins at the trough: before it, it is faded in smoothly.
    peak = 0.3 * np.exp(-(((t_ms - trough_to_peak_ms) * 1.18 / recovery_ms) ** 2) / 2)
    peak *= 1 / (1 + np.exp(-np.clip((t_ms - trough_to_peak_ms / 2) / 0.05, -50, 50)))
    shape = -np.exp(-((t_ms / 0.09) ** 2) / 2) + peak
    return shape / -shape[before], before


def _band_limited_noise(
    rng: np.random.Generator, samples: int, channels: int, rate_hz: float, noise_uv: float
) -> Voltage:
    """White noise, band-limited in the frequency domain, channel by channel to save memory."""
    voltage_uv = np.empty((samples, channels), np.float32)
    frequency_hz = np.fft.rfftfreq(samples, 1 / rate_hz)
    inside = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    # The share of the power that passes, so that the result has the requested power.
    passed = max(np.count_nonzero(inside) * 2 / samples, 1 / samples)
    for column in range(channels):
        spectrum = np.fft.rfft(rng.standard_normal(samples)) * inside
        voltage_uv[:, column] = noise_uv / np.sqrt(passed) * np.fft.irfft(spectrum, samples)
    return voltage_uv
