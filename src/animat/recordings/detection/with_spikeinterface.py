"""Filter and find by SpikeInterface. Needs the extra `animat[raw]`; import it late.

SpikeInterface is handed a few channels of a piece at a time, in memory and channel by channel. Handed the recording
itself, it filters all channels of a piece at once in double precision: 100 MB an array, got anew from the operating
system each time, and read across memory (twice the processor time for 1,024 channels, and the memory).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64
from spikeinterface.core import NumpyRecording
from spikeinterface.preprocessing import bandpass_filter
from spikeinterface.sortingcomponents.peak_detection import detect_peaks

from animat.recordings.detection.band import ORDER


def band_pass(
    voltage_uv: Float32[np.ndarray, "channels samples"], band_hz: tuple[float, float], rate_hz: float
) -> Float32[np.ndarray, "channels samples"]:
    """Filter each row by `bandpass_filter`, forwards and backwards; `MARGIN_S` at both ends is not to be used.

    Args:
        voltage_uv: one row a channel.
        band_hz: where the gain is a half.
        rate_hz: of the samples.
    """
    low_hz, high_hz = band_hz
    filtered = bandpass_filter(
        NumpyRecording([voltage_uv.T], rate_hz),
        freq_min=low_hz,
        freq_max=high_hz,
        filter_order=ORDER,
        dtype="float32",
        # Margins are ours; SpikeInterface's own is not used where all of a piece is asked for.
        margin_ms="auto",
        ignore_low_freq_error=True,
    )
    return np.ascontiguousarray(filtered.get_traces().T)


def find_troughs(
    voltage_uv: Float32[np.ndarray, "channels samples"],
    depth_uv: Float32[np.ndarray, " channels"],
    apart: int,
    first: int,
    last: int,
) -> tuple[Int64[np.ndarray, " troughs"], Int64[np.ndarray, " troughs"]]:
    """Rows and samples of the troughs by `detect_peaks`, by channel, negative peaks.

    Args:
        voltage_uv: filtered, one row a channel.
        depth_uv: that a trough must exceed on each channel; infinite where nothing is to be found.
        apart: half the width of the neighbourhood, in samples, at least 1.
        first, last: look for troughs at samples from `first` on, below `last`.
    """
    start = max(first - apart, 0)
    # At a thousand samples a second, a sample is a millisecond and `apart` is what it says.
    recording = NumpyRecording([voltage_uv[:, start : last + apart].T], 1000.0)
    # Detection by channel asks for places and does not use them.
    recording.set_dummy_probe_from_locations(np.column_stack([np.arange(len(voltage_uv)), np.zeros(len(voltage_uv))]))
    peaks = detect_peaks(
        recording,
        method="by_channel",
        method_kwargs={
            "peak_sign": "neg",
            "detect_threshold": 1.0,
            "exclude_sweep_ms": float(apart),
            "noise_levels": depth_uv,
        },
        job_kwargs={"n_jobs": 1, "chunk_size": recording.get_num_samples(), "progress_bar": False},
    )
    row, sample = peaks["channel_index"].astype(np.int64), peaks["sample_index"].astype(np.int64) + start
    kept = (sample >= first) & (sample < last)
    return row[kept], sample[kept]
