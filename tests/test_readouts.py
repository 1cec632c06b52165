"""Readouts: groups of channels, read in the same windows, identified by electrode; against counts by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from animat.errors import InvalidArgument, InvalidFile, Mismatch
from animat.recordings.recording import Channels, Recording, ResponseTable
from animat.responses.extraction import extract_responses, extract_series
from animat.responses.quality.responses import _readouts
from animat.responses.readouts import ALL, Readouts, count_readouts, read_readouts, readouts_on
from animat.responses.windows import read_windows
from animat.tables import UNKNOWN
from synthetic_recordings import SyntheticCulture

WINDOW_MS = (2.0, 10.0)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return SyntheticCulture(1, patterns=12, channels=32, burst_share=0.1).record()


@pytest.fixture(scope="module")
def halves(recording: Recording) -> Readouts:
    return readouts_on("halves", recording.channels)


def reordered(recording: Recording, order: np.ndarray) -> Recording:
    """The same recording with its channels in another order."""
    channels, place = recording.channels, np.argsort(order)
    columns = {name: getattr(channels, name)[order] for name in ("label", "electrode", "x_um", "y_um")}
    return replace(recording, channels=Channels(**columns), spike_channels=place[recording.spike_channels])


def test_each_readout_is_what_one_counts_by_hand(recording: Recording, halves: Readouts) -> None:
    plain = extract_responses(recording)
    responses = extract_responses(recording, readouts=halves)
    assert responses.readout_hz is not None and responses.time_s is not None
    electrode = recording.channels.electrode[recording.spike_channels].tolist()
    for row in range(0, len(responses), 7):
        from_s, to_s = responses.time_s[row] + 0.002, responses.time_s[row] + 0.010
        for d, group in enumerate(halves.electrodes or ()):
            n = sum(from_s <= t < to_s and e in group for t, e in zip(recording.spike_times_s, electrode, strict=True))
            assert responses.readout_hz[row, d] == pytest.approx(n / (0.008 * len(group)))
    # What is said of all channels is as without.
    for name in ("rate_hz", "active_ratio", "is_burst", "condition", "findings", "threshold"):
        np.testing.assert_array_equal(getattr(responses, name), getattr(plain, name))
    assert responses.is_burst.any() and plain.read_hz is plain.rate_hz
    # Halves of as many channels: their mean is x of all.
    np.testing.assert_allclose(responses.readout_hz.mean(axis=1), plain.rate_hz)


def test_one_group_of_all_channels_is_read_to_the_bit_as_all_channels_are(recording: Recording) -> None:
    after_s = recording.stimuli.time_s[:50]
    all_of_them = Readouts(("every",), (tuple(recording.channels.electrode.tolist()),))
    for readouts in (all_of_them, ALL):
        # The culture fires before the last of these windows too.
        for window_ms in (WINDOW_MS, (4.5, 7.25)):
            x = readouts.read(recording, readouts.members(recording.channels), after_s, window_ms)
            np.testing.assert_array_equal(x, read_windows(recording, after_s, window_ms)[0])
    responses = extract_responses(recording, readouts=all_of_them)
    np.testing.assert_array_equal(responses.read_hz, responses.rate_hz)


def test_channels_are_identified_by_electrode_in_any_order(recording: Recording, halves: Readouts) -> None:
    other = reordered(recording, np.random.default_rng(0).permutation(len(recording.channels)))
    assert readouts_on("halves", other.channels) == halves
    here, there = (extract_responses(each, readouts=halves) for each in (recording, other))
    np.testing.assert_array_equal(here.read_hz, there.read_hz)


def test_halves_and_quadrants_are_cut_by_position(recording: Recording, halves: Readouts) -> None:
    x_um, y_um, electrode = (getattr(recording.channels, name) for name in ("x_um", "y_um", "electrode"))
    left, right = (np.isin(electrode, group) for group in halves.electrodes or ())
    assert halves.names == ("left", "right") and x_um[left].max() <= x_um[right].min()
    assert left.sum() == right.sum() == 16 and not (left & right).any()
    quadrants = readouts_on("quadrants", recording.channels)
    assert quadrants.names[:2] == ("left top", "left bottom") and count_readouts("quadrants") == 4
    members = quadrants.members(recording.channels)
    np.testing.assert_array_equal(members.sum(axis=0), 1)
    np.testing.assert_array_equal(members[0] | members[1], left)
    assert y_um[members[0]].max() <= y_um[members[1]].min()


def test_a_table_of_responses_has_readouts_too(recording: Recording, halves: Readouts) -> None:
    values = np.random.default_rng(0).poisson(1.0, (len(recording.stimuli), len(recording.channels))).astype(float)
    table = ResponseTable(values, "count", recording.channels, recording.stimuli, window_ms=WINDOW_MS)
    responses = extract_responses(table, readouts=halves)
    left = np.isin(recording.channels.electrode, (halves.electrodes or ())[0])
    np.testing.assert_allclose(responses.read_hz[:, 0], values[:, left].mean(axis=1) / 0.008)
    np.testing.assert_allclose(responses.rate_hz, values.mean(axis=1) / 0.008)


def test_responses_that_are_chosen_keep_their_readouts(recording: Recording, halves: Readouts) -> None:
    responses = extract_responses(recording, readouts=halves)
    some = responses.only([3, 1])
    np.testing.assert_array_equal(some.read_of(0), responses.read_of(3))
    # Each response that is drawn anew is one of its condition, with both of its readouts.
    anew = responses.bootstrapped(np.random.default_rng(0))
    for condition in range(len(responses.conditions)):
        known = set(map(tuple, responses.read_of(condition).tolist()))
        assert set(map(tuple, anew.read_of(condition).tolist())) <= known
    with pytest.raises(Mismatch, match=r"readout_hz: expected shape"):
        replace(responses, readout_hz=responses.rate_hz)
    with pytest.raises(Mismatch, match="readout_hz: expected if, and only if, readouts"):
        replace(responses, readout_hz=None)


@pytest.mark.parametrize("part", [0.05, 0.9])
def test_conditions_that_move_readouts_together_are_warned_of(part: float) -> None:
    """Of two readouts one follows the condition; the other does the same, or the opposite with some probability."""
    rng, source = np.random.default_rng(0), SyntheticCulture(1, channels=2, patterns=200).record()
    responses = extract_responses(source, burst_threshold=1, readouts=readouts_on("halves", source.channels))
    left = responses.condition % 2 + rng.normal(0, 0.3, len(responses))
    opposite = rng.random(len(responses)) < part
    both_hz = np.stack([left, np.where(opposite, 1 - left, left)], axis=-1)
    found = list(_readouts(replace(responses, readout_hz=both_hz)))
    assert [finding.name for finding in found] == (["readouts-alike"] if part < 0.5 else [])
    assert all("animat record --places corners" in finding.message for finding in found)
    others = replace(responses.readouts, names=("upper", "lower"))
    own = list(_readouts(replace(responses, readout_hz=both_hz, readouts=others)))
    assert all("readouts upper and lower: " in each.message and "--places FILE" in each.message for each in own)


def test_few_responses_cannot_tell_whether_conditions_separate_readouts() -> None:
    source = SyntheticCulture(1, channels=2, patterns=40).record()
    responses = extract_responses(source, burst_threshold=1, readouts=readouts_on("halves", source.channels))
    # Of 40 responses 28 are high in the left readout, of the first condition 16; 20 are in the right one.
    number = np.zeros(len(responses), np.int64)
    for c in range(len(responses.conditions)):
        number[responses.condition == c] = np.arange(40)
    left = number < np.where(responses.condition == 0, 16, 28)
    both_hz = np.stack([left, number % 2 == 0], axis=-1).astype(np.float64)
    (found,) = _readouts(replace(responses, readout_hz=both_hz))
    assert "there are too few responses to know if the conditions separate" in found.message


def test_a_series_has_the_readouts_of_its_first_recording(recording: Recording, halves: Readouts) -> None:
    later = replace(recording, start_min=10.0)
    assert [each.readouts for each in extract_series([recording, later], readouts="halves")] == [halves] * 2
    rows = np.flatnonzero(np.arange(len(recording.channels)) != 5)
    gone = recording.channels.electrode[5]
    columns = {name: getattr(recording.channels, name)[rows] for name in ("label", "electrode", "x_um", "y_um")}
    kept = recording.spike_channels != 5
    fewer = replace(
        later,
        channels=Channels(**columns),
        spike_times_s=recording.spike_times_s[kept],
        spike_channels=np.searchsorted(rows, recording.spike_channels[kept]),
    )
    with pytest.raises(Mismatch, match=rf"^readouts: .*none for 1 of its 16 \({gone}\); 31 are read .* at 10 min\)$"):
        extract_series([recording, fewer], readouts="halves")


def test_channels_that_cannot_be_cut_are_refused(recording: Recording) -> None:
    channels = recording.channels
    for name, value, words in (
        ("electrode", UNKNOWN, "electrodes are known"),
        ("x_um", np.nan, "positions are known"),
    ):
        column = getattr(channels, name).copy()
        column[0] = value
        with pytest.raises(InvalidArgument, match=f"readouts: .*{words}"):
            readouts_on("halves", replace(channels, **{name: column}))


def test_names_of_readouts_are_known_or_refused(recording: Recording) -> None:
    assert readouts_on("all", recording.channels) == ALL
    with pytest.raises(InvalidArgument, match="expected all, halves, quadrants or groups of electrodes, got 'thirds'"):
        readouts_on("thirds", recording.channels)
    with pytest.raises(InvalidArgument, match=r"^electrodes: expected a list, got 1$"):
        Readouts(("a", "b"), (1, 2))  # type: ignore[arg-type]
    with pytest.raises(
        InvalidArgument, match=r"^electrodes: expected a group of electrodes for each of the names \('a',\), got none$"
    ):
        Readouts(("a",))


def test_readouts_come_from_a_file_and_go_through_json(tmp_path: Path) -> None:
    file = tmp_path / "groups.json"
    file.write_text('{"wing": [7, 3], "body": [1, 3]}')
    readouts = read_readouts(file)
    assert readouts == Readouts(("wing", "body"), ((3, 7), (1, 3))) and count_readouts(readouts) == 2
    assert isinstance(readouts, Readouts)
    # In the order of the commands, whatever the order of the names.
    again = Readouts.from_dict(json.loads(json.dumps(readouts.to_dict(), sort_keys=True)))
    assert again == readouts and Readouts.from_dict(ALL.to_dict()) == ALL
    assert read_readouts("all") == ALL and read_readouts("halves") == "halves"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[[1], [2]]", ": expected all, halves, quadrants, or groups of electrodes as JSON"),
        ("null", ": expected all, halves, quadrants, or groups of electrodes as JSON"),
        ("{", ": expected JSON, got malformed text"),
        ("{}", ".names: expected at least 1, got"),
        ('{"a": []}', ".a: expected at least 1, got"),
        ('{"a": [1], "b": [1.5]}', ".b: expected a whole number, got 1.5"),
        ('{"a": 1}', ".a: expected a list, got 1"),
        ('{"": [1]}', ".names: expected at least 1 character, got ''"),
        ('{"a": [1], "a": [2]}', ": expected each name once, got a twice"),
        ('{"\\n": [1]}', ".names: expected a different printable name for each group of electrodes (1 in all)"),
    ],
)
def test_a_file_of_no_readouts_is_named(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "groups.json").write_text(text)
    with pytest.raises(InvalidFile) as raised:
        read_readouts(tmp_path / "groups.json")
    assert f"groups.json: readouts{expected}" in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(InvalidFile, match="readouts: expected all, halves, quadrants or a file of groups"):
        read_readouts("thirds")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (5, ": expected a table, got 5"),
        ({"names": ["a"]}, r".electrodes: expected a group of electrodes for each of the names \('a',\), got none"),
        ({"names": "ab", "electrodes": [[1], [2]]}, ".names: expected a list, got 'ab'"),
        ({"names": ["a"], "electrodes": [1]}, ".electrodes: expected a list, got 1"),
    ],
)
def test_data_of_no_readouts_are_refused(data: object, expected: str) -> None:
    with pytest.raises(InvalidArgument, match=f"^readouts{expected}"):
        Readouts.from_dict(data)
