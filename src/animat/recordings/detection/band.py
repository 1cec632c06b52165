"""The band-pass filter: zero-phase, by Fourier transform."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float32
from scipy import fft, signal

ORDER = 3
MARGIN_S = 0.05
"""Margin that a piece needs on both sides: the transform is circular, and the resulting transient at its ends decays by
e in 3 ms at 100 Hz."""


def band_pass(
    voltage_uv: Float32[np.ndarray, "channels samples"], band_hz: tuple[float, float], rate_hz: float
) -> Float32[np.ndarray, "channels samples"]:
    """Filter each row; do not use `MARGIN_S` at both ends.

    The gain at frequency f is |H(f)|^2, H being a Butterworth band-pass of order 3 whose |H|^2 is a half at the ends of
    the band: the result of filtering forwards and backwards, without the two passes.
    """
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
