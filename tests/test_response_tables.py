"""Response tables without spikes. Oracles: recordings with the same counts, hand-written files, a real table."""

from __future__ import annotations

import gzip
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from animat.cli import main
from animat.errors import AnimatError, InvalidFile, Mismatch
from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording, read_source, read_sources
from animat.recordings.recording import Recording, ResponseTable
from animat.report.inspection import inspection_text
from animat.responses.conditions import ByInterval, ByPattern, Conditions
from animat.responses.extraction import extract_responses
from animat.responses.inspection import inspect_recording
from animat.responses.windows import spikes_in
from synthetic_recordings import synthetic_recording
from test_responses import recording as of_spikes


def counts_of(recording: Recording, window_ms: tuple[float, float]) -> np.ndarray:
    """Spikes of each channel in the window of each stimulus, counted one by one."""
    counts = np.zeros((len(recording.stimuli), len(recording.channels)), np.int64)
    after_s = recording.stimuli.time_s
    rows, spikes = spikes_in(recording, after_s + window_ms[0] * 1e-3, after_s + window_ms[1] * 1e-3)
    np.add.at(counts, (rows, recording.spike_channels[spikes]), 1)
    return counts


def table_of(path: Path) -> ResponseTable:
    table = read_source(path)
    assert isinstance(table, ResponseTable)
    return table


@pytest.mark.parametrize("kind", ["count", "rate_hz"])
@pytest.mark.parametrize("form", ["npz", "wide", "long"])
def test_a_table_has_the_responses_of_the_recording_that_it_was_counted_in(
    form: str, kind: str, tmp_path: Path
) -> None:
    window_ms = (3.0, 9.0)
    recording = synthetic_recording(3, patterns=8, channels=24)
    # In any order of the file, times as text included.
    order = np.random.default_rng(1).permutation(len(recording.stimuli))
    values = counts_of(recording, window_ms)[order] / (1.0 if kind == "count" else 0.006)
    time_s, frequency_hz = recording.stimuli.time_s[order], recording.stimuli.frequency_hz[order]
    if form == "npz":
        path = tmp_path / "a.npz"
        named = {"stimulus_time_s": time_s, "stimulus_frequency_hz": frequency_hz}
        np.savez(path, **{f"response_{kind}": values}, **named, response_window_ms=window_ms, start_min=20)
    else:
        path = tmp_path / "a_responses.csv"
        lines = []
        for t, f, row in zip(time_s.tolist(), frequency_hz.tolist(), values.tolist(), strict=True):
            if form == "wide":
                lines.append(",".join(map(repr, [t, f, 3.0, 9.0, 20.0, *row])))
            else:
                lines += [f"{t!r},{f!r},3,9,20,{c},{value!r}" for c, value in enumerate(row) if value or c == 5]
        channels = [f"{kind}_{c}" for c in range(24)] if form == "wide" else ["channel", kind]
        header = ["time_s", "Frequency (Hz)", "window_start_ms", "window_end_ms", "start_min", *channels]
        path.write_text("\n".join([",".join(header), *lines]) + "\n")
    table = table_of(path)
    ours, theirs = extract_responses(table), extract_responses(recording, window_ms=window_ms)
    # The recording ends with its last event, so that its last window may be cut off.
    n = len(theirs)
    assert len(ours) - n in (0, 1)
    np.testing.assert_allclose(ours.rate_hz[:n], theirs.rate_hz, rtol=1e-12)
    np.testing.assert_array_equal(ours.active_ratio[:n], theirs.active_ratio)
    np.testing.assert_array_equal(ours.condition[:n], theirs.condition)
    np.testing.assert_array_equal(ours.last_hz[1:n] == 0, theirs.last_hz[1:] == 0)
    by_times = [
        extract_responses(source, ByInterval((10.0, 40.0)), window_ms).condition for source in (table, recording)
    ]
    assert set(by_times[1].tolist()) == {0, 1}
    np.testing.assert_array_equal(by_times[0][: len(by_times[1])], by_times[1])
    assert (ours.by, ours.burst_threshold) == (theirs.by, theirs.burst_threshold)
    assert [c.label for c in ours.conditions] == [c.label for c in theirs.conditions]
    assert (ours.window_ms, ours.start_min, ours.n_channels) == (window_ms, 20.0, 24)
    names = {f.name: f.severity for f in ours.findings}
    assert names["spike-times-unknown"] == "warning"
    n_missing = np.count_nonzero(np.delete(values, 5, axis=1) == 0) if form == "long" else 0
    assert sum(f.value or 0 for f in table.findings if f.name == "pairs-missing") == n_missing
    assert not {"dead-window", "response-time", "artefact-spikes", "window-assumed"} & set(names)


def test_bursts_of_a_table_are_those_of_its_recording_where_few_ratios_occur() -> None:
    # 45 responses of 10 channels in 100, and 5 of 30: the ratios are 20 channels apart, not one.
    stimulus_s = np.arange(1.0, 51.0)
    active = np.where(np.arange(50) % 10 == 9, 30, 10)
    spikes = [(t + 0.005, c) for t, n in zip(stimulus_s, active, strict=True) for c in range(n)]
    recording = of_spikes(spikes, stimulus_s, 100, 60.0)
    table = ResponseTable(
        values=counts_of(recording, (2.0, 10.0)).astype(float),
        kind="count",
        channels=recording.channels,
        stimuli=recording.stimuli,
        has_times=True,
        window_ms=(2.0, 10.0),
        start_min=0.0,
        presentation=None,
        provenance={},
    )
    for responses in (extract_responses(recording), extract_responses(table)):
        np.testing.assert_array_equal(responses.is_burst, active == 30)


def test_what_a_table_does_not_state_is_assumed_and_reported(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", response_count=[[1, 0], [0, 0], [2, 3]], stimulus_pattern=["a", "b", "a"])
    table = table_of(tmp_path / "a.npz")
    assert not table.has_times
    responses = extract_responses(table, ByPattern(), (2.0, 12.0))
    # One spike on two channels in 10 ms is 50 Hz.
    assert responses.rate_hz.tolist() == [50.0, 0.0, 250.0]
    assert responses.active_ratio.tolist() == [0.5, 0.0, 1.0]
    assert responses.time_s is None and not responses.presentations[0].is_rested.any()
    assert [f.severity for f in responses.findings if f.name == "window-assumed"] == ["note"]
    assumed = extract_responses(table, ByPattern()).findings
    assert [f.severity for f in assumed if f.name == "window-assumed"] == ["warning"]
    assert "stimulus-times-unknown" in {f.name for f in recording_findings(table)}
    text = inspection_text(inspect_recording(table, ByPattern()))
    assert "2.00 spikes in 2-10 ms per stimulus\n" in text
    assert "6 spikes on 2 channels, from 0 min" in text


def test_periods_instead_of_frequencies_cause_a_warning(tmp_path: Path) -> None:
    def warned(frequency_hz: list[float]) -> list[str]:
        np.savez(tmp_path / "a.npz", response_count=[[1, 0], [0, 0], [2, 3]], stimulus_frequency_hz=frequency_hz)
        return [f.message for f in recording_findings(table_of(tmp_path / "a.npz")) if f.name == "other-frequencies"]

    assert warned([0.2, 0.05, 0.0125]) == [
        "all frequencies are below 1 Hz, 0.0125 to 0.2: if they are periods in seconds, write 1 divided by each, "
        "5 to 80"
    ]
    # One low frequency is as likely as one period, and one of 1 Hz or more is none.
    assert warned([0.2, 0.2, 0.2]) == warned([0.2, 0.5, 1.0]) == []


def test_only_commands_that_need_spikes_refuse_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "a.npz", response_count=[[1, 0], [0, 0]])
    assert main(["convert", str(tmp_path / "a.npz"), "--out", str(tmp_path / "b.nwb")]) == 1
    reads = "got a response table, which animat inspect, validate, train, evaluate and replay read"
    assert reads in capsys.readouterr().err
    with pytest.raises(InvalidFile, match="this needs spike times"):
        read_recording(tmp_path / "a.npz")
    (tmp_path / "b_responses.csv.gz").write_bytes(gzip.compress(b"count_1,start_min\n3,5\n"))
    assert [source.start_min for source in read_sources(tmp_path)] == [0.0, 5.0]


BAD = {
    "a negative count": ("count_1\n-2\n", "expected counts of 0 or more, got -2 for stimulus 1 on channel 1"),
    "a part of a spike": (
        "count_1\n0.5\n",
        "expected whole spike counts, got 0.5 for stimulus 1 on channel 1; if these are rates in Hz, name them rate_hz",
    ),
    "counts and rates": ("count_1,rate_hz_2\n1,2\n", "line 1: expected a column count_CHANNEL or rate_hz_.* got both"),
    "an empty count": ("count_1,count_2\n1,2\n1,\n", "line 3: count_2: expected a finite number, got an empty field"),
    "half a window": ("count_1,window_end_ms\n1,2\n", "expected window_start_ms and window_end_ms, or neither"),
    "a window that changes": (
        "count_1,window_start_ms,window_end_ms\n1,2,9\n1,2,10\n",
        "line 3: window_end_ms: expected the same in all lines, 9 as in the first, got 10",
    ),
    "a window backwards": ("count_1,window_start_ms,window_end_ms\n1,9,2\n", "window: expected 0 <= start < end"),
    "a pair twice": (
        "trial,channel,count\n1,a,2\n1,b,2\n1,a,3\n",
        "line 4: expected one line per stimulus and channel",
    ),
    "long without trials": ("channel,count\n1,2\n", "expected trial .or stimulus_time_s., channel, and count"),
    "a trial with two patterns": (
        "trial,pattern,channel,count\n1,left,a,1\n2,up,a,1\n1,right,b,1\n",
        "line 4: stimulus_pattern: expected 'left' as in line 2, of the same stimulus, got 'right'",
    ),
    "a trial with two frequencies": (
        "trial,frequency_hz,channel,count\n1,5,a,1\n1,,b,1\n",
        "line 3: stimulus_frequency_hz: expected '5' as in line 2",
    ),
    "one channel twice": ("count_1,COUNT_1\n1,2\n", "expected each label once, got '1' twice"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_table_is_refused_in_one_line_that_names_the_file(case: str, tmp_path: Path) -> None:
    text, message = BAD[case]
    (tmp_path / "a_responses.csv").write_text(text)
    with pytest.raises(InvalidFile, match=message) as caught:
        read_source(tmp_path / "a_responses.csv")
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("response_window_ms", ["two", "ten"], r"response_window_ms: expected start and end in ms, got <U3 \(2,\)"),
        ("response_window_ms", [2j, 10], r"response_window_ms: expected start and end in ms, got complex128 \(2,\)"),
        ("response_window_ms", [2, 5, 10], r"response_window_ms: expected start and end in ms, got int64 \(3,\)"),
        (
            "response_count",
            [1, 0],
            r"response_count: expected numbers of shape \(stimuli, channels\), got int64 \(2,\)",
        ),
        ("stimulus_time_s", 1.0, r"stimulus_time_s: expected one column of times in seconds, got shape \(\)"),
    ],
)
def test_a_bad_npz_table_is_refused_by_the_name_of_its_key(
    key: str, value: object, message: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a.npz", **{"response_count": [[1, 0], [0, 0]], key: value})  # type: ignore[arg-type]
    with pytest.raises(InvalidFile, match=rf"a\.npz: {message}"):
        read_source(tmp_path / "a.npz")


@pytest.mark.parametrize("head", ["Rate (Hz) {}", "rate_hz_{}", "RATE-HZ-{}", "rate [Hz]_{}", "count_{}", "Count {}"])
def test_channels_are_named_by_the_rest_of_their_headers(head: str, tmp_path: Path) -> None:
    labels = ["12", "A1", "(3,4)"]
    header = ";".join(head.format(label) for label in labels)
    (tmp_path / "a_responses.csv").write_text(f"{header}\n1;2;3\n")
    assert table_of(tmp_path / "a_responses.csv").channels.label.tolist() == labels


def test_lines_of_a_trial_may_write_a_number_in_two_ways(tmp_path: Path) -> None:
    lines = "trial,frequency_hz,pattern,channel,count\n1,5,,a,1\n1,5.0,,b,2\n2,,,a,3\n2,,,b,4\n"
    (tmp_path / "a_responses.csv").write_text(lines)
    table = table_of(tmp_path / "a_responses.csv")
    np.testing.assert_array_equal(table.stimuli.frequency_hz, [5, np.nan])
    assert table.values.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("a_spikes.csv", "time_s,channel,rate_hz"),
        ("A_SPIKES.CSV.gz", "time_s,channel,count"),
        ("a.csv", "spike_time_s,unit,count_in_burst"),
        ("a.csv", "time_s,Spike Channel,rate_hz_mean"),
    ],
)
def test_spikes_with_columns_of_counts_are_spikes(name: str, header: str, tmp_path: Path) -> None:
    text = f"{header}\n0.1,7,2\n0.2,8,3\n".encode()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    source = read_source(tmp_path / name)
    assert isinstance(source, Recording)
    assert source.spike_times_s.tolist() == [0.1, 0.2]


def test_a_transposed_table_is_reported(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", response_count=np.zeros((3, 5)), stimulus_pattern=np.arange(5))
    with pytest.raises(InvalidFile, match=r"expected a row for each of 5 stimuli, got \(3, 5\): transpose it"):
        read_source(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("by", "window_ms", "message"),
    [
        (ByInterval((5.0,)), (2.0, 10.0), "expected no intervals, as the table has no stimulus times"),
        (ByPattern(), (2.0, 12.0), "expected 1 to 9, in which the table's spikes were counted, got 2 to 12"),
    ],
)
def test_a_choice_that_a_table_does_not_offer_is_refused(
    by: Conditions, window_ms: tuple[float, float], message: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a.npz", response_count=[[1, 0], [0, 0]], response_window_ms=[1, 9], stimulus_pattern=[0, 1])
    with pytest.raises(AnimatError, match=message):
        extract_responses(table_of(tmp_path / "a.npz"), by, window_ms)


@pytest.fixture
def rat(real_data: Path, tmp_path: Path) -> list[str]:
    """A published table, converted as in docs/recordings.md, and its options."""
    with np.load(real_data / "rat_cortical_64ch_responses.npz") as data:
        counts, sources = data["culture0_spikes_per_electrode"], data["culture0_sources"]
    file = tmp_path / "rat.npz"
    np.savez_compressed(file, response_count=counts, stimulus_pattern=sources[:, 0] + 2 * sources[:, 1])
    np.testing.assert_allclose(
        extract_responses(table_of(file), ByPattern()).rate_hz, counts.sum(axis=1) / (64 * 0.008), rtol=1e-12
    )
    return [str(file), "--conditions", "pattern", "--burst-threshold", "1"]


def test_a_real_table_is_inspected(rat: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", *rat, "--out", str(tmp_path / "figures")]) == 0
    printed = capsys.readouterr().out
    assert "spikes on 64 channels" in printed and "no spike times" in printed
    assert sorted(f.name for f in (tmp_path / "figures").iterdir()) == ["rat-burst-separation.png", "rat-responses.png"]


@pytest.mark.oracle
def test_a_real_table_is_trained_on_and_evaluated(rat: list[str], tmp_path: Path) -> None:
    policies = str(tmp_path / "policies")
    few = ["--policies", "1", "--iterations", "64", "--out", policies]
    assert main(["train", "cartpole", "--recordings", *rat, *few]) == 0
    assert main(["evaluate", policies, "--recordings", rat[0], "--episodes", "2"]) == 0


def test_rows_without_times_drift_in_their_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    pattern = rng.permutation(np.repeat([0, 1], 150))
    rising = np.linspace(0.5, 1.5, 300)
    for name, level in (("rising", rising), ("steady", np.ones(300)), ("shuffled", rng.permutation(rising))):
        counts = rng.poisson((20 + 20 * pattern[:, None]) * level[:, None], (300, 8))
        np.savez(tmp_path / f"{name}.npz", response_count=counts, stimulus_pattern=pattern)
        found = {
            finding.name: finding
            for finding in extract_responses(table_of(tmp_path / f"{name}.npz"), ByPattern()).findings
        }
        assert ("drift" in found) == (name == "rising")
        if name == "rising":
            # From 0.5 to 1.5 of the mean.
            assert found["drift"].value == pytest.approx(1.0, abs=0.1)
            assert "in the order of the rows" in found["drift"].message


def test_the_trials_of_a_wide_table_are_known(tmp_path: Path) -> None:
    (tmp_path / "a_responses.csv").write_text("trial,mood,count_a,count_b\n7,1,3,4\n8,1,5,6\n")
    table = table_of(tmp_path / "a_responses.csv")
    assert table.values.tolist() == [[3, 4], [5, 6]]
    (ignored,) = [finding.message for finding in table.findings if "mood" in finding.message]
    assert "trial" not in ignored


def test_a_window_that_is_given_is_no_assumption_even_if_it_is_the_usual_one(tmp_path: Path) -> None:
    counts: dict[str, Any] = {"response_count": [[1, 0], [0, 0]], "stimulus_pattern": [0, 1]}
    np.savez(tmp_path / "unstated.npz", **counts)
    np.savez(tmp_path / "stated.npz", response_window_ms=[5, 25], **counts)
    unstated, stated = (table_of(tmp_path / f"{name}.npz") for name in ("unstated", "stated"))

    def severities(window_ms: tuple[float, float] | None) -> list[str]:
        found = extract_responses(unstated, ByPattern(), window_ms).findings
        return [f.severity for f in found if f.name == "window-assumed"]

    assert (severities(None), severities((2.0, 10.0))) == (["warning"], ["note"])
    assert extract_responses(stated, ByPattern()).window_ms == (5.0, 25.0)
    with pytest.raises(Mismatch, match="expected 5 to 25, in which the table's spikes were counted, got 2 to 10"):
        extract_responses(stated, ByPattern(), (2.0, 10.0))


def test_numbered_trials_are_in_the_order_of_their_numbers_and_missing_ones_are_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    values = rng.poisson(0.4, (60, 3))
    # As exported by many programs: without zeros, sorted by channel. The first and the last trial are there.
    values[[0, -1], 1] = 1
    lines = [f"{trial + 101},{c},{n},{trial % 2}" for c, of in enumerate(values.T) for trial, n in enumerate(of) if n]
    (tmp_path / "a_responses.csv").write_text("\n".join(["trial,channel,count,pattern", *lines]) + "\n")
    table = table_of(tmp_path / "a_responses.csv")
    some = values.any(axis=1)
    np.testing.assert_array_equal(table.values, values[some])
    np.testing.assert_array_equal(table.stimuli.pattern, np.flatnonzero(some) % 2)
    (found,) = [f for f in table.findings if f.name == "trials-missing"]
    assert (found.severity, found.value) == ("warning", float(np.count_nonzero(~some)))
    assert f"{np.count_nonzero(~some)} of the trials 101 to 160 have no line" in found.message
    (unknown,) = [f for f in table.findings if f.name == "stimulus-times-unknown"]
    assert "its trials, sorted by their numbers, are assumed to be in order of presentation" in unknown.message
    # Numbers that count something else.
    for number in ("1e300", "1790000000"):
        far = f"trial,channel,count\n{number},0,1\n1,0,2\n2,0,3\n"
        (tmp_path / "c_responses.csv").write_text(far)
        assert not [f for f in table_of(tmp_path / "c_responses.csv").findings if f.name == "trials-missing"]
    # Names have no order but that of the file.
    named = [f"t{line}" for line in lines]
    (tmp_path / "b_responses.csv").write_text("\n".join(["trial,channel,count,pattern", *named]) + "\n")
    other = table_of(tmp_path / "b_responses.csv")
    assert len(other.values) == some.sum() and not np.array_equal(other.values, values[some])
    assert not [f for f in other.findings if f.name == "trials-missing"]


@pytest.mark.parametrize(
    ("changed", "name", "severity"),
    [
        ({"scale": 1000.0}, "times-not-in-seconds", "refuse"),
        ({"scale": 0.0}, "simultaneous-stimuli", "refuse"),
        ({"order": "blocked"}, "other-order", "warning"),
        ({"window_ms": [2.0, 80.0]}, "stimuli-too-close", "warning"),
        ({}, None, ""),
    ],
)
def test_stimuli_of_a_table_are_checked_like_those_of_spikes(
    changed: dict[str, Any], name: str | None, severity: str, tmp_path: Path
) -> None:
    frequency_hz = np.random.default_rng(2).choice([5.0, 10.0, 20.0], 300)
    time_s = np.cumsum(1 / frequency_hz) * changed.get("scale", 1.0)
    window_ms, order = changed.get("window_ms", [2.0, 10.0]), changed.get("order", "mixed")
    of_stimuli = {"stimulus_time_s": time_s, "stimulus_frequency_hz": frequency_hz}
    counts = np.random.default_rng(3).poisson(1.0, (300, 8))
    presented = {"presentation_order": order, "presentation_pulses": 1}
    np.savez(tmp_path / "a.npz", response_count=counts, response_window_ms=window_ms, **of_stimuli, **presented)
    table = table_of(tmp_path / "a.npz")
    found = {f.name: f.severity for f in (*recording_findings(table), *extract_responses(table).findings)}
    wanted = {"times-not-in-seconds", "simultaneous-stimuli", "other-order", "stimuli-too-close"}
    if name is None:
        assert not wanted & set(found)
    else:
        assert found[name] == severity


def test_trials_with_times_stay_in_the_order_of_their_times(tmp_path: Path) -> None:
    lines = ["trial,time_s,channel,count", "3,0.1,0,1", "1,0.2,0,2", "2,0.3,0,3"]
    (tmp_path / "a_responses.csv").write_text("\n".join(lines) + "\n")
    table = table_of(tmp_path / "a_responses.csv")
    assert table.values[:, 0].tolist() == [1, 2, 3]
    assert not {"unsorted-stimuli", "trials-missing"} & {finding.name for finding in table.findings}


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".CSV", ".txt"])
def test_spikes_by_name_are_no_table(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"b_spikes{suffix}").write_text("time_s,channel,count\n0.1,0,1\n0.2,1,1\n")
    assert not isinstance(read_source(tmp_path / f"b_spikes{suffix}"), ResponseTable)


@pytest.mark.oracle
def test_the_window_of_a_policy_is_none_that_was_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counts = np.random.default_rng(1).poisson([[1.0] * 8, [3.0] * 8] * 150)
    columns: dict[str, Any] = {"response_count": counts, "stimulus_frequency_hz": np.tile([5.0, 20.0], 150)}
    np.savez(tmp_path / "unstated.npz", **columns)
    np.savez(tmp_path / "stated.npz", response_window_ms=[5, 25], **columns)
    policies = str(tmp_path / "policies")
    training = ["train", "cartpole", "--iterations", "60", "--policies", "1", "--sac", "hidden=8", "--out", policies]
    assert main([*training, "--recordings", str(tmp_path / "unstated.npz")]) == 0
    capsys.readouterr()
    assert main(["evaluate", policies, "--episodes", "2", "--recordings", str(tmp_path / "stated.npz")]) == 0
    assert "other-window" in capsys.readouterr().err
    assert main(["evaluate", policies, "--episodes", "2", "--recordings", str(tmp_path / "unstated.npz")]) == 0
    assert "window-assumed" in capsys.readouterr().err


def test_gymnasium_reads_a_table_in_its_own_window(tmp_path: Path) -> None:
    counts = np.random.default_rng(1).poisson([[1.0] * 8, [3.0] * 8] * 150)
    columns: dict[str, Any] = {"response_count": counts, "stimulus_frequency_hz": np.tile([5.0, 20.0], 150)}
    np.savez(tmp_path / "stated.npz", response_window_ms=[5, 25], **columns)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make("animat:Animat/Cartpole-v0", recordings=tmp_path / "stated.npz")
    assert env.action_space.n == 2  # type: ignore[attr-defined]
