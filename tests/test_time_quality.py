"""Times that cannot be in seconds. Oracles: real and virtual cultures, whose own times must pass, in other units."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from animat.cli import main
from animat.cultures.virtual import VirtualCulture
from animat.errors import UnusableData
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.recordings.time_quality import frequency_findings
from animat.responses.extraction import extract_series
from animat.stimulation.protocol import Order, Protocol
from animat.stimulation.stimulus import Stimuli
from synthetic_recordings import synthetic_recording
from test_inspection import answering
from test_responses import recording as of_spikes

REAL = ("organoid_cartpole_maxone.npz", "brainoware_spikes.csv.gz")


def in_unit(source: Recording, spikes: float, stimuli: float | None = None) -> Recording:
    """The recording with spike and stimulus times in units of which `spikes` and `stimuli` make a second."""
    stimulus_s = source.stimuli.time_s * (spikes if stimuli is None else stimuli)
    spike_s = source.spike_times_s * spikes
    events = np.concatenate([spike_s, stimulus_s])
    return dataclasses.replace(
        source,
        spike_times_s=spike_s,
        stimuli=dataclasses.replace(source.stimuli, time_s=stimulus_s),
        start_s=float(events.min()),
        duration_s=float(np.ptp(events)) + 1,
    )


def without_frequencies(source: Recording) -> Recording:
    unknown = np.full(len(source.stimuli), np.nan)
    return dataclasses.replace(source, stimuli=dataclasses.replace(source.stimuli, frequency_hz=unknown))


def said(source: Recording) -> str | None:
    return next((f.message for f in recording_findings(source) if f.name == "times-not-in-seconds"), None)


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_are_in_seconds_and_named_in_other_units(name: str, real_data: Path) -> None:
    source = read_recording(real_data / name)
    assert said(source) is None
    assert "times are in milliseconds; divide them by 1,000" in str(said(in_unit(source, 1e3)))
    assert "times are in samples; divide them by the sampling rate" in str(said(in_unit(source, 20e3)))
    assert "times are in microseconds; divide them by 1,000,000" in str(said(in_unit(source, 1e6)))
    assert "times are in milliseconds" in str(said(in_unit(source, 1e3, 1)))
    assert "spikes and stimuli in different units" in str(said(in_unit(source, 1, 1e3)))


@pytest.mark.parametrize(
    "order", [None, *(pytest.param(order, marks=pytest.mark.oracle) for order in ("mixed", "blocked"))]
)
def test_simulated_cultures_are_in_seconds_and_named_in_other_units(order: Order | None) -> None:
    source = synthetic_recording(1)
    if order is not None:
        with VirtualCulture(seed=3) as culture:
            source = culture.record(Protocol(order=order, trials=20))
    assert said(source) is None and said(without_frequencies(source)) is None
    for factor, words in {
        1e3: "factor of 1,000: times are in milliseconds; divide them by 1,000",
        20e3: "times are in samples at 20,000 Hz; divide them by that",
        1 / 60: "times are in minutes; multiply them by 60",
    }.items():
        assert words in str(said(in_unit(source, factor)))
        assert words in str(said(in_unit(source, 1, factor)))
    assert "times are in milliseconds" in str(said(without_frequencies(in_unit(source, 1e3))))


@settings(max_examples=30, deadline=None)
@given(interval_s=st.floats(0.2, 600), frequencies=st.sampled_from([(5, 20), (5, 10, 20, 40, 80), (1, 100)]))
def test_trains_presented_at_a_constant_interval_are_in_seconds(
    interval_s: float, frequencies: tuple[float, ...]
) -> None:
    # One row a train: the frequency is of the pulses within, and says nothing of the time to the next.
    stimulus_s = interval_s * np.arange(40)
    spikes = [(t + 0.005, 0) for t in stimulus_s]
    frequency_hz = np.resize(frequencies, 40).astype(float)
    assert said(of_spikes(spikes, stimulus_s, 4, interval_s * 41, frequency_hz=frequency_hz)) is None


@settings(max_examples=30, deadline=None)
@given(frequencies=st.lists(st.floats(1, 100), min_size=2, max_size=6), pulses=st.sampled_from([35, 50, 100, 300]))
def test_consecutive_trains_with_one_row_each_are_never_refused(frequencies: list[float], pulses: int) -> None:
    # The next train begins where the last one ends: intervals of pulses / f.
    frequency_hz = np.resize(frequencies, 60)
    stimulus_s = 1 + np.cumsum([0.0, *(pulses / frequency_hz[:-1])])
    spikes = [(t + 0.005, 0) for t in stimulus_s]
    source = of_spikes(spikes, stimulus_s, 4, stimulus_s[-1] + 60, frequency_hz=frequency_hz)
    assert {f.severity for f in recording_findings(source) if f.name == "times-not-in-seconds"} <= {"warning"}


def test_consecutive_trains_cause_a_warning() -> None:
    frequency_hz = np.resize([5.0, 10.0, 20.0, 40.0], 60)
    stimulus_s = 1 + np.cumsum([0.0, *(100 / frequency_hz[:-1])])
    source = of_spikes([(1.005, 0)], stimulus_s, 4, stimulus_s[-1] + 60, frequency_hz=frequency_hz)
    assert "factor of 100: are they in another unit, or is each a train of pulses?" in str(said(source))


def test_similar_frequencies_do_not_prove_a_wrong_unit_of_a_constant_interval() -> None:
    stimulus_s = 10.0 * np.arange(1, 61)
    frequency_hz = np.resize([10.0, 10.2, 10.4], 60)
    assert said(of_spikes([(10.005, 0)], stimulus_s, 4, 620.0, frequency_hz=frequency_hz)) is None


def test_a_quiet_culture_that_responds_is_in_seconds_however_long_the_recording() -> None:
    # 40 channels, 12 h, a stimulus a minute that a third of the channels answer with two spikes.
    rng = np.random.default_rng(0)
    stimulus_s = 60.0 * np.arange(1, 720)
    answers = [(t + rng.uniform(0.003, 0.02), c) for t in stimulus_s for c in rng.choice(40, 13) for _ in range(2)]
    assert said(of_spikes(answers, stimulus_s, 40, 12 * 3600.0)) is None


@pytest.mark.parametrize("sampling_rate_hz", [float("nan"), 20_000.0])
@pytest.mark.parametrize(
    ("per_s", "rate_hz", "unit"),
    [(1e3, 2.0, "milliseconds"), (1e3, 0.7, "milliseconds"), (20e3, 2.0, "samples"), (1e6, 2.0, "microseconds")],
)
def test_the_likeliest_unit_of_sorted_units_is_listed_first_with_perhaps(
    per_s: float, rate_hz: float, unit: str, sampling_rate_hz: float
) -> None:
    # 60 units that are refractory for 3 ms, and a stimulus a second.
    rng = np.random.default_rng(0)
    spikes = [(t, c) for c in range(60) for t in np.cumsum(0.003 + rng.exponential(1 / rate_hz - 0.003, 1000))]
    source = of_spikes(spikes, np.arange(1.0, 300.0), 60, 4000 / rate_hz)
    assert said(source) is None
    message = str(said(dataclasses.replace(in_unit(source, per_s), sampling_rate_hz=sampling_rate_hz)))
    assert f"times are in {unit}; divide" in message
    # Milliseconds at 2 Hz are as well samples at 40 Hz.
    assert ("perhaps" in message) == (", or in " in message) == (per_s == 1e3)


def test_channels_that_fire_faster_than_neurons_can() -> None:
    rng = np.random.default_rng(0)
    spikes = [(t, c) for c in range(3) for t in rng.uniform(0, 2, 1000)]
    assert "the median channel fires at 500 Hz" in str(said(of_spikes(spikes, [1.0], 3, 2.0)))


def test_recordings_of_two_simulated_cultures_are_not_one_series(tmp_path: Path) -> None:
    one, other = (synthetic_recording(seed, patterns=20, channels=32, start_min=10.0 * seed) for seed in (1, 2))
    with pytest.raises(
        UnusableData, match=r"got synthetic culture 1 .* and synthetic culture 2 .* --allow several-cultures"
    ):
        extract_series([one, other])
    assert len(extract_series([one, other], allow=["several-cultures"])) == 2


def test_training_on_milliseconds_is_refused_unless_allowed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_nwb(in_unit(synthetic_recording(1, patterns=20, channels=32), 1e3), tmp_path / "a.nwb")
    train = ["train", "cartpole", "--recordings", str(tmp_path / "a.nwb"), "--policies", "1", "--iterations", "64"]
    train += ["--out", str(tmp_path / "policies")]
    assert main(train) == 1
    line = capsys.readouterr().err.strip()
    assert "\n" not in line and "milliseconds; divide them by 1,000" in line and "--allow times-not-in-seconds" in line
    assert not (tmp_path / "policies").exists()
    allowed = ["times-not-in-seconds", "dead-window", "empty-condition"]
    assert len(extract_series([read_recording(tmp_path / "a.nwb")], allow=allowed)) == 1


def test_more_stimuli_than_spikes_and_simultaneous_stimuli_are_reported() -> None:
    source = answering({5.0: 3.0, 80.0: 6.0})
    assert not {"more-stimuli-than-spikes", "simultaneous-stimuli"} & {f.name for f in recording_findings(source)}
    few, many = source.stimuli.time_s[:20], np.linspace(0.1, source.duration_s, 200)
    swapped = of_spikes([(t, 0) for t in few], many, 1, source.duration_s)
    names = {f.name: f for f in recording_findings(swapped)}
    assert names["more-stimuli-than-spikes"].severity == "refuse"
    assert "are spikes and stimuli swapped?" in names["more-stimuli-than-spikes"].message
    # One unit, of which 70 % of the stimuli have one spike.
    sparse = of_spikes([(t + 0.005, 0) for t in many[:140]], many, 1, source.duration_s + 1)
    assert {f.severity for f in recording_findings(sparse) if f.name == "more-stimuli-than-spikes"} == {"note"}
    twice = np.repeat(source.stimuli.time_s, 2)
    spikes = list(zip(source.spike_times_s.tolist(), source.spike_channels.tolist(), strict=True))
    names = {f.name: f for f in recording_findings(of_spikes(spikes, twice, 40, source.duration_s))}
    assert names["simultaneous-stimuli"].message.startswith("120 of 240 stimuli")
    assert names["simultaneous-stimuli"].severity == "refuse"
    # Rows that belong to one presentation are read once.
    one = of_spikes(spikes, twice, 40, source.duration_s, presentation=np.repeat(np.arange(120), 2).tolist())
    assert "simultaneous-stimuli" not in {f.name for f in recording_findings(one)}


def contradicted(stated_hz: np.ndarray) -> str | None:
    source = synthetic_recording(1, start_min=0.0, patterns=25, channels=16)
    stimuli = dataclasses.replace(source.stimuli, frequency_hz=stated_hz[: len(source.stimuli)])
    found = recording_findings(dataclasses.replace(source, stimuli=stimuli))
    return next((f.message for f in found if f.name == "other-frequencies"), None)


def test_frequencies_that_contradict_the_times_cause_a_warning() -> None:
    true_hz = synthetic_recording(1, start_min=0.0, patterns=25, channels=16).stimuli.frequency_hz
    assert contradicted(true_hz) is None
    swapped = np.select([true_hz == 5, true_hz == 80], [80.0, 5.0], true_hz)
    assert "with a stated frequency of 5 Hz are 0.0125 s apart (median), not 0.2 s" in str(contradicted(swapped))
    # Periods in place of frequencies.
    periods_s = str(contradicted(1 / true_hz))
    assert periods_s.endswith(": these are periods in seconds: write 1 divided by each, here 80")
    # Mixed frequencies, where only the interval before a pulse is that of its frequency.
    mixed_s = 1 / np.random.default_rng(0).choice([5.0, 10.0, 20.0, 40.0], len(true_hz))
    stimuli = synthetic_recording(1, start_min=0.0, patterns=25, channels=16).stimuli
    (mixed,) = frequency_findings(dataclasses.replace(stimuli, time_s=np.cumsum(mixed_s), frequency_hz=mixed_s))
    assert mixed.message.endswith(": these are periods in seconds: write 1 divided by each, here 40")
    # Periods in milliseconds, of which the first way of counting finds no fault.
    mixed_hz = np.random.default_rng(0).choice([5.0, 10.0, 20.0, 40.0], len(true_hz))
    stimuli = dataclasses.replace(stimuli, time_s=np.cumsum(1 / mixed_hz), frequency_hz=1000 / mixed_hz)
    (mixed,) = frequency_findings(stimuli)
    assert mixed.message.endswith(": these are periods in milliseconds: write 1,000 divided by each, here 40")
    assert not list(frequency_findings(dataclasses.replace(stimuli, frequency_hz=mixed_hz)))
    # Pauses between stimuli are none of a frequency's business.
    assert contradicted(np.full(len(true_hz), 80.0)) is None


def test_frequencies_stated_in_only_one_of_two_simultaneous_rows_can_be_compared_with_the_times() -> None:
    # 5 and 30 Hz are stated, but stimuli come 0.1 and 0.02 s apart.
    time_s = np.repeat(np.cumsum(np.repeat([0.1, 0.02], 30)), 2)
    stated_hz = np.stack([np.repeat([5.0, 30.0], 30), np.full(60, np.nan)], axis=1)
    for columns in ([0, 1], [1, 0]):
        stimuli = Stimuli(time_s, stated_hz[:, columns].ravel(), np.zeros(120), np.zeros((120, 1)), np.arange(120))
        (found,) = frequency_findings(stimuli)
        assert "with a stated frequency of 5 Hz are 0.1 s apart (median), not 0.2 s: correct the" in found.message
