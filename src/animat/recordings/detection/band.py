"""The band-pass filter: zero-phase, by Fourier transform."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float32
from scipy import fft, signal

from animat.errors import InvalidArgument

ORDER = 3
MARGIN_S = 0.05
"""Margin that a piece needs on both sides: the transform is circular, and the resulting transient at its ends decays by
e in 3 ms at 100 Hz."""


def check_band(band_hz: tuple[float, float], rate_hz: float) -> None:
    """Refuse a band beyond the Nyquist frequency.

    Raises:
        InvalidArgument: if its upper end is not below half the sampling rate.
    """
    if band_hz[1] >= rate_hz / 2:
        raise InvalidArgument(
            f"band_hz: expected less than half the sampling rate of {rate_hz:g} Hz, got {band_hz[1]:g} Hz: "
            f"choose a lower upper end, such as {0.4 * rate_hz:g}"
        )


def band_pass(
    voltage_uv: Float32[np.ndarray, "channels samples"], band_hz: tuple[float, float], rate_hz: float
) -> Float32[np.ndarray, "channels samples"]:
    """Filter each row; do not use `MARGIN_S` at both ends.

    The gain at frequency f is |H(f)|^2, H being a Butterworth band-pass of order 3: the result of filtering forwards
    and backwards, without the two passes.

    Args:
        voltage_uv: one row per channel.
        band_hz: frequencies at which |H|^2 is a half.
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
