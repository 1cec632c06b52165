"""Quality in words: recordings made with one fault each, and real ones with theirs. Oracle: the fault that was made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from animat.recordings.findings import Finding
from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.responses.condition import Condition
from animat.responses.extraction import extract_responses, extract_series
from animat.responses.inspection import inspect_recording
from animat.responses.quality import drift
from animat.responses.quality.drift import drift_findings
from animat.responses.quality.responses import _difference
from animat.responses.responses import Responses
from animat.stimulation.protocol import Order, Presentation
from synthetic_recordings import SyntheticCulture
from test_inspection import answering
from test_responses import recording


def with_spikes(source: Recording, spikes: np.ndarray) -> Recording:
    """The same recording with these spikes (time, channel)."""
    return recording(
        spikes,
        source.stimuli.time_s,
        len(source.channels),
        source.duration_s,
        frequency_hz=source.stimuli.frequency_hz,
    )


def spikes_of(source: Recording) -> np.ndarray:
    return np.column_stack([source.spike_times_s, source.spike_channels])


def since_ms(source: Recording, time_s: np.ndarray) -> np.ndarray:
    """Time from the nearest stimulus, negative before it."""
    stimuli = source.stimuli.time_s
    after = np.clip(np.searchsorted(stimuli, time_s), 1, len(stimuli) - 1)
    before = time_s - stimuli[after - 1]
    return 1e3 * np.where(before < stimuli[after] - time_s, before, time_s - stimuli[after])


def findings(source: Recording, **options: object) -> dict[str, Finding]:
    return {f.name: f for f in extract_responses(source, **options).findings}  # type: ignore[arg-type]


@pytest.mark.parametrize(("until_ms", "severity"), [(1.5, "note"), (3.5, "warning")])
def test_an_artefact_counted_as_spikes(until_ms: float, severity: str) -> None:
    source = answering({5: 10.0, 10: 30.0})
    rng = np.random.default_rng(1)
    artefact = [(t + rng.uniform(0, until_ms) * 1e-3, c % 40) for t in source.stimuli.time_s for c in range(60)]
    found = findings(with_spikes(source, np.vstack([spikes_of(source), artefact])))["artefact-spikes"]
    assert found.severity == severity
    assert found.value == pytest.approx(60, rel=0.05)
    assert f"from 0 to {until_ms:g} ms there are 6" in found.message
    assert ("begin it at 3.5 ms or later" in found.message) == (until_ms > 2)


def test_a_strong_response_is_no_artefact() -> None:
    assert "artefact-spikes" not in findings(answering({5: 60.0, 10: 90.0}))
    assert "artefact-spikes" not in findings(SyntheticCulture(seed=2).record(0.0))


@pytest.mark.parametrize("peak_ms", [2.6, 3.0, 4.0])
def test_an_early_and_sharp_response_is_no_artefact_and_hides_none(peak_ms: float) -> None:
    source = answering({5: 0.0, 10: 0.0})
    rng = np.random.default_rng(2)
    response = [(t + 1e-3 * rng.normal(peak_ms, 0.6), c % 40) for t in source.stimuli.time_s for c in range(20)]
    assert "artefact-spikes" not in findings(with_spikes(source, np.array(response)))
    # A pulse counted as a spike on some channels, before it, is one still.
    artefact = [(t + 1e-3 * rng.uniform(0, 0.5), c) for t in source.stimuli.time_s for c in range(5)]
    found = findings(with_spikes(source, np.vstack([response, artefact])))["artefact-spikes"]
    assert found.severity == "note"
    assert "from 0 to 0.5 ms there are 5" in found.message


@pytest.mark.parametrize("hit", [1, 2])
def test_a_burst_that_falls_on_a_stimulus_is_no_artefact(hit: int) -> None:
    source = answering({5: 10.0, 10: 30.0}, n=15)
    rng = np.random.default_rng(3)
    burst = [
        (t + 1e-3 * rng.uniform(-1, 2.4), c) for t in source.stimuli.time_s[:hit] for c in range(40) for _ in range(9)
    ]
    assert "artefact-spikes" not in findings(with_spikes(source, np.vstack([spikes_of(source), burst])))


@pytest.mark.parametrize(("until_ms", "severity"), [(2.0, "note"), (3.0, "note"), (6.0, "warning")])
def test_a_blanked_stretch_is_distinguished_from_a_quiet_culture(until_ms: float, severity: str) -> None:
    source = answering({5: 30.0, 10: 60.0}, n=150)
    spikes = spikes_of(source)
    since = since_ms(source, spikes[:, 0])
    found = findings(with_spikes(source, spikes[(since < -3) | (since > until_ms)]))["blanked-window"]
    assert found.severity == severity
    assert f"from -3 to {until_ms:g} ms around a stimulus next to nothing" in found.message
    assert found.value == pytest.approx(max(until_ms - 2, 0) / 8, abs=0.08)
    assert "blanked-window" not in findings(source)


def test_a_condition_with_a_dead_window_is_reported_though_the_others_respond() -> None:
    rng = np.random.default_rng(7)
    stimulus_s = 0.5 + 0.5 * np.arange(200)
    frequency_hz = np.tile([5.0, 10.0], 100)
    # 250 Hz on all channels together at any time, so 2 spikes in 8 ms: half as many after 5 Hz, more after 10 Hz.
    spikes = [(t, int(rng.integers(20))) for t in np.sort(rng.uniform(0, 101, 25_250))]
    since = [(t - stimulus_s[max(np.searchsorted(stimulus_s, t) - 1, 0)]) for t, _ in spikes]
    low = frequency_hz[np.clip(np.searchsorted(stimulus_s, [t for t, _ in spikes]) - 1, 0, 199)] == 5.0
    kept = [s for s, d, is_low in zip(spikes, since, low, strict=True) if not (is_low and 0 < d < 0.02 and s[1] % 2)]
    kept += [(t + rng.uniform(0.03, 0.08), int(rng.integers(20))) for t in stimulus_s[::2] for _ in range(60)]
    kept += [(t + rng.uniform(0.002, 0.01), int(rng.integers(20))) for t in stimulus_s[1::2] for _ in range(10)]
    found = findings(recording(kept, stimulus_s, 20, 101.0, frequency_hz=frequency_hz))
    assert "dead-window" not in found
    assert found["dead-condition"].severity == "warning"
    assert "5 Hz (" in found["dead-condition"].message
    assert "10 Hz (" not in found["dead-condition"].message
    assert found["dead-condition"].value == pytest.approx(0.9, abs=0.2)
    assert "its response is at 30 to 80 ms" in found["dead-condition"].message


def drifting(change: float, blocked: bool, seed: int = 0) -> Recording:
    """Responses that change by a share from start to end; conditions mixed or one after the other."""
    rng = np.random.default_rng(seed)
    frequencies = np.repeat([5.0, 10.0], 200)
    if not blocked:
        rng.shuffle(frequencies)
    stimulus_s = 1 + 0.25 * np.arange(400)
    mean = np.where(frequencies == 5, 10.0, 30.0) * (1 + change * np.linspace(-0.5, 0.5, 400))
    spikes = [(t + rng.uniform(0.003, 0.009), int(rng.integers(40))) for t, m in zip(stimulus_s, mean, strict=True)
              for _ in range(rng.poisson(m))]  # fmt: skip
    return recording(spikes, stimulus_s, 40, 102.0, frequency_hz=frequencies)


@pytest.mark.parametrize("blocked", [False, True])
@pytest.mark.parametrize("change", [-0.6, 0.6])
def test_drift_within_a_recording(change: float, blocked: bool) -> None:
    found = findings(drifting(change, blocked), burst_threshold=1.0)["drift"]
    assert found.severity == "warning"
    # Over the time that a condition is presented for: in blocks of two, half of the recording.
    assert found.value == pytest.approx(change / 2 if blocked else change, abs=0.15)
    assert ("responses rise by" in found.message) == (change > 0)


@pytest.mark.parametrize("order", ["blocked", "mixed"])
def test_conditions_that_are_mixed_are_not_to_be_mixed(order: Order) -> None:
    presented = replace(drifting(0.6, order == "blocked"), presentation=Presentation(order, 1))
    found = findings(presented, burst_threshold=1.0)["drift"]
    assert ("present conditions mixed" in found.message) == (order == "blocked")


@pytest.mark.parametrize("seed", range(5))
def test_conditions_that_differ_one_after_the_other_are_no_drift(seed: int) -> None:
    assert "drift" not in findings(drifting(0.0, True, seed), burst_threshold=1.0)


@pytest.mark.parametrize("of_each", [3, 20])
def test_the_error_of_a_drift_is_that_of_least_squares_with_a_mean_per_condition(
    of_each: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(of_each)
    condition, n = rng.permutation(np.repeat(np.arange(30), of_each)), 30 * of_each
    rate_hz = rng.normal(10, 2, n) + np.linspace(0, 2, n)
    of = [np.flatnonzero(condition == c) for c in range(30)]
    conditions = tuple(Condition(str(c), float(c)) for c in range(30))
    never, no_ratio = np.zeros(n, np.bool_), np.zeros(n)
    responses = Responses(condition, rate_hz, no_ratio, never, conditions, (2.0, 10.0), 64, 1.0, 0.0)
    x, t, means = np.empty(n), np.empty(n), np.zeros((n, 30))
    for c, rows in enumerate(of):
        x[rows], t[rows], means[rows, c] = rate_hz[rows] / rate_hz[rows].mean(), rows / np.ptp(rows), 1.0
    design = np.column_stack([t, means])
    (slope, *_), (squares,), rank, _ = np.linalg.lstsq(design, x, rcond=None)
    error = np.sqrt(squares / (n - rank) * np.linalg.inv(design.T @ design)[0, 0])
    monkeypatch.setattr(drift, "CERTAIN", slope / error * 0.9999)
    (found,) = drift_findings(responses)
    assert found.value == pytest.approx(slope)
    monkeypatch.setattr(drift, "CERTAIN", slope / error * 1.0001)
    assert not list(drift_findings(responses))


def test_bursts_have_no_part_in_a_drift() -> None:
    plain = extract_responses(drifting(0.0, False), burst_threshold=1.0)
    bursts = np.zeros(len(plain), np.bool_)
    bursts[-40:] = True
    raised = np.where(bursts, 500.0, plain.rate_hz)
    assert not list(drift_findings(replace(plain, rate_hz=raised, is_burst=bursts)))
    assert list(drift_findings(replace(plain, rate_hz=raised)))


def test_channels_that_fire_as_no_neurons_do() -> None:
    rng = np.random.default_rng(0)
    usual = np.column_stack([rng.uniform(0, 10, 400), rng.integers(0, 30, 400)])
    hum = np.column_stack([np.arange(0, 10, 0.008), np.full(1250, 39)])
    found = {f.name: f for f in recording_findings(recording(np.vstack([usual, hum]), [1, 2], 40, 10.0))}
    assert (found["noisy-channels"].severity, found["noisy-channels"].value) == ("warning", 1)
    assert "that fire as no neuron does: 1 of 40 (39), with 76 % of all spikes" in found["noisy-channels"].message
    assert (found["silent-channels"].severity, found["silent-channels"].value) == ("note", 9)
    found = {f.name: f for f in recording_findings(recording(usual[:20], [1], 40, 10.0))}
    assert found["silent-channels"].severity == "warning"
    assert "noisy-channels" not in found


def test_channels_that_stop() -> None:
    rng = np.random.default_rng(0)
    channel, time_s = np.repeat(np.arange(30), 100), rng.uniform(100, 500, 3000)

    def found(is_kept: np.ndarray) -> dict[str, Finding]:
        rows = np.column_stack([time_s[is_kept] - 100, channel[is_kept]])
        return {f.name: f for f in recording_findings(recording(rows, [1, 2], 40, 400.0))}

    assert "stopped-channels" not in found(np.ones(3000, np.bool_))
    one = found((channel != 7) | (time_s < 350))["stopped-channels"]
    assert (one.severity, one.value) == ("note", 1)
    assert "channels that fire steadily and then stop, at about 260 s: 1 of 40 (7);" in one.message
    several = found((channel > 3) | (time_s < 320 + 10 * channel))["stopped-channels"]
    assert (several.severity, several.value) == ("warning", 4)
    assert "and then stop, between 220 s and 260 s: 4 of 40 (0, 1, 2, 3);" in several.message
    # What warns of a recording is with its responses too, for those who never inspect it; notes are not.
    rows = np.column_stack([time_s - 100, channel])[(channel > 3) | (time_s < 320)]
    (responses,) = extract_series([recording(rows, [1, 2], 40, 400.0)], allow=["dead-window"])
    names = [finding.name for finding in responses.findings]
    assert names.count("stopped-channels") == 1 and "silent-channels" not in names
    # Silent at the beginning, or for less than a quarter of the recording, or most of the time.
    for is_kept in (time_s > 250, time_s < 419, time_s < 170):
        assert "stopped-channels" not in found((channel != 7) | is_kept)


@pytest.mark.oracle
@given(st.integers(0, 2**32 - 1))
def test_channels_of_any_rate_hardly_ever_stop_by_chance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_spikes = rng.poisson(10 ** rng.uniform(0, 3, 1000))
    channel = np.repeat(np.arange(1000), n_spikes)
    found = recording_findings(
        recording(np.column_stack([rng.uniform(0, 300, len(channel)), channel]), [1], 1000, 300.0)
    )
    assert all(f.severity == "note" and f.value <= 3 for f in found if f.name == "stopped-channels")


def test_the_organoid_on_a_maxone_can_be_used_with_care(real_data: Path) -> None:
    inspection = inspect_recording(read_recording(real_data / "organoid_cartpole_maxone.npz"))
    found = {f.name: f for f in inspection.findings}
    assert inspection.verdict == "usable with care"
    assert found["blanked-window"].severity == "note"
    assert "to 3 ms around a stimulus next to nothing was recorded" in found["blanked-window"].message
    assert "artefact-spikes" not in found


def test_brainoware_cannot_be_used_in_the_papers_window(real_data: Path) -> None:
    inspection = inspect_recording(read_recording(real_data / "brainoware_spikes.csv.gz"))
    found = {f.name: f for f in inspection.findings}
    assert inspection.verdict == "not usable"
    assert found["dead-window"].severity == "refuse"
    assert "an artefact counted as spikes" in found["artefact-spikes"].message
    assert "stopped-channels" not in found
    assert found["artefact-spikes"].severity == "warning"


def test_an_artefact_is_compared_with_as_much_time_as_it_takes() -> None:
    # A spike in each half millisecond, and around 50 stimuli 39 more in one of them and 29 more in three others.
    every_s = (np.arange(2 * 60_000) + 0.5) * 0.5e-3
    stimulus_s = np.arange(5.0, 55.0)
    more_s = [
        t + 1e-3 * ms
        for t in stimulus_s
        for ms, n in ((-0.75, 29), (-0.25, 39), (0.25, 29), (0.75, 29))
        for _ in range(n)
    ]
    spikes = [(t, 0) for t in [*every_s, *more_s]]
    finding = findings(recording(spikes, stimulus_s, 4, 60.0))["artefact-spikes"]
    assert finding.message.startswith("from -1 to 1 ms there are 130.0 spikes per stimulus, 32.5 times as many")


def test_an_artefact_s_share_of_all_spikes_counts_every_pulse() -> None:
    """Trains of ten pulses, which are too close to each other to find the artefact by them, have it too."""
    stimulus_s = np.concatenate([np.arange(1.0, 31.0), *(31 + t + 0.0125 * np.arange(10) for t in range(10))])
    background = [(t, int(1000 * t) % 40) for t in np.random.default_rng(1).uniform(0, 42, 8400)]
    artefact = [(t + 0.25e-3, channel) for t in stimulus_s for channel in range(40)]
    finding = findings(recording(background + artefact, stimulus_s, 40, 42.0))["artefact-spikes"]
    assert finding.message.startswith("from 0 to 0.5 ms there are 40.1 spikes per stimulus")
    # 130 pulses with 40 spikes each, and 13 of the 8,400 besides.
    assert "(38.3 % of all)" in finding.message


@pytest.mark.parametrize(
    ("offset_s", "kind", "is_coarse"),
    [(0.0, np.float64, False), (0.0, np.float32, False), (1e5, np.float32, True), (1.7e9, np.float64, False)],
)
def test_times_too_coarse_for_the_window_are_said(offset_s: float, kind: type, is_coarse: bool) -> None:
    rng = np.random.default_rng(0)
    stimulus_s = np.arange(1.0, 300.0)
    times_s = (offset_s + np.sort(rng.uniform(0, 300, 20_000))).astype(kind).astype(float)
    # The step of single precision at 100,000 s is 2^-7 s.
    source = recording([(0.5, 0)], offset_s + stimulus_s, 4, offset_s + 301)
    spikes = replace(source, spike_times_s=times_s, spike_channels=rng.integers(4, size=len(times_s)))
    found = findings(spikes)
    assert ("coarse-times" in found) == is_coarse
    if is_coarse:
        assert found["coarse-times"].value == pytest.approx(1e3 * 2**-7)
        assert "in steps of 7.81 ms, too coarse for a window of 8 ms" in found["coarse-times"].message


@pytest.mark.parametrize(("decimals", "is_coarse"), [(4, False), (3, False), (2, True)])
def test_times_with_few_decimals_are_coarse(decimals: int, is_coarse: bool) -> None:
    source = answering({5.0: 20.0, 80.0: 40.0})
    rounded = replace(source, spike_times_s=np.round(source.spike_times_s, decimals))
    assert len(rounded.spike_times_s) > 1000
    assert ("coarse-times" in findings(rounded)) == is_coarse


@pytest.mark.parametrize(("decimals", "is_coarse"), [(4, False), (3, False), (2, True)])
def test_rounded_stimulus_times_are_coarse_where_their_frequencies_show_it(decimals: int, is_coarse: bool) -> None:
    rng = np.random.default_rng(1)
    frequency_hz = rng.permutation(np.repeat([5.0, 80.0], 200))
    time_s = np.round(1 + np.cumsum(1 / frequency_hz), decimals)
    source = recording([(t, 0) for t in rng.uniform(0, 45, 2000)], time_s, 4, 46.0, frequency_hz=frequency_hz)
    found = findings(source)
    assert ("coarse-times" in found) == is_coarse
    if is_coarse:
        assert "steps of 10 ms, although those at 80 Hz are 12.5 ms apart" in found["coarse-times"].message
    # Trains that are presented every second, or only at 5 Hz, do come in steps.
    for hz, interval_s in ((80.0, 1.0), (5.0, 0.2)):
        time_s, spikes = 1 + interval_s * np.arange(40), [(t, 0) for t in rng.uniform(0, 45, 2000)]
        regular = recording(spikes, time_s, 4, 46.0, frequency_hz=np.full(40, hz))
        assert "coarse-times" not in findings(regular)


@pytest.mark.parametrize("stated", ["blocked", "mixed"])
@pytest.mark.parametrize("order", ["blocked", "mixed"])
def test_an_order_that_the_frequencies_contradict_causes_a_warning(stated: Order, order: Order) -> None:
    frequency_hz = np.repeat([5.0, 10.0, 20.0], 40)
    if order == "mixed":
        frequency_hz = np.random.default_rng(1).permutation(frequency_hz)
    source = recording([(1.0, 0)] * 200, 1 + np.cumsum(1 / frequency_hz), 4, 20.0, frequency_hz=frequency_hz)
    found = {f.name for f in recording_findings(replace(source, presentation=Presentation(stated)))}
    assert ("other-order" in found) == (stated != order)


@pytest.mark.parametrize(("rate_hz", "is_wrong"), [(20_000.0, False), (20.0, True), (float("nan"), False)])
def test_a_sampling_rate_in_khz_causes_a_warning(rate_hz: float, is_wrong: bool) -> None:
    source = recording([(0.1 * t, 0) for t in range(1, 200)], np.arange(1.0, 19.0), 4, 30.0)
    found = {f.name for f in recording_findings(replace(source, sampling_rate_hz=rate_hz))}
    assert ("sampling-rate" in found) == is_wrong


@pytest.mark.parametrize(("unit", "is_wrong"), [(1.0, False), (1e-3, True), (1e3, True), (0.0, True)])
def test_positions_in_another_unit_cause_a_warning(unit: float, is_wrong: bool) -> None:
    source = recording([(t, c) for t in range(1, 20) for c in range(16)], np.arange(1.0, 19.0), 16, 30.0)
    x_um, y_um = np.divmod(np.arange(16), 4)
    rng_line = np.random.default_rng(1).normal(size=16)
    channels = replace(source.channels, x_um=unit * 100.0 * x_um, y_um=unit * 100.0 * y_um)
    # A linear probe, turned by a right angle.
    line = replace(source.channels, x_um=1e-14 * rng_line, y_um=unit * 100.0 * np.arange(16))
    for table in (channels, line):
        found = {each.name for each in recording_findings(replace(source, channels=table))}
        assert ("positions-not-in-um" in found) == is_wrong
    # Sixteen units of one electrode.
    of_one = replace(source.channels, electrode=np.zeros(16, np.int64), x_um=np.zeros(16), y_um=np.zeros(16))
    assert "positions-not-in-um" not in {f.name for f in recording_findings(replace(source, channels=of_one))}


def test_a_single_unit_that_is_refractory_has_no_coarse_times() -> None:
    rng = np.random.default_rng(0)
    times_s = np.cumsum(0.004 + rng.exponential(0.2, 2000))
    source = recording([(t, 0) for t in times_s], np.arange(1.0, 300.0), 4, 500.0)
    assert "coarse-times" not in findings(source)


def test_a_median_that_is_the_smallest_response_is_named_as_such() -> None:
    rng = np.random.default_rng(0)
    condition = np.repeat(np.arange(2), 200)
    rate_hz = np.where(rng.random(400) < np.where(condition == 0, 0.2, 0.45), 30.0, 0.0)
    never, conditions = np.zeros(400, np.bool_), (Condition("5 Hz", 5.0, "Hz"), Condition("80 Hz", 80.0, "Hz"))
    responses = Responses(condition, rate_hz, np.zeros(400), never, conditions, (2.0, 10.0), 4, 1.0, 0.0)
    (found,) = _difference(responses)
    assert (found.name, found.severity) == ("no-difference", "warning")
    assert "more than half of the responses are the smallest, 0 Hz, so all conditions pass P50" in found.message
