"""Plain NPZ and CSV. Oracles: hand-written files, properties (any order reads the same), real recordings."""

from __future__ import annotations

import gzip
import pickle
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from animat.errors import AnimatError, InvalidArgument, InvalidFile
from animat.recordings.formats.npz import KEYS, OTHER_NAMES, ROUTING
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.quality import recording_findings
from animat.recordings.reading import list_recordings, read_recording, read_recordings, read_source
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Presentation

FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

SPIKES = {"spike_time_s": np.array([0.5, -0.25, 0.5]), "spike_channel": np.array([7, 3, 3])}
STIMULI = {"stimulus_time_s": np.array([2.0, 1.0])}


def npz(folder: Path, **arrays: Any) -> Path:
    np.savez_compressed(folder / "a.npz", **arrays)
    return folder / "a.npz"


def names(recording: Recording) -> set[str]:
    return {finding.name for finding in recording_findings(recording)}


# --- NPZ -------------------------------------------------------------------------------------------------------------


def test_the_required_keys_are_enough(tmp_path: Path) -> None:
    recording = read_recording(npz(tmp_path, **SPIKES, **STIMULI))
    assert recording.spike_times_s.tolist() == [-0.25, 0.5, 0.5]
    assert recording.channels.label[recording.spike_channels].tolist() == ["3", "3", "7"]
    assert recording.stimuli.time_s.tolist() == [1.0, 2.0]
    assert (recording.start_s, recording.stop_s, recording.start_min) == (-0.25, 2.0, 0.0)
    assert np.isnan(recording.sampling_rate_hz)
    assert recording.presentation is None
    assert recording.stimuli.presentation.tolist() == [0, 1]
    assert said(recording).keys() == {"unsorted-spikes", "unsorted-stimuli", "silent-channels-unknown"}
    early = "spikes that follow a later one in the file: 1 of 3; they were sorted by time"
    assert said(recording)["unsorted-spikes"] == early


def said(recording: Recording) -> dict[str, str]:
    """The names of the findings."""
    return {finding.name: finding.message for finding in recording.findings}


@FEW
@given(times=st.lists(st.integers(-9, 9), min_size=1, max_size=20))
def test_spikes_out_of_order_are_those_with_a_later_one_anywhere_before_them(times: list[int], tmp_path: Path) -> None:
    path = npz(tmp_path, spike_time_s=np.array(times), spike_channel=np.zeros(len(times), int), **STIMULI)
    behind = sum(any(before > time for before in times[:i]) for i, time in enumerate(times))
    assert f"in the file: {behind} of" in said(read_recording(path)).get("unsorted-spikes", "in the file: 0 of")


def test_recordings_joined_in_one_file_cause_a_warning(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    spike_s, stimulus_s = np.sort(rng.uniform(0, 60, (3, 500))), np.tile(np.arange(1, 59.0), (3, 1))
    joined = {"spike_channel": rng.integers(0, 9, 1500), "spike_time_s": spike_s.ravel()}
    found = said(read_recording(npz(tmp_path, **joined, stimulus_time_s=stimulus_s.ravel())))
    assert "both go back by more than 1 s, 2 of each" in found["times-go-back"]
    # Listed by channel, spikes go back too, and stimuli listed by condition, but hardly ever as often.
    for stimuli in (stimulus_s[0], stimulus_s[:2].ravel() + np.repeat([0, 0.5], 58)):
        assert "times-go-back" not in said(read_recording(npz(tmp_path, **joined, stimulus_time_s=stimuli)))
    # Two events each that passed another on their way.
    passed_s = np.arange(1, 59.0)
    passed_s[[4, 9]] += 1.5
    assert "times-go-back" not in said(read_recording(npz(tmp_path, **joined, stimulus_time_s=passed_s)))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"spike_time_s": np.array([0.0, 1.0, 1e300])}, "spike_time_s: expected times in seconds, within a century"),
        ({"stimulus_time_s": np.array([0.0, -1e300])}, "stimulus_time_s: expected times in seconds, within a century"),
        ({"sampling_rate_hz": 1e300}, "sampling_rate_hz: expected a positive rate up to 1e.09 Hz"),
        ({"stimulus_frequency_hz": np.array([1e300, 1])}, "frequency_hz: expected positive frequencies up to 1e.09 Hz"),
        ({"start_min": -1e300}, "start_min: expected finite minutes within a century, got -1e.300"),
        ({"start_s": -1e300}, "start_s, duration_s: expected finite seconds within a century, got -1e.300"),
        ({"duration_s": 1e300}, "start_s, duration_s: expected finite seconds within a century, got -0.25 and 1e.300"),
        # Each of many rows would have room for it.
        ({"channel_label": np.array(["3", "x" * 1001])}, "channel_label: expected names of at most 1,000 characters"),
        ({"spike_channel": np.array(["3", "x" * 1001, "3"])}, "spike_channel: expected names of at most 1,000"),
        ({"stimulus_pattern": np.array(["3", "x" * 1001])}, "stimulus_pattern: expected names of at most 1,000"),
    ],
)
def test_implausibly_large_values_are_refused_by_name(changed: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=rf"a\.npz: .*{words}"):
        read_recording(npz(tmp_path, **{**SPIKES, **STIMULI, **changed}))


def test_every_key_is_read_into_its_field(tmp_path: Path) -> None:
    recording = read_recording(
        npz(
            tmp_path,
            **SPIKES,
            **STIMULI,
            channel_label=np.array([3, 5, 7]),
            channel_electrode=np.array([30, 50, 70]),
            channel_xy_um=np.array([[0.0, 1], [2, 3], [4, np.nan]]),
            stimulus_frequency_hz=np.array([80.0, np.nan]),
            stimulus_pattern=np.array([1, 0]),
            stimulus_electrodes=np.array([[9, 8], [7, -1]]),
            stimulus_presentation=np.array([4, 4]),
            sampling_rate_hz=20_000,
            start_min=140.0,
            start_s=-1.0,
            duration_s=5.0,
            presentation_order="mixed",
            presentation_pulses=2,
            # Spikes count, which are more than their number.
            response_count=np.zeros((2, 3)),
            note_of_mine=np.zeros(2),
        )
    )
    assert recording.spike_channels.tolist() == [0, 0, 2]
    assert recording.channels.label.tolist() == ["3", "5", "7"]
    assert recording.channels.electrode.tolist() == [30, 50, 70]
    assert recording.channels.x_um.tolist() == [0.0, 2.0, 4.0]
    assert recording.channels.y_um[:2].tolist() == [1.0, 3.0]
    np.testing.assert_array_equal(recording.stimuli.frequency_hz, [np.nan, 80.0])
    assert recording.stimuli.pattern.tolist() == [0, 1]
    assert recording.stimuli.electrodes.tolist() == [[7, -1], [9, 8]]
    assert recording.stimuli.is_last_of_presentation.tolist() == [False, True]
    assert (recording.start_s, recording.duration_s, recording.start_min) == (-1.0, 5.0, 140.0)
    assert (recording.sampling_rate_hz, recording.presentation) == (20_000.0, Presentation("mixed", 2))
    assert said(recording)["keys-left-out"].endswith("note_of_mine")
    assert "silent-channels" in names(recording)


def test_numbers_are_rows_where_channels_have_names_or_only_positions(tmp_path: Path) -> None:
    spikes = {"spike_time_s": np.array([0.0, 1.0]), "spike_channel": np.array([2, 0], dtype=np.uint16)}
    by_name = read_recording(npz(tmp_path, **spikes, **STIMULI, channel_label=np.array(["a", "b", "c"])))
    assert by_name.spike_channels.tolist() == [2, 0]
    by_position = read_recording(npz(tmp_path, **spikes, **STIMULI, channel_xy_um=np.zeros((3, 2))))
    assert by_position.spike_channels.tolist() == [2, 0]
    assert by_position.channels.label.tolist() == ["0", "1", "2"]


def test_units_become_channels_with_the_electrode_at_their_position(tmp_path: Path) -> None:
    recording = read_recording(
        npz(
            tmp_path,
            spike_time_s=np.array([0.0]),
            spike_unit=np.array([1]),
            unit_xy_um=np.array([[1.0, 2.0], [9.0, 9.0]]),
            stim_time_s=np.array([0.5, 0.6]),
            stim_tag=np.array(["train", "sensory"]),
            stim_electrodes=np.array([[5], [6]]),
            mapping_electrode=np.array([11, 12]),
            mapping_xy_um=np.array([[3.0, 3.0], [1.0, 2.0]]),
        )
    )
    assert recording.provenance["channels"] == "sorted units"
    assert recording.channels.electrode.tolist() == [12, -1]
    with np.load(tmp_path / "a.npz") as arrays:
        stated = read_recording(npz(tmp_path, **arrays, unit_electrode=np.array([7, 8])))
    assert stated.channels.electrode.tolist() == [7, 8]
    assert recording.stimuli.pattern.tolist() == [1, 0]
    assert recording.provenance["patterns"] == "0: sensory, 1: train"


def test_text_may_be_bytes_and_a_pattern_without_a_name_is_unknown(tmp_path: Path) -> None:
    labels = np.array(["é", "b"])
    recording = read_recording(
        npz(
            tmp_path,
            spike_time_s=np.array([0.0]),
            spike_channel=np.char.encode(labels[:1], "utf-8"),
            channel_label=np.char.encode(labels, "utf-8"),
            stimulus_time_s=np.array([0.0, 1.0]),
            stimulus_pattern=np.array([b"", b"left"]),
            presentation_order=b"blocked",
        )
    )
    assert recording.channels.label.tolist() == ["é", "b"]
    assert recording.stimuli.pattern.tolist() == [-1, 0]
    assert recording.presentation == Presentation("blocked")


@pytest.mark.oracle
@FEW
@given(data=st.data(), steps=st.lists(st.integers(-20, 20), max_size=25))
def test_the_order_of_spikes_and_stimuli_in_the_file_does_not_matter(
    data: st.DataObject, steps: list[int], tmp_path: Path
) -> None:
    times = np.array(steps, dtype=np.float64) / 4
    channels = np.array([data.draw(st.integers(0, 3)) for _ in steps], dtype=np.int64)
    columns = {"channel_xy_um": np.zeros((4, 2))}
    shuffled = np.array(data.draw(st.permutations(range(len(steps)))), dtype=np.int64)
    distinct = np.unique(times)
    first, second = (
        read_recording(
            npz(
                tmp_path,
                spike_time_s=times[order],
                spike_channel=channels[order],
                stimulus_time_s=stimuli,
                stimulus_frequency_hz=20 + stimuli,
                stimulus_presentation=3 + np.searchsorted(distinct, stimuli),
                **columns,
            )
        )
        for order, stimuli in ((np.arange(len(steps)), distinct), (shuffled, distinct[::-1]))
    )
    assert np.array_equal(first.spike_times_s, np.sort(times))
    assert np.array_equal(first.spike_times_s, second.spike_times_s)
    assert np.array_equal(first.spike_channels, second.spike_channels)
    assert np.array_equal(second.stimuli.frequency_hz, 20 + distinct)
    assert np.array_equal(second.stimuli.presentation, 3 + np.arange(len(distinct)))
    assert "trials-unknown" not in said(second)
    assert (first.start_s, first.duration_s) == (second.start_s, second.duration_s)


@FEW
@given(start_s=st.floats(-1e9, -1e-9), stop_s=st.floats(-1e9, 1e9))
def test_the_default_span_holds_every_event(start_s: float, stop_s: float, tmp_path: Path) -> None:
    times = np.array([start_s, stop_s])
    recording = read_recording(npz(tmp_path, spike_time_s=times, spike_channel=np.zeros(2), stimulus_time_s=times))
    assert recording.start_s == min(times)
    assert recording.stop_s >= max(times)


BAD_NPZ: dict[str, tuple[dict[str, Any], str]] = {
    "missing keys": (
        {"times": np.zeros(1), "spike_channel": np.zeros(1)},
        "missing spike_time_s, stimulus_time_s; found spike_channel, times",
    ),
    "NaN times": (SPIKES | {"spike_time_s": np.array([0.0, np.nan, 1.0])}, "spike_time_s: .* got 1 of 3 NaN"),
    "infinite stimulus": ({"stimulus_time_s": np.array([np.inf])}, "stimulus_time_s: .* got 1 of 1 NaN or infinite"),
    "text for times": (
        {"spike_time_s": np.array(["a", "b", "c"])},
        "spike_time_s: expected numbers, got <U1 .such as 'a'",
    ),
    "times in a table": (
        {"spike_time_s": np.zeros((3, 1))},
        r"spike_time_s: expected one column .* got shape \(3, 1\)",
    ),
    "two lengths": (
        {"spike_channel": np.zeros(2)},
        r"spike_channel: expected one channel per spike, shape \(3,\), got \(2,\)",
    ),
    "unknown label": (
        {"channel_label": np.array([3, 4])},
        "got 1 spikes on 1 unknown channels \\(such as '7'\\)",
    ),
    "unknown row": ({"channel_electrode": np.arange(7)}, "rows of the channel table .* got 7 \\(1 spikes"),
    "text without labels": (
        {"spike_channel": np.array(["a", "b", "c"]), "channel_electrode": np.arange(7)},
        "spike_channel: expected rows",
    ),
    "a spike without channel": ({"spike_channel": np.array([0, np.nan, 1])}, "a channel for each spike, got 1 without"),
    "half a channel": ({"spike_channel": np.array([0, 0.5, 1])}, "spike_channel: expected whole numbers, got 0.5"),
    "a label twice": ({"channel_label": np.array([3, 7, 7])}, "each label once, got '7' twice"),
    "channel columns of two lengths": (
        {"channel_label": np.array([3, 7]), "channel_electrode": np.arange(3)},
        "2 in channel_label, 3 in channel_electrode",
    ),
    "positions in one column": ({"channel_xy_um": np.zeros(8)}, r"channel_xy_um: expected shape \(8, 2\)"),
    "electrodes of channels in two dimensions": (
        {"channel_electrode": np.arange(8)[:, None]},
        r"channel_electrode: expected one electrode per channel, shape \(8,\), got \(8, 1\)",
    ),
    "an electrode of a channel below -1": (
        {"channel_electrode": np.arange(8) - 2},
        "channel_electrode: expected electrode numbers, or -1 if they are not known, got -2",
    ),
    "a number that is -2 in fewer bits": (
        {"stimulus_pattern": np.array([1, 2**64 - 2], np.uint64)},
        "stimulus_pattern: expected whole numbers of at most 63 bits, got 18446744073709551614",
    ),
    "negative frequency": (
        {"stimulus_frequency_hz": np.array([5.0, -5.0])},
        "positive frequencies .* got -5",
    ),
    "frequencies of another length": (
        {"stimulus_frequency_hz": np.zeros(3)},
        r"stimulus_frequency_hz: .*\(2,\), got \(3,\)",
    ),
    "electrodes of another length": (
        {"stimulus_electrodes": np.zeros((3, 2))},
        r"stimulus_electrodes: .* got \(3, 2\)",
    ),
    "an electrode below 0": (
        {"stimulus_electrodes": np.array([[3, -1], [-7, -1]])},
        "stimulus_electrodes: expected electrode numbers, .* got -7",
    ),
    "a pulse without order": ({"presentation_pulses": 1}, "presentation_order: expected 'blocked' or 'mixed'"),
    "pulses without order": ({"presentation_pulses": 5}, "stimulus_presentation: required to know which 5"),
    "half a pulse": ({"presentation_pulses": 2.5}, "presentation_pulses: expected a whole number, got 2.5"),
    "unknown order": (
        {"presentation_order": "shuffled"},
        "npz: presentation_order: expected 'blocked' or 'mixed', got 'shuffled'",
    ),
    "order as a number": ({"presentation_order": 1}, "presentation_order: expected text, got 1"),
    "a rate as text": ({"sampling_rate_hz": "fast"}, "sampling_rate_hz: expected a number, got 'fast'"),
    "two rates": ({"sampling_rate_hz": np.ones(2)}, r"sampling_rate_hz: expected one value, got shape \(2,\)"),
    "no rate": ({"sampling_rate_hz": 0}, "sampling_rate_hz: expected a positive rate up to 1e.09 Hz, .*got 0"),
    "start that is not finite": (
        {"start_min": np.nan},
        "start_min: expected finite minutes within a century, got nan",
    ),
    "duration too short": ({"duration_s": 1.0}, "expected times within the recording"),
    "negative duration": ({"duration_s": -1.0}, "start_s, duration_s: expected finite seconds"),
    "one thing under two names": (
        {"stim_time_s": np.zeros(2)},
        "expected stimulus_time_s once, got it under two names",
    ),
    "pickled objects": (
        {"channel_label": np.array([{"a": 1}, None], dtype=object)},
        "expected plain arrays .* got pickled objects, which are never read",
    ),
}


@pytest.mark.parametrize("case", BAD_NPZ)
def test_a_bad_npz_is_refused_in_one_line_that_names_the_file(case: str, tmp_path: Path) -> None:
    changes, message = BAD_NPZ[case]
    arrays = changes if "missing" in case else SPIKES | STIMULI | changes
    with pytest.raises(InvalidFile, match=message) as caught:
        read_recording(npz(tmp_path, **arrays))
    assert str(caught.value).startswith(str(tmp_path / "a.npz"))
    assert "\n" not in str(caught.value)


ARRAYS = npst.arrays(
    st.sampled_from(["f8", "f4", "i8", "u1", "?", "c16", "U2", "S2", "M8[s]", "i4,f4"]),
    npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)


@settings(FEW, max_examples=100)
@given(
    arrays=st.dictionaries(st.sampled_from([*KEYS, *OTHER_NAMES, *ROUTING]), ARRAYS, max_size=5), whole=st.booleans()
)
def test_any_arrays_are_read_or_refused_in_one_line(arrays: dict[str, Any], whole: bool, tmp_path: Path) -> None:
    try:
        read_recording(npz(tmp_path, **((SPIKES | STIMULI if whole else {}) | arrays)))
    except InvalidFile as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.9, 0.99])
def test_a_truncated_npz_is_refused_in_one_line(share: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = npz(tmp_path, spike_time_s=rng.random(500), spike_channel=np.zeros(500), **STIMULI)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InvalidFile, match=r"a\.npz: expected a complete NPZ archive, but it is cut off or damaged"):
        read_recording(path)


def test_a_damaged_npz_raises_our_error_or_is_harmless(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = npz(tmp_path, spike_time_s=rng.random(500), spike_channel=np.zeros(500), **STIMULI)
    content = path.read_bytes()
    for start in rng.integers(4, len(content) - 16, 150).tolist():
        path.write_bytes(content[:start] + rng.bytes(16) + content[start + 16 :])
        try:
            read_recording(path)
        except InvalidFile as error:
            assert "\n" not in str(error)


# --- CSV -------------------------------------------------------------------------------------------------------------


def csv(folder: Path, spikes: str, stimuli: str | None = None) -> Path:
    (folder / "a_spikes.csv").write_text(spikes)
    if stimuli is not None:
        (folder / "a_stimuli.csv").write_text(stimuli)
    return folder / "a_spikes.csv"


def test_csv_with_a_header_or_a_bare_column_of_stimuli(tmp_path: Path) -> None:
    path = csv(tmp_path, "n,time,channel,uV\n1,0.5,b,-3\n2,-0.5,a,-2\n", "1.5\n0.25\n")
    recording = read_recording(path, start_min=10.0)
    assert recording.spike_times_s.tolist() == [-0.5, 0.5]
    assert recording.channels.label[recording.spike_channels].tolist() == ["a", "b"]
    assert recording.stimuli.time_s.tolist() == [0.25, 1.5]
    assert recording.start_min == 10.0
    assert "n, uV" in said(recording)["columns-left-out"]
    stimuli = (
        "time;time_s;frequency_hz;pattern;electrodes;presentation\n"
        "100;0.1;5;left;12 13;0\n200;0.2;;right;14;0\n300;0.3;80;left;;1\n"
    )
    (tmp_path / "other.csv").write_text(stimuli)
    recording = read_recording(path, stimuli_path=tmp_path / "other.csv")
    np.testing.assert_array_equal(recording.stimuli.frequency_hz, [5.0, np.nan, 80.0])
    assert recording.stimuli.time_s.tolist() == [0.1, 0.2, 0.3]
    assert recording.stimuli.pattern.tolist() == [0, 1, 0]
    assert recording.stimuli.electrodes.tolist() == [[12, 13], [14, -1], [-1, -1]]
    assert recording.stimuli.presentation.tolist() == [0, 0, 1]


def test_names_with_underscores_are_no_numbers(tmp_path: Path) -> None:
    spikes, pulses = "time_s,unit\n0.1,1_11\n0.2,11_1\n0.3,2\n", "time_s,pattern\n0.1,1_12\n0.2,11_2\n"
    recording = read_recording(csv(tmp_path, spikes, pulses))
    assert recording.channels.label[recording.spike_channels].tolist() == ["1_11", "11_1", "2"]
    assert recording.stimuli.pattern.tolist() == [1, 0]
    for stimuli, words in {
        "time_s\n1_0\n": "line 2: stimulus_time_s: expected a number, got '1_0'",
        "time_s,electrodes\n1,9 1_2\n": "line 2: stimulus_electrodes: expected whole numbers .*, got '9 1_2'",
        "time_s,electrodes\n1,-2\n": "stimulus_electrodes: expected electrode numbers, or -1 for none .*, got -2",
    }.items():
        with pytest.raises(InvalidFile, match=words):
            read_recording(csv(tmp_path, spikes, stimuli))


def test_csv_may_be_gzipped_and_have_a_byte_order_mark_and_windows_lines(tmp_path: Path) -> None:
    path = tmp_path / "a_spikes.csv.gz"
    path.write_bytes(gzip.compress("\ufefftime_s\tunit\r\n0.5\t3\r\n".encode()))
    (tmp_path / "a_stimuli.csv.gz").write_bytes(gzip.compress(b"time\n0.75\n"))
    recording = read_recording(path)
    assert recording.channels.label.tolist() == ["3"]
    assert recording.stimuli.time_s.tolist() == [0.75]


def test_spikes_without_stimuli_are_read_and_reported(tmp_path: Path) -> None:
    # A spreadsheet ends lines with the separators of empty cells.
    recording = read_recording(csv(tmp_path, "time,channel\n0.5,1,,\n"))
    assert len(recording.stimuli) == 0
    refusal = next(finding for finding in recording_findings(recording) if finding.name == "no-stimuli")
    assert refusal.severity == "refuse"
    assert "1 spike but no stimuli" in refusal.message
    assert "a_stimuli.csv or a_stimuli.csv.gz was looked for" in refusal.message


def test_unusual_headers_and_decimal_commas_are_read_and_reported(tmp_path: Path) -> None:
    spikes = "Time (s); CHANNEL;\n0,0031;17;\n1,5;21;\n;;\n"
    recording = read_recording(csv(tmp_path, spikes, "Time [s]\tFrequency-Hz\n0,25\t5\n0,5\t12,5\n0,75\t\n"))
    assert recording.spike_times_s.tolist() == [0.0031, 1.5]
    assert recording.channels.label.tolist() == ["17", "21"]
    assert recording.stimuli.time_s.tolist() == [0.25, 0.5, 0.75]
    np.testing.assert_array_equal(recording.stimuli.frequency_hz, [5.0, 12.5, np.nan])
    assert recording.provenance["stimuli"] == "a_stimuli.csv"
    read_as = said(recording)["headers-read-as"]
    assert "'Time (s)' of a_spikes.csv is read as time_s" in read_as
    assert "'Frequency-Hz' of a_stimuli.csv is read as frequency_hz" in read_as
    assert "spike_time_s of a_spikes.csv has decimal commas" in said(recording)["decimal-commas"]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 10**7), min_size=1, max_size=8).map(sorted))
def test_times_with_three_decimals_are_read_if_one_cannot_be_thousands(milliseconds: list[int]) -> None:
    cells = [f"{ms // 1000},{ms % 1000:03}" for ms in milliseconds]
    with tempfile.TemporaryDirectory() as folder:
        path = csv(Path(folder), "time;channel\n" + "".join(f"{cell};5\n" for cell in cells))
        # Thousands begin with one to three figures, of which the first is no 0.
        if all(1000 <= ms < 10**6 for ms in milliseconds):
            with pytest.raises(InvalidFile, match="expected a number with a decimal point"):
                read_recording(path)
        else:
            times_s = [ms / 1000 for ms in milliseconds]
            assert read_recording(path).spike_times_s.tolist() == pytest.approx(times_s)


BAD_CSV = {
    "no known column": ("t,c\n1,2\n", None, "expected a column named spike_time_s or time_s or time, found t, c"),
    "no channel": ("time,c\n1,2\n", None, "expected a column named spike_channel or channel or unit, found time, c"),
    "a misspelt time": ("tmie,channel\n1,2\n", None, "found tmie, channel; did you mean time\\?$"),
    "a misspelt channel": ("time,Chanel\n1,2\n", None, "found time, Chanel; did you mean channel\\?$"),
    "misspelt responses": ("trial,channel,cuont\n1,2,3\n", None, "trial, channel, cuont; did you mean count\\?$"),
    "channels and times swapped": ("time,channel\n3,0.5\n", None, "line 2: .* or names, got 0.5: are the columns"),
    "a word for a time": (
        "time,channel\n1,2\nsoon,2\n",
        None,
        "a_spikes.csv, line 3: spike_time_s: expected a number, got 'soon'",
    ),
    "an empty time": ("time,channel\n,2\n", None, "line 2: spike_time_s: expected a finite number, got an empty field"),
    "an empty channel": ("time,channel\n1,2\n1,\n", None, "line 3: .*expected a channel for each spike, got 1 without"),
    "a short line": ("time,channel\n1,2\n1\n", None, "line 3: expected 2 fields, as in the header, got 1: is a field"),
    "a long line after a blank one": (
        "time,channel\n1,2\n\n1,2,3\n",
        None,
        "line 4: expected 2 fields, .* got 3: write",
    ),
    "decimal commas among commas": (
        "time,channel\n0,0031,17\n",
        None,
        "line 2: .* got 3: .* decimal points, or sep.*semi",
    ),
    "text with a comma": (
        "time,channel\n0.5,left, upper\n",
        None,
        "line 2: .* got 3: quote text that contains the separator",
    ),
    "commas that may be thousands": ("time;channel\n1,234;5\n", None, "line 2: .* decimal point, got '1,234'"),
    "commas and points": ("time;channel\n0.5;5\n0,5;5\n", None, "line 3: .* decimal point, got '0,5'"),
    "two headers of one name": ("Time,TIME,channel\n1,2,3\n", None, "line 1: expected one column time, got 'Time' and"),
    "spikes that are stimuli": ("time,frequency_hz\n1,5\n", None, "are spikes and stimuli swapped"),
    "no header": ("0.5,3\n1,2\n", None, "line 1: expected a column .*found 0.5, 3: add a line with the column names"),
    "the answer of a server": ("<html><body>404 not found</body></html>\n", None, "it is a web page, perhaps"),
    "blanks between columns": ("time channel\n1 2\n", None, "separate the columns by commas, semicolons or tabs"),
    "a spreadsheet's first line": ("sep=;\ntime;channel\n1;2\n", None, "remove this first line"),
    "a quote that is not closed": (
        'time_s,channel\n0.1,a\n0.2,"b\n0.3,c\n\n\n',
        None,
        "line 3: expected a quote to be closed",
    ),
    "times in milliseconds by name": ("time_ms,channel\n1,5\n", None, "convert the times in time_ms to seconds"),
    "blank": ("\n\n", None, "expected a header line"),
    "stimuli without times": (
        "time,channel\n1,2\n",
        "frequency_hz,x\n5,5\n",
        "a_stimuli.csv, line 1: expected a column named stim",
    ),
    "electrodes as words": (
        "time,channel\n1,2\n",
        "time,electrodes\n1,left\n",
        "stimulus_electrodes: expected whole numbers separated by spaces",
    ),
    "an electrode beyond 64 bits": (
        "time,channel\n1,2\n",
        "time,electrodes\n1,5\n2,99999999999999999999\n",
        "a_stimuli.csv, line 3: stimulus_electrodes: expected whole numbers",
    ),
    "one long list of electrodes among many": (
        "time,channel\n1,2\n",
        f"time,electrodes\n1,{'7 ' * 3000}\n" + "2,7\n" * 20_000,
        "a_stimuli.csv: stimulus_electrodes: expected a few electrodes per stimulus, got 3000",
    ),
    "negative frequency": (
        "time,channel\n1,2\n",
        "time,frequency_hz\n1,-5\n",
        "a_stimuli.csv, line 2: .*positive frequencies .* got -5",
    ),
    "a frequency of 0": (
        "time,channel\n1,2\n",
        "time,frequency_hz\n1,5\n2,0\n",
        "a_stimuli.csv, line 3: .*positive frequencies .* got 0",
    ),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_a_bad_csv_is_refused_in_one_line_that_names_the_file(case: str, tmp_path: Path) -> None:
    spikes, stimuli, message = BAD_CSV[case]
    with pytest.raises(InvalidFile, match=message) as caught:
        read_recording(csv(tmp_path, spikes, stimuli))
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_a_truncated_gzip_is_refused_in_one_line(share: float, tmp_path: Path) -> None:
    text = "time,channel\n" + "\n".join(f"{t / 7},{t % 5}" for t in range(400))
    content = gzip.compress(text.encode())
    (tmp_path / "a_spikes.csv.gz").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InvalidFile, match=r"expected a complete file, but it cannot be read or is cut off"):
        read_recording(tmp_path / "a_spikes.csv.gz")


def test_a_gzip_that_unpacks_to_far_more_than_any_table_is_refused(tmp_path: Path) -> None:
    content = gzip.compress(b"time,channel\n" + b"0.5,1\n" * 1_000_000)
    assert len(content) < 20_000
    (tmp_path / "a_spikes.csv.gz").write_bytes(content)
    with pytest.raises(InvalidFile, match=r"a_spikes.csv.gz: unpacks to over 4,[\d,]+ bytes, too many for its size"):
        read_recording(tmp_path / "a_spikes.csv.gz")


# --- any file, folders -----------------------------------------------------------------------------------------------


def test_files_that_are_not_recordings_are_refused_in_one_line(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "empty.nwb").touch()
    for name in ("b.nwb", "b.bin"):
        (tmp_path / name).write_bytes(b"\x89PNG\x00binary")
    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        (tmp_path / f"p{protocol}.pkl").write_bytes(pickle.dumps({"a": 1}, protocol))
    (tmp_path / "latin.csv").write_bytes("time,channel,µV\n1,2,3\n".encode("latin-1"))
    (tmp_path / "sheet.csv").write_text("time,channel\n1,2\n", "utf-16")
    (tmp_path / "m.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x01IM" + bytes(64))
    with zipfile.ZipFile(tmp_path / "sheet.xlsx", "w") as book:
        book.writestr("[Content_Types].xml", "<Types/>")
    (tmp_path / "a_stimuli.csv").write_text("1\n")
    (tmp_path / "notes.md").write_text("# Notes\n\nA, b.\n")
    for path, message in {
        "notes.md": r"\(it is read as CSV; recordings are also NWB, MaxWell, CL1 or NPZ\)$",
        "none.nwb": "no such file",
        "a.npy": "got NPY, which holds one array; save several by name with numpy.savez",
        "empty.nwb": "got an empty file",
        "b.nwb": "expected HDF5 in a file with this name, got something else",
        "b.bin": "expected a recording .NWB, MaxWell, CL1, NPZ or CSV., got an unknown kind of file",
        **{f"p{protocol}.pkl": "got a Python pickle, which is never read.*numpy.savez" for protocol in range(2, 6)},
        "latin.csv": "expected CSV .text in UTF-8., .* save it as CSV in UTF-8",
        "sheet.csv": "got text in UTF-16; save it as CSV in UTF-8",
        "m.mat": "got a MATLAB file; save its columns as CSV or NPZ",
        "sheet.xlsx": "got a spreadsheet; save its tables as CSV",
        "a_stimuli.csv": "expected a spike file, got the stimuli that belong to one",
        ".": "got a folder; read_recordings reads folders",
    }.items():
        with pytest.raises(InvalidFile, match=message) as caught:
            read_recording(tmp_path / path)
        assert "\n" not in str(caught.value)
    with pytest.raises(InvalidArgument, match="start_min: expected finite minutes, got nan"):
        read_recording(tmp_path / "a.npy", start_min=float("nan"))
    remedy = "name the file of stimuli NAME_stimuli.csv and that of spikes NAME_spikes.csv"
    with pytest.raises(InvalidArgument, match=f"stimuli: expected only for HDF5 files, got 'x' for .*; {remedy}"):
        read_recording(csv(tmp_path, "time,channel\n0.5,1\n"), stimuli="x")
    with pytest.raises(InvalidArgument, match="stimuli_path: expected only with CSV"):
        read_recording(npz(tmp_path, **SPIKES, **STIMULI), stimuli_path=tmp_path / "a_stimuli.csv")


def test_folders_are_read_in_the_order_of_the_cultures_clock(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    folder.mkdir()
    first = read_recording(npz(tmp_path, **SPIKES, **STIMULI, start_min=20.0))
    write_nwb(first, folder / "a.nwb")
    npz(folder, **SPIKES, **STIMULI, start_min=5.0)
    csv(folder, "time,channel\n0.5,1\n", "0.25\n")
    (folder / ".b.nwb.partial.nwb").write_bytes(b"half a file")
    (folder / "notes.txt").write_text("not a recording")
    read = read_recordings(folder)
    assert [recording.start_min for recording in read] == [0.0, 5.0, 20.0]
    assert read[2].equals(first)
    first_alone = read_recordings([folder / "a.nwb"])
    assert first_alone[0].equals(first)


def test_files_of_any_format_in_a_folder_are_listed_by_name(tmp_path: Path) -> None:
    listed = ["a.h5", "b_responses.csv", "b_spikes.csv", "c_responses.csv.gz", "c_spikes.csv.gz", "d.npz", "e.nwb"]
    for name in [*listed[::-1], ".f.nwb", "b_stimuli.csv", "d.csv", "notes.txt"]:
        (tmp_path / name).touch()
    assert [file.name for file in list_recordings(tmp_path)] == listed


def test_recordings_with_the_same_start_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=r"expected a folder of recordings .* found none in it"):
        read_recordings(tmp_path)
    with pytest.raises(InvalidArgument, match="recordings: expected at least one file or folder"):
        read_recordings([])
    for wrong in (3, [3]):
        with pytest.raises(InvalidArgument, match="recordings: expected files or folders, got 3"):
            read_recordings(wrong)  # type: ignore[arg-type]
    path = npz(tmp_path, **SPIKES, **STIMULI)
    other = path.with_name("b.npz")
    other.write_bytes(path.read_bytes())
    with pytest.raises(InvalidFile, match=r"both start at 0 min; leave one out"):
        read_recordings([path, other])


# --- real recordings -------------------------------------------------------------------------------------------------


def test_the_organoid_recording(real_data: Path, tmp_path: Path) -> None:
    recording = read_recording(real_data / "organoid_cartpole_maxone.npz")
    counts = len(recording.spike_times_s), len(recording.channels), len(recording.stimuli)
    assert counts == (240_559, 108, 2_775)
    assert recording.provenance["channels"] == "sorted units"
    assert recording.sampling_rate_hz == 20_000.0
    assert recording.channels.has_positions
    assert np.all(recording.channels.electrode >= 0)
    with np.load(real_data / "organoid_cartpole_maxone.npz") as truth:
        assert np.array_equal(
            np.bincount(recording.spike_channels, minlength=108), np.bincount(truth["spike_unit"], minlength=108)
        )
        assert np.array_equal(recording.stimuli.electrodes, truth["stim_electrodes"])
    window = [np.searchsorted(recording.spike_times_s, recording.stimuli.time_s + s) for s in (0.002, 0.010)]
    assert np.mean(window[1] - window[0]) == pytest.approx(20.26, abs=0.005)
    write_nwb(recording, tmp_path / "a.nwb")
    assert read_recording(tmp_path / "a.nwb").equals(recording)


def test_the_brainoware_recording(real_data: Path) -> None:
    recording = read_recording(real_data / "brainoware_spikes.csv.gz")
    counts = len(recording.spike_times_s), len(recording.channels), len(recording.stimuli)
    assert counts == (49_278, 584, 175)
    assert "c_153ch" in recording.channels.label
    assert recording.start_s == -0.07725
    assert "silent-channels-unknown" in names(recording)
    np.testing.assert_allclose(np.diff(recording.stimuli.time_s), 5.0, atol=0.5)


def test_an_npz_of_counts_without_times_is_refused_by_its_keys(real_data: Path) -> None:
    said = r"expected times of spikes .*only counts \(culture0_spikes_per_electrode.*provide the times"
    with pytest.raises(AnimatError, match=said):
        read_recording(real_data / "rat_cortical_64ch_responses.npz")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a_spikes.csv", "time_s,channel\n", "expected one line per spike, got only a header"),
        ("a_spikes.csv", "time_s,channel,unit\n0.1,1,2\n", "expected one column of .* got channel and unit"),
        ("a_spikes.csv", "time_s\n0.1,7\n", "expected 1 field, as in the header, got 2"),
        ("a_responses.csv", "trial,pattern\n1,a\n", "expected a column count_CHANNEL or rate_hz_CHANNEL"),
    ],
)
def test_messages_say_what_is_missing(name: str, text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidFile, match=words):
        read_source(tmp_path / name)


def test_pulses_per_trial_that_are_not_stated_are_those_of_the_usual_trial(tmp_path: Path) -> None:
    times = {"stimulus_time_s": np.arange(11) * 0.1, "presentation_order": np.array("mixed")}
    trials = {"stimulus_presentation": np.arange(11) // 5}
    assert read_recording(npz(tmp_path, **SPIKES, **times, **trials)).presentation == Presentation("mixed", 5)
    assert read_recording(npz(tmp_path, **SPIKES, **times)).presentation == Presentation("mixed", 1)
    # Not a number between those of the trials.
    unlike = {"stimulus_presentation": np.repeat(np.arange(4), [1, 2, 4, 4])}
    assert read_recording(npz(tmp_path, **SPIKES, **times, **unlike)).presentation == Presentation("mixed", 4)
    mostly_two = {"stimulus_presentation": np.repeat(np.arange(4), [2, 2, 3, 4])}
    assert read_recording(npz(tmp_path, **SPIKES, **times, **mostly_two)).presentation == Presentation("mixed", 2)


def test_text_labels_and_a_negative_duration_are_named_in_errors(tmp_path: Path) -> None:
    labels = {"channel_label": np.array(["17", "21", "40"])}
    numbers = {"spike_time_s": np.array([0.1, 0.2]), "spike_channel": np.array([17, 1])}
    with pytest.raises(InvalidFile, match="rows from 0 to 2, as these are numbers and channel_label is text, got 17"):
        read_recording(npz(tmp_path, **numbers, **STIMULI, **labels))
    started = npz(tmp_path, spike_time_s=numbers["spike_time_s"], spike_channel=np.ones(2), **STIMULI, start_s=-1.0)
    assert (read_recording(started).start_s, read_recording(started, start_s=0.0).start_s) == (-1.0, 0.0)
    with pytest.raises(InvalidFile, match=r"the latter 0 or more, got -0\.25 and -1"):
        read_recording(npz(tmp_path, **SPIKES, **STIMULI, duration_s=-1.0))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"duration_s": 1.0}, "spike_time_s: expected times within the recording (0 to 1 s), got 0.1 to 2 s"),
        ({"channel_label": ["a", "a"], "spike_channel": ["a", "a"]}, "channel_label: expected each label once"),
        ({"stimulus_frequency_hz": [-1.0]}, "stimulus_frequency_hz: expected positive frequencies"),
    ],
)
def test_a_message_names_the_column_of_the_file(columns: dict[str, Any], message: str, tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    np.savez(file, **{"spike_time_s": [0.1, 2.0], "spike_channel": [0, 0], "stimulus_time_s": [0.05], **columns})
    with pytest.raises(InvalidFile, match=re.escape(f"a.npz: {message}")):
        read_recording(file)


def test_names_of_channels_that_look_like_numbers_stay_different(tmp_path: Path) -> None:
    for names, labels in ((("1", "01", "1"), ["01", "1"]), (("1", "1.0", "2"), ["1", "2"])):
        spikes = "".join(f"{0.1 * n:g},{name}\n" for n, name in enumerate(names))
        (tmp_path / "a_spikes.csv").write_text(f"time_s,channel\n{spikes}")
        (tmp_path / "a_stimuli.csv").write_text("time_s,frequency_hz\n0.05,10\n")
        recording = read_recording(tmp_path / "a_spikes.csv")
        assert sorted(map(str, recording.channels.label.tolist())) == labels
    (tmp_path / "a_stimuli.csv").write_text("time_s,frequency_hz,pattern\n0.05,10,1\n0.1,10,NaN\n0.15,10,\n")
    assert read_recording(tmp_path / "a_spikes.csv").stimuli.pattern.tolist() == [1, -1, -1]


@pytest.mark.parametrize("suffix", [".CSV", ".tsv", ".txt", ".csv.gz"])
def test_stimuli_are_beside_spikes_with_the_same_ending(suffix: str, tmp_path: Path) -> None:
    write = gzip.compress if suffix.endswith(".gz") else bytes
    (tmp_path / f"a_spikes{suffix}").write_bytes(write(b"time_s\tchannel\n0.1\t3\n0.2\t4\n"))
    with_none = read_recording(tmp_path / f"a_spikes{suffix}")
    (message,) = [f.message for f in with_none.findings if f.name == "no-stimuli"]
    assert f"a_stimuli{suffix} or " in message
    (tmp_path / f"a_stimuli{suffix}").write_bytes(write(b"time_s\n0.15\n"))
    assert read_recording(tmp_path / f"a_spikes{suffix}").stimuli.time_s.tolist() == [0.15]


@pytest.mark.parametrize(
    ("stimuli", "words"),
    [
        ("time_s,presentation\n0,2\n0.1,1\n", "a_stimuli.csv: stimulus_presentation: expected numbers that never fall"),
        ("time_s,presentation\n0,1\n0.1,1.5\n", "a_stimuli.csv, line 3: stimulus_presentation: expected whole numbers"),
        ("time_s,pattern\n0,0\n0.1,0.5\n", "a_stimuli.csv, line 3: stimulus_pattern: expected whole numbers or names"),
        ("time_s,electrodes\n0,4\n0.1,-5\n", "a_stimuli.csv: stimulus_electrodes: expected electrode numbers"),
    ],
)
def test_errors_on_stimuli_name_their_file(stimuli: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a_spikes.csv").write_text("time_s,channel\n0.1,3\n0.2,4\n")
    (tmp_path / "a_stimuli.csv").write_text(stimuli)
    with pytest.raises(InvalidFile, match=words):
        read_recording(tmp_path / "a_spikes.csv")


@pytest.mark.parametrize(
    "labels", [("9007199254740992", "9007199254740993"), ("inf", "3"), ("12345678901234567890", "1")]
)
def test_channels_that_no_float_tells_apart_are_names(labels: tuple[str, str], tmp_path: Path) -> None:
    (tmp_path / "a_spikes.csv").write_text(f"time_s,channel\n0.1,{labels[0]}\n0.2,{labels[1]}\n")
    assert sorted(read_recording(tmp_path / "a_spikes.csv").channels.label.tolist()) == sorted(labels)


def test_a_pattern_that_is_no_number_of_patterns_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a_spikes.csv").write_text("time_s,channel\n0.1,3\n0.2,4\n")
    (tmp_path / "a_stimuli.csv").write_text("time_s,pattern\n0,5\n0.1,inf\n0.2,10\n")
    with pytest.raises(InvalidFile, match=r"a_stimuli.csv: stimulus_pattern: expected whole numbers, got inf"):
        read_recording(tmp_path / "a_spikes.csv")


def test_a_pulse_without_a_number_within_a_trial_does_not_divide_it(tmp_path: Path) -> None:
    numbers = [-1, 4, -1, 4, 4, -1, 6, -1, -1, 6, 7, -1]
    of_trials = [0, 1, 1, 1, 1, 2, 3, 3, 3, 3, 4, 5]
    stimuli = {"stimulus_time_s": 0.1 * np.arange(12), "stimulus_presentation": np.array(numbers)}
    recording = read_recording(npz(tmp_path, **SPIKES, **stimuli))
    assert recording.stimuli.presentation.tolist() == of_trials
    (found,) = [f for f in recording.findings if f.name == "trials-unknown"]
    assert found.value == 6 and found.message.endswith(
        "as one trial, but 3 between two pulses of a trial as part of it"
    )
