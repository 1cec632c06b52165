"""Synthetic recordings: their known truth is recovered. Oracles: the gamma's closed forms, scikit-image's Otsu."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from skimage.filters import threshold_otsu

from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording, read_recordings
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Presentation
from synthetic_recordings import synthetic_recording, write_synthetic_series

MEANS_HZ = {5: 30.0, 10: 36.0, 20: 42.0, 40: 48.0, 80: 54.0}


def responses(recording: Recording) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The response x and the active ratio of each stimulus, counted one by one."""
    x, ratio = [], []
    for time_s in recording.stimuli.time_s:
        first, last = np.searchsorted(recording.spike_times_s, [time_s + 0.002, time_s + 0.010])
        x.append((last - first) / (0.008 * len(recording.channels)))
        ratio.append(len(np.unique(recording.spike_channels[first:last])) / len(recording.channels))
    return np.array(x), np.array(ratio)


@pytest.fixture(scope="module")
def long() -> Recording:
    return synthetic_recording(0, patterns=2000)


def test_responses_have_the_distribution_that_was_put_in(long: Recording) -> None:
    x, ratio = responses(long)
    for frequency_hz, mean_hz in MEANS_HZ.items():
        drawn = x[(long.stimuli.frequency_hz == frequency_hz) & (ratio < 0.6)]
        sem_hz = mean_hz / np.sqrt(6 * len(drawn))
        assert drawn.mean() == pytest.approx(mean_hz, abs=4 * sem_hz)
        assert drawn.std() == pytest.approx(mean_hz / np.sqrt(6), rel=0.1)
        # x comes in steps of 0.49 Hz, a hundredth of its spread's scale: invisible to this test's power.
        assert stats.kstest(drawn, stats.gamma(6, scale=mean_hz / 6).cdf).pvalue > 1e-3


def test_otsu_finds_exactly_the_bursts(long: Recording) -> None:
    _, ratio = responses(long)
    is_burst = ratio > threshold_otsu(ratio)
    assert ratio[~is_burst].max() < 0.5
    assert ratio[is_burst].min() >= 0.9
    assert is_burst.mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / len(ratio)))


def test_the_protocol_is_the_papers() -> None:
    recording = synthetic_recording(1)
    assert recording.presentation == Presentation("blocked", 1)
    stimuli = recording.stimuli
    assert len(stimuli) == 500
    frequencies_hz = stimuli.frequency_hz.reshape(5, 100)
    assert sorted(frequencies_hz[:, 0]) == sorted(MEANS_HZ)
    assert np.all(frequencies_hz == frequencies_hz[:, :1])
    np.testing.assert_allclose(np.diff(stimuli.time_s.reshape(5, 100)), 1 / frequencies_hz[:, 1:])
    assert np.array_equal(np.sort(stimuli.pattern.reshape(5, 100)), np.tile(np.arange(100), (5, 1)))
    for pattern in range(100):
        assert len(np.unique(stimuli.electrodes[stimuli.pattern == pattern], axis=0)) == 1
    used = np.unique(stimuli.electrodes)
    assert len(used) == 32
    assert not np.any(np.isin(used, recording.channels.electrode))
    xy_um = np.column_stack([used % 220, used // 220]) * 17.5
    distance_um = np.linalg.norm(xy_um[:, None] - xy_um[None], axis=-1)[~np.eye(32, dtype=bool)]
    assert distance_um.min() > 100
    assert recording_findings(recording) == ()


def test_spikes_outside_the_window_come_at_the_background_rate() -> None:
    quiet = synthetic_recording(2, burst_share=0.0, means_hz=(0.0,) * 5, frequencies_hz=(1, 2, 3, 4, 5))
    since_s = (
        quiet.spike_times_s
        - quiet.stimuli.time_s[
            np.maximum(np.searchsorted(quiet.stimuli.time_s, quiet.spike_times_s, side="right") - 1, 0)
        ]
    )
    assert not np.any((since_s >= 0) & (since_s <= 0.010))
    expected = 0.5 * len(quiet.channels) * (quiet.duration_s - 500 * 0.0102)
    assert len(quiet.spike_times_s) == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_the_same_seed_is_the_same_recording_and_the_culture_tires() -> None:
    assert synthetic_recording(5).equals(synthetic_recording(5))
    fresh, tired = synthetic_recording(5), synthetic_recording(5, start_min=600.0)
    assert not np.array_equal(fresh.spike_times_s, tired.spike_times_s)
    assert np.array_equal(fresh.channels.electrode, tired.channels.electrode)
    assert not np.array_equal(fresh.channels.electrode, synthetic_recording(6).channels.electrode)
    mean_hz = [x[ratio < 0.6].mean() for x, ratio in map(responses, (fresh, tired))]
    assert mean_hz[1] / mean_hz[0] == pytest.approx(np.exp(-0.05 * 10), rel=0.1)


@pytest.mark.oracle
def test_a_series_is_written(tmp_path: Path) -> None:
    few = {"patterns": 5, "channels": 16}
    files = write_synthetic_series(1, tmp_path / "series", sessions=3, **few)
    assert [file.name for file in files] == [
        "recording_0000_min.nwb",
        "recording_0010_min.nwb",
        "recording_0020_min.nwb",
    ]
    assert [recording.start_min for recording in read_recordings(tmp_path / "series")] == [0.0, 10.0, 20.0]
    assert read_recording(files[1]).equals(synthetic_recording(1, start_min=10.0, **few))
