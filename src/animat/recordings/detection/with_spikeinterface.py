"""Filter and find by SpikeInterface, artefacts removed by us before. Needs the extra `animat[raw]`; import it late."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float32, Int64
from spikeinterface.core import BaseRecording, BaseRecordingSegment
from spikeinterface.preprocessing import bandpass_filter
from spikeinterface.sortingcomponents.peak_detection import detect_peaks

from animat.progress import Progress
from animat.recordings.detection.band import MARGIN_S
from animat.recordings.detection.pieces import read_piece
from animat.recordings.detection.settings import Detection
from animat.recordings.raw import RawTraces


def detect(
    traces: RawTraces,
    stimulus: Int64[np.ndarray, " stimuli"],
    noise_uv: Float32[np.ndarray, " channels"],
    settings: Detection,
    workers: int,
    progress: Progress,
) -> tuple[Int64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"], np.ndarray]:
    """Samples and channels of the spikes, as `finding_spikes` wants them.

    Filter: `bandpass_filter`, order 3, forwards and backwards. Detection: `detect_peaks`, by channel, negative peaks.

    Args:
        traces: where the voltage is.
        stimulus: sample of each pulse.
        noise_uv: of each channel, as we measured it, so that both engines have one threshold.
        settings: how.
        workers: threads.
        progress: told at the end: SpikeInterface keeps its own progress.
    """
    from animat.recordings.detection.finding_spikes import depths_uv

    recording: Any = CleanedRecording(traces, stimulus, noise_uv, settings)
    if settings.band_hz is not None:
        low, high = settings.band_hz
        recording = bandpass_filter(
            recording, freq_min=low, freq_max=high, filter_order=3, margin_ms=1e3 * MARGIN_S, dtype="float32"
        )
    depth_uv = depths_uv(noise_uv, 1.0)
    depth_uv[~np.isfinite(depth_uv)] = 1e9
    peaks = detect_peaks(
        recording,
        method="by_channel",
        method_kwargs={
            "peak_sign": "neg",
            "detect_threshold": settings.threshold,
            "exclude_sweep_ms": settings.dead_time_ms,
            "noise_levels": depth_uv,
        },
        job_kwargs={
            "n_jobs": workers,
            "pool_engine": "thread",
            "chunk_duration": f"{settings.chunk_s}s",
            "progress_bar": False,
        },
    )
    sample, channel = peaks["sample_index"].astype(np.int64), peaks["channel_index"].astype(np.int64)
    kept = ~_is_blank(sample, stimulus, traces.sampling_rate_hz, settings)
    progress.update(1, 1, f"{np.count_nonzero(kept):,} spikes")
    return sample[kept], channel[kept], recording_saturation(recording)


class CleanedRecording(BaseRecording):  # type: ignore[misc]
    """Raw traces without artefacts, as SpikeInterface reads them."""

    def __init__(
        self,
        traces: RawTraces,
        stimulus: Int64[np.ndarray, " stimuli"],
        noise_uv: Float32[np.ndarray, " channels"],
        settings: Detection,
    ) -> None:
        super().__init__(traces.sampling_rate_hz, np.arange(len(traces.channels)), "float32")
        self.add_recording_segment(_CleanedSegment(traces, stimulus, noise_uv, settings))
        self._serializability["memory"] = True
        xy_um = np.column_stack([traces.channels.x_um, traces.channels.y_um])
        # Detection by channel asks for places and does not use them.
        self.set_dummy_probe_from_locations(np.where(np.isfinite(xy_um), xy_um, np.arange(len(xy_um))[:, None] * 1e3))
        self.set_channel_gains(1.0)
        self.set_channel_offsets(0.0)


class _CleanedSegment(BaseRecordingSegment):  # type: ignore[misc]
    def __init__(self, traces: RawTraces, stimulus: Any, noise_uv: Any, settings: Detection) -> None:
        super().__init__(sampling_frequency=traces.sampling_rate_hz)
        self._traces, self._stimulus, self._noise_uv, self._settings = traces, stimulus, noise_uv, settings
        self.saturation: dict[int, tuple[int, float]] = {}

    def get_num_samples(self) -> int:
        """Samples of each channel."""
        return self._traces.samples

    def get_traces(self, start_frame: int, end_frame: int, channel_indices: Any = None) -> np.ndarray:
        """A stretch of traces, with enough beside it for an artefact that began before."""
        rate_hz = self._traces.sampling_rate_hz
        margin = round(MARGIN_S * rate_hz)
        piece = read_piece(self._traces, self._stimulus, start_frame, end_frame, margin)
        cleaned = piece.cleaned(slice(None), self._noise_uv, rate_hz, self._settings)
        for at, n, ms in zip(piece.stimulus[piece.owned] - margin + start_frame, cleaned.saturated[piece.owned],
                             cleaned.longest_ms[piece.owned], strict=True):  # fmt: skip
            self.saturation[int(at)] = (int(n), float(ms))
        inner = cleaned.voltage_uv[:, margin : margin + end_frame - start_frame].T
        return np.asarray(inner if channel_indices is None else inner[:, channel_indices])


def recording_saturation(recording: Any) -> np.ndarray:
    """Of each stimulus how many channels saturate, and how long in ms: kept where the traces were cleaned."""
    while not isinstance(recording, CleanedRecording):
        recording = recording.get_parent()
    seen = recording._recording_segments[0].saturation
    return np.array([seen[at] for at in sorted(seen)], dtype=np.float64).reshape(-1, 2)


def _is_blank(sample: Any, stimulus: Any, rate_hz: float, settings: Detection) -> np.ndarray:
    if not len(stimulus):
        return np.zeros(len(sample), dtype=bool)
    before, after = (round(ms * 1e-3 * rate_hz) for ms in settings.blank_ms)
    following = np.searchsorted(stimulus, sample, side="right")
    since = sample - stimulus[np.maximum(following - 1, 0)]
    until = stimulus[np.minimum(following, len(stimulus) - 1)] - sample
    return np.asarray(((since >= 0) & (since < after)) | ((until > 0) & (until <= before)))
