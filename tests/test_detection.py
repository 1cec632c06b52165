"""Raw traces to spikes. Oracles: traces with known spikes, scipy's two-pass filter, a plain loop, SpikeInterface."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float64, Int64
from scipy import signal

from animat.cultures.traces import Traces, record_traces
from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.recordings.conversion import read_traces
from animat.recordings.detection.artefacts import without_artefacts
from animat.recordings.detection.settings import Detection
from animat.recordings.detection.spikes import (
    DetectedSpikes,
    band_pass,
    detect_spikes,
    find_negative_peaks,
    median_noise_uv,
)
from animat.recordings.formats.cl1_layout import SITES
from animat.recordings.formats.hdf5_formats import open_traces
from animat.recordings.raw import RawTraces, in_microvolts
from animat.recordings.recording import Channels
from animat.stimulation.pulse import PUBLISHED_PULSE
from animat.stimulation.stimulus import Stimulus
from cultures import small_culture
from rig_files import BITS, FIRST_FRAME, event_table, mapping_table, write_cl1, write_maxwell, write_old_maxwell

RATE_HZ = 20_000.0
SPIKE_UV = -60 * np.exp(-(((np.arange(-20, 41)) / 3.0) ** 2) / 2)


def channels(n: int) -> Channels:
    return Channels(np.arange(n).astype(str), np.arange(n), np.arange(n) * 17.5, np.zeros(n))


def noisy(
    n: int, seconds: float, seed: int = 0, step_uv: float = 0.1
) -> tuple[np.ndarray, list[Int64[np.ndarray, " n"]]]:
    """Whole numbers of noise of 5 uV with spikes of 60 uV at known samples, never closer than 3 ms."""
    rng = np.random.default_rng(seed)
    voltage = rng.normal(0, 5 / step_uv, (round(seconds * RATE_HZ), n))
    truth = []
    for column in range(n):
        at = np.cumsum(rng.integers(60, 8000, round(seconds * 8))) + 100
        at = at[at < len(voltage) - 100]
        for sample in at:
            voltage[sample - 20 : sample + 41, column] += SPIKE_UV / step_uv
        truth.append(at)
    return np.rint(voltage).astype(np.int16), truth


def agreement(found: DetectedSpikes, truth: list[Int64[np.ndarray, " n"]]) -> tuple[int, int, int]:
    """Spikes found, missed and made up, within half a millisecond."""
    hit = missed = false = 0
    for column, at in enumerate(truth):
        sample = np.rint(found.time_s[found.channel == column] * RATE_HZ)
        near = np.abs(sample[:, None] - at[None, :]) <= 10
        hit += int(near.any(axis=0).sum())
        missed += int((~near.any(axis=0)).sum())
        false += int((~near.any(axis=1)).sum())
    return hit, missed, false


@pytest.fixture(scope="module")
def known() -> tuple[RawTraces, list[Int64[np.ndarray, " n"]]]:
    voltage, truth = noisy(70, 6.0)
    return RawTraces.from_array(voltage, channels(70), RATE_HZ, start_s=-1.0, uv_per_step=0.1), truth


@pytest.fixture(scope="module")
def found_in_known(known: tuple[RawTraces, list[Int64[np.ndarray, " n"]]]) -> DetectedSpikes:
    return detect_spikes(known[0], workers=1)


def test_known_spikes_are_found_and_few_others(known: tuple[RawTraces, list[Int64[np.ndarray, " n"]]]) -> None:
    traces, truth = known
    found = detect_spikes(traces)
    shifted = DetectedSpikes(found.time_s + 1.0, found.channel, found.noise_uv, found.findings)
    hit, missed, false = agreement(shifted, truth)
    assert hit > 1500
    assert missed + false <= 0.01 * hit
    # White noise of 5 uV keeps the share of its power that is in the band.
    np.testing.assert_allclose(found.noise_uv, 5 * np.sqrt(2900 / 10_000), rtol=0.1)
    assert np.all(np.diff(found.time_s) >= 0)


@pytest.mark.oracle
@pytest.mark.parametrize(("chunk_s", "workers"), [(0.1, 1), (0.3, 3), (10.0, 2)])
def test_the_size_of_pieces_and_the_number_of_threads_change_nothing(
    known: tuple[RawTraces, list[Int64[np.ndarray, " n"]]], found_in_known: DetectedSpikes, chunk_s: float, workers: int
) -> None:
    whole = found_in_known
    pieces = detect_spikes(known[0], None, Detection(chunk_s=chunk_s), workers=workers)
    # A negative peak at the threshold itself can fall on either side by the rounding of single precision.
    assert abs(len(pieces.time_s) - len(whole.time_s)) <= 2
    both = set(zip(whole.time_s.tolist(), whole.channel.tolist(), strict=True)) & set(
        zip(pieces.time_s.tolist(), pieces.channel.tolist(), strict=True)
    )
    assert len(both) >= len(whole.time_s) - 3


def test_the_filter_is_the_two_pass_butterworth() -> None:
    rng = np.random.default_rng(1)
    voltage = rng.normal(0, 10, (3, 9000)).astype(np.float32) + 500
    sections = signal.butter(3, (100, 3000), "bandpass", fs=RATE_HZ, output="sos")
    expected = signal.sosfiltfilt(sections, voltage.astype(np.float64), axis=1)
    filtered = band_pass(voltage, (100.0, 3000.0), RATE_HZ)
    np.testing.assert_allclose(filtered[:, 1000:-1000], expected[:, 1000:-1000], atol=2e-3)
    # Without a band, traces are filtered already.
    np.testing.assert_array_equal(band_pass(voltage, None, RATE_HZ).T, voltage.T - np.median(voltage, axis=1))


@settings(deadline=None, max_examples=60)
@given(steps=st.lists(st.integers(-9, 3), min_size=1, max_size=60), apart=st.integers(1, 8), depth=st.integers(0, 8))
def test_negative_peaks_are_those_of_the_definition(steps: list[int], apart: int, depth: int) -> None:
    trace = np.array(steps, dtype=np.float32)
    expected = [
        t
        for t, v in enumerate(steps)
        if v < -depth
        and all(v < s for s in steps[max(t - apart, 0) : t])
        and all(v <= s for s in steps[t + 1 : t + apart + 1])
    ]
    row, sample = find_negative_peaks(trace[None, :], np.array([depth], np.float32), apart, 0, len(trace))
    assert sample.tolist() == expected
    assert set(row.tolist()) <= {0}


def test_spikeinterface_finds_the_same_spikes(known: tuple[RawTraces, list[Int64[np.ndarray, " n"]]]) -> None:
    core = pytest.importorskip("spikeinterface.core", reason="SpikeInterface is not installed (animat[raw])")
    from spikeinterface.preprocessing import bandpass_filter
    from spikeinterface.sortingcomponents.peak_detection import detect_peaks

    traces = known[0]
    ours = detect_spikes(traces)
    recording = core.NumpyRecording([traces.read_uv(0, traces.samples)], RATE_HZ)
    recording.set_dummy_probe_from_locations(np.column_stack([np.arange(70) * 1e3, np.zeros(70)]))
    peaks = detect_peaks(
        bandpass_filter(recording, freq_min=100, freq_max=3000, filter_order=3, dtype="float32"),
        method="by_channel",
        method_kwargs={"detect_threshold": 1.0, "exclude_sweep_ms": 1.0, "noise_levels": 5.0 * ours.noise_uv},
        job_kwargs={"n_jobs": 1, "progress_bar": False},
    )
    sample = np.rint((ours.time_s - traces.start_s) * RATE_HZ).astype(int)
    found = set(zip(sample.tolist(), ours.channel.tolist(), strict=True))
    theirs = set(zip(peaks["sample_index"].tolist(), peaks["channel_index"].tolist(), strict=True))
    assert len(found) > 1000
    assert len(found ^ theirs) <= 0.01 * len(found)


@settings(deadline=None, max_examples=40)
@given(
    samples=st.integers(0, 600),
    n=st.integers(1, 150),
    kind=st.sampled_from(["<i2", "<u2", ">i2", "f4", "f8"]),
    turned=st.booleans(),
)
def test_traces_are_the_same_in_any_layout(samples: int, n: int, kind: str, turned: bool) -> None:
    steps = np.random.default_rng(samples).integers(0, 3000, (samples, n)).astype(kind)
    given_steps = np.asfortranarray(steps) if turned else steps
    voltage = in_microvolts(given_steps, 0.195)
    np.testing.assert_array_equal(voltage, steps.astype(np.float32) * np.float32(0.195))
    assert voltage.dtype == np.float32
    assert voltage.T.flags.c_contiguous


@pytest.mark.parametrize("samples", [2499, 2500, 7001])
def test_the_noise_is_estimated_from_the_median(samples: int) -> None:
    voltage = np.random.default_rng(2).normal(3, 5, (4, samples)).astype(np.float32)
    looked_at = voltage[:, :: max(samples // 2500, 1)]
    middle = np.median(looked_at, axis=1, keepdims=True)
    expected = np.median(np.abs(looked_at - middle), axis=1) / 0.6745
    # Of an even number of values, the upper of the two middle ones instead of their mean.
    np.testing.assert_allclose(median_noise_uv(voltage), expected, rtol=1e-6 if looked_at.shape[1] % 2 else 2e-3)
    # What is blanked does not count, whatever is in it, and 9 % of the samples are too few.
    is_blank = np.arange(samples) >= samples * np.array([[0.9], [0.2], [0.11], [0.09]])
    of_each = [
        np.median(np.abs(row[~blank] - np.median(row[~blank]))) for row, blank in zip(voltage, is_blank, strict=True)
    ]
    voltage[is_blank] = 1000.0
    np.testing.assert_allclose(median_noise_uv(voltage, is_blank)[:3], np.array(of_each[:3]) / 0.6745, rtol=0.03)
    assert np.isnan(median_noise_uv(voltage, is_blank)[3])


# --- artefacts -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stimulated() -> tuple[Traces, RawTraces]:
    with small_culture() as culture:
        pulses = [Stimulus(0.2 + 0.1 * i, tuple(culture.patterns[i].tolist()), PUBLISHED_PULSE) for i in range(16)]
        traces = record_traces(culture, 2.0, stimuli=pulses)
        x_um, y_um = culture.selection.array.position_um(culture.selection.recording)
    n = traces.voltage_uv.shape[1]
    table = Channels(np.arange(n).astype(str), np.arange(n), x_um, y_um)
    return traces, RawTraces.from_array(traces.voltage_uv, table, traces.sampling_rate_hz)


def in_window(
    time_s: Float64[np.ndarray, " spikes"], stimulus_s: Float64[np.ndarray, " stimuli"], window_ms: tuple[float, float]
) -> np.ndarray:
    since_ms = 1e3 * (time_s - stimulus_s[np.maximum(np.searchsorted(stimulus_s, time_s, side="right") - 1, 0)])
    return (since_ms >= window_ms[0]) & (since_ms < window_ms[1])


@pytest.mark.oracle
def test_responses_of_a_stimulated_culture_are_found_from_2_ms_on(stimulated: tuple[Traces, RawTraces]) -> None:
    traces, source = stimulated
    found = detect_spikes(source, traces.stimulus_time_s, Detection())
    large = (traces.amplitude_uv > 8 * 2.4) & in_window(traces.spikes.time_s, traces.stimulus_time_s, (2, 10))
    kept = in_window(found.time_s, traces.stimulus_time_s, (2, 10))
    true_s, true_channel = traces.spikes.time_s, traces.spikes.channel
    # While an amplifier is at its rail, next to a stimulated electrode, there is no spike in its trace.
    size_uv = np.abs(traces.voltage_uv)
    at = (
        np.round(true_s * traces.sampling_rate_hz).astype(int)
        + np.arange(round(1e-3 * traces.sampling_rate_hz))[:, None]
    )
    railed = np.any(size_uv[np.minimum(at, len(size_uv) - 1), true_channel] >= size_uv.max(), axis=0)
    assert 0 < np.count_nonzero(large & railed) <= 0.05 * np.count_nonzero(large)
    large &= ~railed
    hit = sum(
        bool(np.any((found.channel == c) & (np.abs(found.time_s - t) < 6e-4)))
        for t, c in zip(true_s[large], true_channel[large], strict=True)
    )
    false = sum(
        not np.any((true_channel == c) & (np.abs(true_s - t) < 6e-4))
        for t, c in zip(found.time_s[kept], found.channel[kept], strict=True)
    )
    assert np.count_nonzero(large) > 300
    assert hit >= 0.99 * np.count_nonzero(large)
    assert false <= 0.02 * np.count_nonzero(kept)
    assert not np.any(in_window(found.time_s, traces.stimulus_time_s, (0, 1.4)))
    names = {finding.name: finding for finding in found.findings}
    assert names["blanked"].severity == "note"
    assert "are saturated on average" in names["saturated-channels"].message


@pytest.mark.oracle
def test_without_removing_artefacts_they_are_found_as_spikes(stimulated: tuple[Traces, RawTraces]) -> None:
    traces, source = stimulated
    naive = detect_spikes(source)
    removed = detect_spikes(source, traces.stimulus_time_s, Detection())
    count = [np.count_nonzero(in_window(f.time_s, traces.stimulus_time_s, (0, 10))) for f in (naive, removed)]
    assert count[0] > 1.3 * count[1]


def test_a_window_is_not_eaten_unasked() -> None:
    assert Detection().blank_ms[1] <= 1.5
    traces = RawTraces.from_array(noisy(2, 1.0)[0], channels(2), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(traces, np.array([0.5]), Detection(blank_ms=(0.5, 3.0)))
    assert {f.name: f.severity for f in found.findings}["blanked"] == "warning"


@pytest.mark.parametrize("before_ms", [4.5, 10.0])
def test_a_long_blank_before_pulses_leaves_the_spikes_outside(before_ms: float) -> None:
    """Pulses before a piece are read with their resting voltage: the blank may begin before what is read."""
    voltage, truth = noisy(2, 3.0)
    times_s = np.arange(0.1, 2.9, 0.2)
    traces = RawTraces.from_array(voltage, channels(2), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(traces, times_s, Detection(blank_ms=(before_ms, 1.5)))
    samples = (times_s * RATE_HZ)[:, None]
    outside = [at[np.all((at < samples - 250) | (at > samples + 80), axis=0)] for at in truth]
    hit, missed, _ = agreement(found, outside)
    assert missed <= 0.01 * hit
    assert "saturated-channels" not in {finding.name for finding in found.findings}


def test_a_saturated_channel_is_blanked_until_it_moves_again() -> None:
    voltage, _ = noisy(4, 0.2)
    trace = np.ascontiguousarray(voltage.T * np.float32(0.1))
    trace[1, 2000:2100] = -3200.0
    noise = np.full(4, 5.0, np.float32)
    cleaned = without_artefacts(trace, np.array([2000]), noise, RATE_HZ, Detection())
    assert cleaned.is_blank is not None
    assert cleaned.is_blank[1, 1990:2100].all()
    assert not cleaned.is_blank[1, 2106:].any()
    assert not cleaned.is_blank[0, 2030:].any()
    assert (cleaned.saturated.tolist(), np.abs(cleaned.voltage_uv[1]).max() < 100) == ([1], True)
    assert 5.0 <= cleaned.longest_ms[0] <= 5.5


def test_a_blank_is_a_straight_line_between_its_sides() -> None:
    trace = np.zeros((2, 4000), np.float32)
    trace[1, 2000:] = 50.0
    # What is more than ten samples away does not count.
    trace[1, :1980], trace[1, 2040:] = 30.0, 20.0
    expected = trace.copy()
    expected[1, 1989:2031] = np.linspace(0.0, 50.0, 42)
    settings = Detection(blank_ms=(0.5, 1.5))
    # Far from rest only by half of the noise: nothing to fit.
    cleaned = without_artefacts(trace, np.array([2000]), np.full(2, 100.0, np.float32), RATE_HZ, settings)
    assert np.flatnonzero(cleaned.is_blank[1]).tolist() == list(range(1990, 2030))
    np.testing.assert_allclose(cleaned.voltage_uv, expected, atol=1e-3)
    none = Detection(blank_ms=(0.0, 0.0))
    # A pulse without a blank changes nothing, nor does one whose blank ends before the stretch or begins after it.
    for pulse, of_pulse in ((2000, none), (-3000, settings), (5000, settings)):
        untouched = without_artefacts(trace.copy(), np.array([pulse]), np.full(2, 100.0, np.float32), RATE_HZ, of_pulse)
        assert np.array_equal(untouched.voltage_uv, trace)
        assert not (untouched.is_blank.any() or untouched.saturated.any())


@pytest.mark.parametrize("amplitude", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("step_uv", [6.3, *(pytest.param(each, marks=pytest.mark.oracle) for each in (0.195, 12.6))])
def test_the_negative_peak_of_a_spike_in_coarse_steps_is_no_saturation(amplitude: float, step_uv: float) -> None:
    rng = np.random.default_rng(5)
    pulses = np.arange(1000, 39_000, 1000)
    voltage = rng.normal(0, 3, (40_000, 8))
    late = rng.uniform(2.5, 9.0, (len(pulses), 8))
    for pulse, of_pulse in zip(pulses, late, strict=True):
        for channel, ms in enumerate(of_pulse):
            at = pulse + round(ms * 20)
            voltage[at - 20 : at + 41, channel] += amplitude * SPIKE_UV
    traces = RawTraces.from_array(
        np.rint(voltage / step_uv).astype(np.int16), channels(8), RATE_HZ, uv_per_step=step_uv
    )
    found = detect_spikes(traces, pulses / RATE_HZ, Detection())
    assert "saturated-channels" not in {finding.name for finding in found.findings}
    truth = [pulses + np.rint(late[:, channel] * 20).astype(np.int64) for channel in range(8)]
    hit, missed, _ = agreement(found, truth)
    assert missed <= 0.01 * hit


@pytest.mark.parametrize("until_ms", [1.7, 2.4, 9.0])
@pytest.mark.parametrize("dither", [0.0, 6.3])
def test_how_long_an_amplifier_saturates_is_seen(until_ms: float, dither: float) -> None:
    rng = np.random.default_rng(6)
    trace = (6.3 * np.rint(rng.normal(0, 5, (3, 4000)) / 6.3)).astype(np.float32)
    stop = 2000 + round(until_ms * 20)
    trace[1, 2000:stop] = 3200 + dither * rng.integers(0, 2, stop - 2000)
    cleaned = without_artefacts(trace, np.array([2000]), np.full(3, 5.0, np.float32), RATE_HZ, Detection())
    assert cleaned.is_blank is not None
    assert cleaned.is_blank[1, 1990:stop].all()
    assert not cleaned.is_blank[1, stop + 6 :].any()
    assert not cleaned.is_blank[[0, 2], 2030:].any()


@pytest.mark.parametrize("tau_ms", [0.4, 1.0, 2.7, 6.0])
@pytest.mark.parametrize("size_uv", [-3000.0, 150.0])
def test_a_decay_is_taken_away_and_spikes_on_it_are_left(tau_ms: float, size_uv: float) -> None:
    rng = np.random.default_rng(3)
    t_ms = np.arange(4000) / 20 - 100
    trace = rng.normal(0, 3, (1, 4000)).astype(np.float32)
    spikes = np.zeros(4000, np.float32)
    spikes[2080:2141] += SPIKE_UV.astype(np.float32)
    decay = np.where(t_ms >= 0, size_uv * np.exp(-t_ms / tau_ms), 0)
    before = trace[0] + spikes
    cleaned = without_artefacts(
        (before + decay)[None, :].astype(np.float32),
        np.array([2000]),
        np.array([3.0], np.float32),
        RATE_HZ,
        Detection(),
    )
    error = cleaned.voltage_uv[0, 2040:] - before[2040:]
    # Beyond where it is followed (20 ms) what is left of the slowest is 3 % of 3 mV.
    assert np.abs(error[:350]).max() < 6.0


def test_pulses_in_quick_succession_and_at_the_ends_are_only_blanked() -> None:
    traces = RawTraces.from_array(noisy(3, 0.5)[0], channels(3), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(traces, np.array([-0.001, 0.0, 0.1, 0.1005, 0.101, 0.4999, 0.5, 7.0]), Detection())
    assert np.all((found.time_s >= 0) & (found.time_s <= 0.5))


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("until_ms", "chunk_s"),
    [(15.0, 0.2), (100.0, 0.5), (700.0, 0.2), (15.0, 0.5), (100.0, 0.2), (700.0, 0.5)],
)
def test_who_is_saturated_for_long_is_blanked_to_its_end(until_ms: float, chunk_s: float) -> None:
    voltage, truth = noisy(6, 16.0)
    # The fourth comes while the third still saturates the channel, where that lasts 100 ms.
    pulses = np.array([0.45, 3.62, 6.1, 6.16 if until_ms == 100 else 8.0, 11.0, 13.4])
    first = np.rint(pulses * RATE_HZ).astype(np.int64)
    last = first + round(until_ms * 20)
    is_railed = np.zeros(len(voltage), dtype=bool)
    for start, stop in zip(first, last, strict=True):
        is_railed[start:stop] = True
    voltage[is_railed, 2] = 32_000
    source = RawTraces.from_array(voltage, channels(6), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(source, pulses, Detection(chunk_s=chunk_s))
    sample = np.rint(found.time_s * RATE_HZ).astype(np.int64)
    on_it = sample[found.channel == 2]
    # Every spike found there is a true one, out of what is saturated and of the quarter of a millisecond after it.
    near = np.abs(on_it[:, None] - truth[2][None, :]).min(axis=1) <= 10
    assert np.count_nonzero(~near) <= 1
    assert not np.any(is_railed[on_it])
    free = truth[2][~np.array([is_railed[max(t - 150, 0) : t + 40].any() for t in truth[2]])]
    blank = np.array([np.any((t >= first - 11) & (t <= first + 31)) for t in free])
    missed = np.array([np.abs(on_it - t).min() > 10 for t in free[~blank]])
    assert np.count_nonzero(missed) <= 1
    others = [np.count_nonzero(found.channel == column) for column in range(6) if column != 2]
    assert min(others) > 0.9 * min(len(t) for t in truth)
    message = {f.name: f.message for f in found.findings}["saturated-channels"]
    assert message.startswith("after a stimulus 1.0 of 6 channels are saturated on average")
    assert f"the longest until {until_ms + 0.25:.1f} ms" in message
    assert f"at most {until_ms + 0.25:.1f} ms" in message


@pytest.mark.oracle
@pytest.mark.parametrize("chunk_s", [0.5, 20.0])
@pytest.mark.parametrize("from_s", [1.03, 1.14, 1.25])
def test_who_is_saturated_over_several_pulses_is_blanked_wherever_pieces_begin(from_s: float, chunk_s: float) -> None:
    voltage, truth = noisy(4, 20.0)
    pulses = np.arange(from_s, 19.0, 0.05)
    is_railed = np.zeros(len(voltage), dtype=bool)
    for start_s in pulses[10:340:15]:
        is_railed[round(start_s * RATE_HZ) : round((start_s + 0.17) * RATE_HZ)] = True
    voltage[is_railed, 1] = 32_000
    source = RawTraces.from_array(voltage, channels(4), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(source, pulses, Detection(chunk_s=chunk_s))
    on_it = np.rint(found.time_s[found.channel == 1] * RATE_HZ).astype(np.int64)
    assert not np.any(is_railed[on_it])
    assert np.count_nonzero(np.abs(on_it[:, None] - truth[1][None, :]).min(axis=1) > 10) <= 1


def test_channels_are_counted_once_at_each_pulse_wherever_pieces_begin() -> None:
    voltage, _ = noisy(2, 0.7)
    pulses = np.arange(0.2, 0.68, 0.0125)
    for start in np.rint(pulses * RATE_HZ).astype(int):
        voltage[start : start + 50, 0] = 32_000
    source = RawTraces.from_array(voltage, channels(2), RATE_HZ, uv_per_step=0.1)
    found = detect_spikes(source, pulses, Detection(chunk_s=0.1))
    assert {finding.name: finding.value for finding in found.findings}["saturated-channels"] == 0.5


@pytest.mark.oracle
def test_an_amplifier_that_is_mostly_saturated_is_blanked_wherever_pieces_begin() -> None:
    voltage, truth = noisy(4, 20.0)
    # At rest it is at -2 mV, which is as far from 0 as what it saturates at.
    voltage -= 20_000
    pulses = np.arange(1.03, 19.0, 0.2)
    is_railed = np.zeros(len(voltage), dtype=bool)
    for start_s in pulses[2:30:5]:
        is_railed[round(start_s * RATE_HZ) : round((start_s + 0.65) * RATE_HZ)] = True
    voltage[is_railed, 1] = 32_000
    source = RawTraces.from_array(voltage, channels(4), RATE_HZ, uv_per_step=0.1)
    for chunk_s in (0.2, 0.5, 20.0):
        found = detect_spikes(source, pulses, Detection(chunk_s=chunk_s))
        on_it = np.rint(found.time_s[found.channel == 1] * RATE_HZ).astype(np.int64)
        assert not np.any(is_railed[on_it])
        assert np.count_nonzero(np.abs(on_it[:, None] - truth[1][None, :]).min(axis=1) > 10) <= 1


def test_samples_that_are_no_numbers_are_blank_and_the_rest_of_the_channel_is_heard() -> None:
    voltage, truth = noisy(4, 4.0)
    voltage_uv = voltage.astype(np.float32) * np.float32(0.1)
    lost = np.zeros(voltage_uv.shape, dtype=bool)
    lost[[10_000, 30_000], 1] = True
    lost[50_000:52_000, 1] = True
    lost[:, 3] = True
    whole = detect_spikes(RawTraces.from_array(voltage_uv, channels(4), RATE_HZ))
    voltage_uv[lost] = np.nan
    voltage_uv[30_000, 1] = np.inf
    found = detect_spikes(RawTraces.from_array(voltage_uv, channels(4), RATE_HZ), np.array([1.0]))
    assert np.all(np.isfinite(found.noise_uv)) and found.noise_uv[1] == pytest.approx(whole.noise_uv[1], rel=0.05)
    names = {f.name: f for f in found.findings}
    assert names["samples-lost"].value == lost.sum() and "2 of 4 channels" in names["samples-lost"].message
    assert names["dead-channels"].value == 1 and "nan" not in names["noise"].message
    at = np.rint(found.time_s[found.channel == 1] * RATE_HZ)
    assert not np.any(lost[at.astype(int), 1]) and 3 not in found.channel
    expected = truth[1][~np.array([lost[t - 40 : t + 41, 1].any() for t in truth[1]])]
    expected = expected[np.abs(expected - 20_000) > 60]
    hit = sum(np.abs(at - t).min() <= 10 for t in expected)
    assert hit >= 0.98 * len(expected) and len(at) <= len(truth[1]) + 2


def test_dead_and_noisy_channels_are_said() -> None:
    voltage, _ = noisy(30, 1.0)
    voltage[:, 3] = 7
    voltage[:, 8] *= 20
    found = detect_spikes(RawTraces.from_array(voltage, channels(30), RATE_HZ, uv_per_step=0.1))
    said = {finding.name: finding.value for finding in found.findings}
    assert (said["dead-channels"], said["noisy-channels"]) == (1, 1)
    assert 3 not in found.channel


@pytest.mark.parametrize(("sign", "is_inverted"), [(1, False), (-1, True), (0, False)])
def test_inverted_traces_cause_a_warning(sign: int, is_inverted: bool) -> None:
    voltage, _ = noisy(30, 4.0)
    if not sign:
        voltage = np.random.default_rng(0).normal(0, 50, voltage.shape).astype(np.int16)
    found = detect_spikes(RawTraces.from_array((sign or 1) * voltage, channels(30), RATE_HZ, uv_per_step=0.1))
    assert ("inverted" in {finding.name for finding in found.findings}) == is_inverted


@pytest.mark.parametrize(("uv_per_step", "severity"), [(0.1, "note"), (1e5, "warning"), (1e-4, "warning")])
def test_traces_in_another_unit_cause_a_warning(uv_per_step: float, severity: str) -> None:
    found = detect_spikes(RawTraces.from_array(noisy(30, 1.0)[0], channels(30), RATE_HZ, uv_per_step=uv_per_step))
    noise = next(finding for finding in found.findings if finding.name == "noise")
    assert noise.severity == severity
    assert ("are the traces in volts?" in noise.message) == (severity == "warning")


@pytest.mark.parametrize(
    ("setting", "value"),
    [("band_hz", (300.0, 100.0)), ("threshold", 0.0), ("blank_ms", (0.0, -1.0)), ("chunk_s", 0.0)],
)
def test_settings_that_cannot_be_are_refused(setting: str, value: object) -> None:
    with pytest.raises(InvalidArgument, match=setting):
        Detection(**{setting: value})  # type: ignore[arg-type]


def test_a_band_beyond_the_sampling_rate_is_refused() -> None:
    traces = RawTraces.from_array(np.zeros((4000, 1), np.int16), channels(1), 5000.0)
    with pytest.raises(InvalidArgument, match="less than half the sampling rate of 5000 Hz, got 3000 Hz"):
        detect_spikes(traces)


# --- from files ------------------------------------------------------------------------------------------------------


def test_raw_traces_of_a_maxwell_file(tmp_path: Path) -> None:
    voltage, truth = noisy(3, 2.0, step_uv=6.3)
    raw = (voltage.T + 512).astype("<u2")
    path = write_maxwell(
        tmp_path / "a.h5",
        mapping=mapping_table([40, 9, 3], [26_399, 2000, 1000]),
        spikes=None,
        events=event_table([0.5], [""]),
        recorded=[9, 40, 3],
        raw=raw,
    )
    recording = read_traces(path, Detection())
    assert recording.channels.label.tolist() == ["9", "40", "3"]
    assert recording.channels.electrode.tolist() == [2000, 26_399, 1000]
    # In microvolts.
    np.testing.assert_allclose(open_traces(path)[0].read_uv(0, 9), 6.3 * raw[:, :9].T, rtol=1e-5)
    assert (recording.duration_s, len(recording.stimuli)) == (2.0, 1)
    found = DetectedSpikes(recording.spike_times_s, recording.spike_channels, np.empty(0), ())
    hit, missed, false = agreement(found, [at[np.abs(at - 10_000) > 60] for at in truth])
    assert hit > 15
    assert missed == 0
    assert false <= 1
    assert "5 x median noise" in recording.provenance["spikes"]
    with h5py.File(path, "r+") as file:
        del file["wells/well000/rec0000/groups/routed/frame_nos"]
    with pytest.raises(InvalidFile, match="frame_nos, which align the traces with stimuli, found none"):
        read_traces(path, Detection())
    with h5py.File(path, "r+") as file:
        del file["wells/well000/rec0000/events"]
    assert read_traces(path, Detection()).spike_times_s.tolist() == recording.spike_times_s.tolist()


def test_after_frames_that_a_maxone_lost_spikes_are_where_they_were(tmp_path: Path) -> None:
    voltage, _ = noisy(3, 1.0, step_uv=6.3)
    given = {"mapping": mapping_table([40, 9, 3], [3, 2, 1]), "spikes": None, "events": event_table([0.8], [""])}
    path = write_maxwell(tmp_path / "a.h5", **given, recorded=[3, 9, 40], raw=(voltage.T + 512).astype("<u2"))
    whole = read_traces(path)
    kept = np.delete(np.arange(len(voltage)), np.s_[8000:8600])
    with h5py.File(path, "r+") as file:
        groups = file["wells/well000/rec0000/groups"]
        raw, frames = groups["routed/raw"][:], groups["routed/frame_nos"][:]
        del groups["routed/raw"], groups["routed/frame_nos"]
        groups["routed/raw"], groups["routed/frame_nos"] = raw[:, kept], frames[kept]
        # A group without traces began 400 frames before, and one of a single channel lost none.
        groups["alone/frame_nos"] = frames[:10] - 400
        groups["one/channels"], groups["one/raw"], groups["one/frame_nos"] = np.array([3], "<u4"), raw[:1], frames
    lost, far = read_traces(path), np.abs(whole.spike_times_s - 0.415) > 0.018
    assert np.count_nonzero(whole.spike_times_s > 0.43) > 3
    np.testing.assert_allclose(lost.spike_times_s, whole.spike_times_s[far] + 0.02, atol=1e-12)
    np.testing.assert_array_equal(lost.spike_channels, whole.spike_channels[far])
    assert (lost.stimuli.time_s.tolist(), lost.stop_s) == ([0.82], 1.02)
    assert {f.name: f.value for f in lost.findings}.items() >= {"frames-lost": 600.0, "samples-lost": 1800.0}.items()
    # A number that falls, and one that would make days of it.
    for place, number in ((-1, 2**40), (5, 0)):
        with h5py.File(path, "r+") as file:
            file["wells/well000/rec0000/groups/routed/frame_nos"][place] = number
        with pytest.raises(InvalidFile, match="expected rising frame_nos or timestamps for 19,400 samples"):
            open_traces(path)


def test_raw_traces_of_an_old_maxwell_file_with_lost_frames(tmp_path: Path) -> None:
    voltage, truth = noisy(1, 0.4, step_uv=6.3)
    sig = np.full((1028, len(voltage)), 512, "<u2")
    sig[3] += voltage[:, 0].astype("<u2")
    bits = np.array([(FIRST_FRAME + 12_100, 1)], BITS)
    mapping = mapping_table([3], [1000])
    path = write_old_maxwell(tmp_path / "a.h5", mapping=mapping, spikes=None, bits=bits, sig=sig, lost=8000)
    recording = read_traces(path, Detection())
    assert (recording.duration_s, recording.stimuli.time_s.tolist()) == (0.8, [0.605])
    at = truth[0] + 8000 * (truth[0] >= 4000)
    at = at[np.abs(at - 12_100) > 60]
    found = DetectedSpikes(recording.spike_times_s, recording.spike_channels, np.empty(0), ())
    assert agreement(found, [at])[1] <= 1
    assert len(recording.spike_times_s) <= len(at) + 2


def test_raw_traces_of_a_cl1_file(tmp_path: Path) -> None:
    voltage, _ = noisy(64, 0.5, step_uv=0.195)
    path = write_cl1(tmp_path / "a.h5", spikes=None, stims=[(5000, 9)], samples=voltage)
    recording = read_traces(path, Detection())
    assert len(recording.channels) == 59
    assert len(recording.spike_times_s) > 60
    assert recording.stimuli.electrodes.tolist() == [[9]]
    with h5py.File(path, "r+") as file:
        file.attrs["uV_per_sample_unit"] = 0.25
    np.testing.assert_allclose(open_traces(path)[0].read_uv(3, 9), 0.25 * voltage[3:9, list(SITES)], rtol=1e-5)


def test_a_channel_that_is_saturated_most_of_the_time_is_not_taken_for_a_quiet_one() -> None:
    voltage, truth = noisy(3, 3.0)
    pulses = np.arange(2000, 58_000, 12_000)
    for pulse in pulses.tolist():
        voltage[pulse : pulse + 8000, 0] = 30_000
    found = detect_spikes(RawTraces.from_array(voltage, channels(3), RATE_HZ, uv_per_step=0.1), pulses / RATE_HZ)
    np.testing.assert_allclose(found.noise_uv, found.noise_uv[1], rtol=0.1)
    free = truth[0][(truth[0] - 2000) % 12_000 > 8100]
    assert abs(np.count_nonzero(found.channel == 0) - len(free)) <= 3


def write_nwb_traces(path: Path, voltage: np.ndarray, start_s: float) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["nwb_version"] = "2.7.0"
        series = file.create_group("acquisition/traces")
        series.attrs["neurodata_type"] = "ElectricalSeries"
        series["data"] = voltage
        series["data"].attrs["conversion"] = 1e-6
        series["starting_time"] = start_s
        series["starting_time"].attrs["rate"] = RATE_HZ


def test_noise_is_in_microvolts_where_each_channel_has_its_own_conversion(tmp_path: Path) -> None:
    voltage, _ = noisy(2, 1.0, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=0.0)
    expected = detect_spikes(open_traces(tmp_path / "a.nwb")[0], np.empty(0), Detection()).noise_uv
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        del file["acquisition/traces/data"]
        file["acquisition/traces/data"] = voltage / np.array([2.0, 5.0])
        file["acquisition/traces/data"].attrs["conversion"] = 1e-6
        file["acquisition/traces/channel_conversion"] = np.array([2.0, 5.0])
    traces, _ = open_traces(tmp_path / "a.nwb")
    np.testing.assert_allclose(detect_spikes(traces, np.empty(0), Detection()).noise_uv, expected, rtol=1e-5)
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        file["acquisition/traces/data"].attrs["conversion"] = -1e-6
    assert np.array_equal(open_traces(tmp_path / "a.nwb")[0].read_uv(0, 9), -traces.read_uv(0, 9))
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        del file["acquisition/traces/channel_conversion"]
        file["acquisition/traces/channel_conversion"] = np.ones(3)
    with pytest.raises(InvalidFile, match="expected a conversion of each of the 2 traces, got 3"):
        open_traces(tmp_path / "a.nwb")


def write_stimuli(path: Path, time_s: list[float]) -> None:
    with h5py.File(path, "r+") as file:
        table = file.create_group("intervals/stimuli")
        table.attrs["neurodata_type"] = "TimeIntervals"
        table.attrs["colnames"] = ["start_time", "stop_time"]
        table["start_time"] = table["stop_time"] = np.array(time_s)


def test_raw_traces_of_an_nwb_file(tmp_path: Path) -> None:
    voltage, truth = noisy(2, 1.0, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=0.0)
    recording = read_traces(tmp_path / "a.nwb", Detection())
    found = DetectedSpikes(recording.spike_times_s, recording.spike_channels, np.empty(0), ())
    assert agreement(found, truth)[1] == 0
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        file.copy("acquisition/traces", "acquisition/others")
    # Only convert reads traces.
    with pytest.raises(InvalidFile, match=r"found 2: others, traces; choose with --part NAME in animat convert$"):
        read_traces(tmp_path / "a.nwb", Detection())
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        del file["acquisition/others"], file["acquisition/traces/data"]
    with pytest.raises(InvalidFile, match="expected raw traces at /acquisition/traces/data, found none"):
        read_traces(tmp_path / "a.nwb", Detection())


def test_after_a_gap_in_the_timestamps_of_an_nwb_file_spikes_are_where_they_were(tmp_path: Path) -> None:
    voltage, _ = noisy(3, 1.0, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=7.0)
    whole = read_traces(tmp_path / "a.nwb")
    kept = np.delete(np.arange(len(voltage)), np.s_[8000:8600])
    # Timestamps in microseconds, of a rate at which they are rounded.
    rate_hz = 0.7 * RATE_HZ
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        series = file["acquisition/traces"]
        del series["data"], series["starting_time"]
        series["data"], series["timestamps"] = voltage[kept], np.round(7.0 + kept / rate_hz, 6)
        series["data"].attrs["conversion"] = 1e-6
    gapped, far = read_traces(tmp_path / "a.nwb"), np.abs(whole.spike_times_s - 7.415) > 0.018
    assert gapped.sampling_rate_hz == pytest.approx(rate_hz, rel=1e-6)
    assert np.count_nonzero(whole.spike_times_s > 7.43) > 3
    # To a sample: at another rate the filter is another.
    np.testing.assert_allclose(gapped.spike_times_s, 7 + (whole.spike_times_s[far] - 7) / 0.7, atol=1.1 / rate_hz)
    for times in ([0.0], np.zeros(len(kept)), np.full(len(kept), np.nan)):
        with h5py.File(tmp_path / "a.nwb", "r+") as file:
            del file["acquisition/traces/timestamps"]
            file["acquisition/traces/timestamps"] = times
        with pytest.raises(InvalidFile, match=f"expected two or more rising times in s .* got {len(times):,} others"):
            open_traces(tmp_path / "a.nwb")


def test_traces_of_an_nwb_file_are_on_the_electrodes_that_they_name(tmp_path: Path) -> None:
    voltage, _ = noisy(2, 0.1, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=0.0)
    nowhere = ["0", "1"], [np.nan, np.nan]
    # The last two name rows that are not in the table.
    for named, (labels, x_um) in (([2, 0], (["9", "7"], [30.0, 10.0])), ([3, 0], nowhere), ([-1, 0], nowhere)):
        with h5py.File(tmp_path / "a.nwb", "r+") as file:
            electrodes = file.require_group("general/extracellular_ephys/electrodes")
            for name, values in {"id": [7, 8, 9], "rel_x": [10.0, 20.0, 30.0], "rel_y": [0.0, 0.0, 0.0]}.items():
                electrodes.require_dataset(name, 3, type(values[0]))[:] = values
            file["acquisition/traces"].require_dataset("electrodes", 2, int)[:] = named
        channels = open_traces(tmp_path / "a.nwb")[0].channels
        assert channels.label.tolist() == labels
        np.testing.assert_array_equal(channels.x_um, x_um)


def test_traces_that_begin_before_0_keep_stimuli_to_their_end(tmp_path: Path) -> None:
    voltage, _ = noisy(2, 6.0, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=-1.0)
    write_stimuli(tmp_path / "a.nwb", [1.0, 4.9])
    recording = read_traces(tmp_path / "a.nwb", Detection())
    assert (recording.start_s, recording.duration_s) == (-1.0, 6.0)
    np.testing.assert_allclose(open_traces(tmp_path / "a.nwb")[0].read_uv(0, 9), voltage[:9], rtol=1e-5)
    assert recording.stimuli.time_s.tolist() == [1.0, 4.9]
    # A duration that rounds to before the last stimulus.
    write_nwb_traces(tmp_path / "b.nwb", voltage, start_s=-1.6805853027283018)
    write_stimuli(tmp_path / "b.nwb", [7.768889504673502])
    late = read_traces(tmp_path / "b.nwb", Detection())
    assert late.stimuli.time_s.tolist() == [7.768889504673502]
    (outside,) = [finding.message for finding in late.findings if finding.name == "stimuli-outside"]
    assert outside.startswith("1 of 1 stimuli are outside the traces, from -1.68059 to 4.31941 s")
    assert "stimuli-outside" not in {finding.name for finding in recording.findings}


def test_traces_far_from_0_make_a_recording_of_their_span(tmp_path: Path) -> None:
    voltage, truth = noisy(2, 1.0, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=3600.0)
    recording = read_traces(tmp_path / "a.nwb", Detection())
    assert (recording.start_s, recording.stop_s) == (3600.0, 3601.0)
    assert abs(len(recording.spike_times_s) - sum(map(len, truth))) <= 3
    write_nwb_traces(tmp_path / "b.nwb", voltage, start_s=-3600.0)
    before = read_traces(tmp_path / "b.nwb", Detection())
    assert (before.start_s, before.stop_s) == (-3600.0, -3599.0)
    # Without an electrodes table all channels are known all the same.
    assert "silent-channels-unknown" not in {finding.name for finding in recording.findings}


def test_a_channel_that_occurs_twice_is_read_from_its_first_column_with_its_conversion(tmp_path: Path) -> None:
    voltage, _ = noisy(3, 0.1, step_uv=1.0)
    write_nwb_traces(tmp_path / "a.nwb", voltage, start_s=0.0)
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        table = file.create_group("general/extracellular_ephys/electrodes")
        table["id"], table["rel_x"], table["rel_y"] = [7, 8, 9, 10], np.arange(4.0), np.zeros(4)
        file["acquisition/traces/electrodes"] = [2, 2, 0]
        file["acquisition/traces/channel_conversion"] = [2.0, 3.0, 5.0]
    traces, _ = open_traces(tmp_path / "a.nwb")
    assert traces.channels.label.tolist() == ["9", "7"]
    np.testing.assert_allclose(traces.read_uv(3, 9), voltage[3:9, [0, 2]] * np.array([2.0, 5.0]), rtol=1e-6)
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        del file["acquisition/traces/starting_time"].attrs["rate"]
    with pytest.raises(InvalidFile, match="expected timestamps of /acquisition/traces, or a rate in Hz"):
        open_traces(tmp_path / "a.nwb")


def test_more_than_half_of_the_channels_may_be_dead() -> None:
    voltage, _ = noisy(10, 3.0)
    voltage[:, 3:9] = np.random.default_rng(2).normal(0, 3, voltage[:, 3:9].shape)
    found = detect_spikes(RawTraces.from_array(voltage, channels(10), RATE_HZ, uv_per_step=0.1), np.empty(0))
    said = {finding.name: finding for finding in found.findings}
    assert said["dead-channels"].value == 6 and "noisy-channels" not in said
    assert said["noise"].value == pytest.approx(np.median(found.noise_uv[[0, 1, 2, 9]]))
    assert said["noise"].value > 5 * found.noise_uv[3:9].max() and "median of 4 channels" in said["noise"].message
    assert set(found.channel.tolist()) == {0, 1, 2, 9}


def test_traces_without_samples_are_refused() -> None:
    none = RawTraces.from_array(np.zeros((0, 2), np.int16), channels(2), RATE_HZ, uv_per_step=0.1)
    with pytest.raises(UnusableData, match="traces: expected samples, got none"):
        detect_spikes(none, np.empty(0))
