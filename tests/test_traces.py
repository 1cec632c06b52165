"""Raw traces: their spikes are found by a detector that knows nothing of them. Oracle: scipy's filters and peaks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from animat.cultures.traces import Traces, record_traces, waveform
from animat.errors import InvalidArgument
from animat.stimulation.pulse import PUBLISHED_PULSE
from animat.stimulation.stimulus import Stimulus
from cultures import small_culture


@pytest.fixture(scope="module")
def quiet() -> Traces:
    with small_culture(scan_s=20.0) as culture:
        return record_traces(culture, 8.0, channels=range(0, 100, 4))


def test_the_noise_has_the_size_and_the_band_asked_for() -> None:
    with small_culture() as culture:
        traces = record_traces(culture, 4.0, channels=[0, 1])
    for column in range(2):
        power_hz = signal.welch(traces.voltage_uv[:, column], 20_000, nperseg=4096)
        inside = (power_hz[0] > 150) & (power_hz[0] < 2900)
        assert power_hz[1][power_hz[0] > 3200].max() < 0.05 * np.median(power_hz[1][inside])
        # The median is robust against spikes.
        spread_uv = np.median(np.abs(traces.voltage_uv[:, column])) / 0.6745
        assert spread_uv == pytest.approx(2.4, rel=0.05)


def test_a_detector_finds_the_spikes_that_are_there(quiet: Traces) -> None:
    found = missed = false = 0
    for column in range(quiet.voltage_uv.shape[1]):
        trace_uv = quiet.voltage_uv[:, column].astype(np.float64)
        threshold_uv = 5 * np.median(np.abs(trace_uv)) / 0.6745
        at = signal.find_peaks(-trace_uv, height=threshold_uv, distance=20)[0] / 20_000
        true_s = quiet.spikes.time_s[quiet.spikes.channel == column]
        # Two neurons of one electrode may fire together; they are one spike to any detector.
        true_s = true_s[np.diff(true_s, prepend=-1) > 0.0015]
        near = np.abs(at[:, None] - true_s[None, :]) < 0.0005
        found += int(near.any(axis=0).sum())
        missed += int((~near.any(axis=0)).sum())
        false += int((~near.any(axis=1)).sum())
    assert found > 100
    assert missed <= 0.03 * found
    assert false <= 0.05 * found


def test_spikes_have_their_size_at_their_trough(quiet: Traces) -> None:
    sample = np.rint(quiet.spikes.time_s * 20_000).astype(int)
    measured_uv = -quiet.voltage_uv[sample, quiet.spikes.channel]
    alone = np.array([np.sum(np.abs(sample - s) < 60) == 1 for s in sample])
    assert np.count_nonzero(alone) > 20
    error_uv = (measured_uv - quiet.amplitude_uv)[alone]
    assert abs(error_uv.mean()) < 4 * 2.4 / np.sqrt(len(error_uv)) + 0.5
    assert error_uv.std() < 4.0


@pytest.mark.parametrize(("trough_to_peak_ms", "recovery_ms"), [(0.45, 0.45), (0.25, 0.25), (0.6, 0.5)])
def test_a_waveform_has_the_times_asked_for(trough_to_peak_ms: float, recovery_ms: float) -> None:
    shape, trough = waveform(trough_to_peak_ms, recovery_ms, 200_000.0)
    assert np.argmin(shape) == pytest.approx(trough, abs=3)
    assert shape[trough] == -1.0
    peak = trough + int(np.argmax(shape[trough:]))
    assert (peak - trough) / 200 == pytest.approx(trough_to_peak_ms, abs=0.05)
    half = peak + int(np.argmax(shape[peak:] < shape[peak] / 2))
    assert (half - peak) / 200 == pytest.approx(recovery_ms, abs=0.06)


def test_a_pulse_leaves_an_artefact_that_saturates_near_its_site() -> None:
    with small_culture() as culture:
        pulse = Stimulus(0.1, tuple(culture.patterns[0].tolist()), PUBLISHED_PULSE)
        traces = record_traces(culture, 0.2, stimuli=[pulse])
        distance_um = culture.selection.array.distance_um(np.array(pulse.electrodes), culture.selection.recording)
    nearest = distance_um.min(axis=0)
    at = round(traces.stimulus_time_s[0] * 20_000)
    assert np.all(traces.voltage_uv[at : at + 60, nearest == 0] == -3200)
    far = nearest > 800
    assert np.abs(np.median(traces.voltage_uv[at + 40 : at + 60, far])) < 12
    assert np.abs(traces.voltage_uv[at - 40 : at]).max() < 400


def test_too_much_at_once_is_refused() -> None:
    with small_culture() as culture:
        with pytest.raises(InvalidArgument, match="take a shorter stretch or fewer channels"):
            record_traces(culture, 1e5)
        with pytest.raises(InvalidArgument, match="channels: expected different rows"):
            record_traces(culture, 0.1, channels=[0, 0])
        assert culture.now_s == 0.0
