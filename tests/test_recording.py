"""`Recording`: what it refuses, its immutability and equality. Hand-made cases."""

from __future__ import annotations

import dataclasses
from datetime import datetime
from typing import Any

import numpy as np
import pytest

from animat.errors import InvalidArgument, UnusableData
from animat.recordings.findings import Finding, merged
from animat.recordings.metadata import from_metadata, to_metadata
from animat.recordings.quality import recording_findings
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.stimulation.protocol import PAPER, Presentation
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN


def channels(n: int = 3) -> Channels:
    return Channels(np.arange(n).astype(str), np.arange(n), np.zeros(n), np.zeros(n))


def stimuli(**changes: Any) -> Stimuli:
    table = {
        "time_s": [0.0, 1.0],
        "frequency_hz": [5.0, np.nan],
        "pattern": [0, UNKNOWN],
        "electrodes": [[1, 2], [3, UNKNOWN]],
        "presentation": [0, 1],
    }
    return Stimuli(**(table | changes))


def recording(**changes: Any) -> Recording:
    parts: dict[str, Any] = {
        "spike_times_s": [-1.0, 0.5, 0.5],
        "spike_channels": [2, 0, 1],
        "channels": channels(),
        "stimuli": stimuli(),
        "sampling_rate_hz": np.nan,
        "start_s": -1.0,
        "duration_s": 3.0,
    }
    return Recording(**(parts | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spike_times_s": [0.0, np.nan, 1.0]}, "spike_times_s: expected finite times in seconds, got 1 of 3"),
        ({"spike_times_s": [0.0, 1.0, 0.5]}, "spike_times_s: expected times that do not fall"),
        ({"spike_times_s": [0.0, 1.0]}, "spike_channels: expected 2 values"),
        ({"spike_times_s": [[0.0], [0.5], [1.0]]}, r"spike_times_s: expected a column of values .* got shape \(3, 1\)"),
        ({"spike_channels": [0, 1, 3]}, r"rows of the channel table \(0 to 2\), got 3 \(1 spikes on unknown"),
        ({"spike_channels": [0, 1, -1]}, "rows of the channel table"),
        ({"spike_channels": [0, 1, -0.5]}, "spike_channels: expected whole numbers, got -0.5"),
        ({"spike_channels": np.array([0, np.nan, 1])}, "spike_channels: expected whole numbers, got nan"),
        ({"duration_s": 1.0}, r"spike_times_s: expected times within the recording \(-1 to 0 s\)"),
        ({"duration_s": -1.0}, "start_s, duration_s: expected finite seconds"),
        ({"start_s": np.nan}, "start_s, duration_s: expected finite seconds"),
        ({"start_min": np.nan}, "start_min: expected finite minutes within a century, got nan"),
        ({"sampling_rate_hz": 0.0}, "sampling_rate_hz: expected a positive rate up to 1e.09 Hz, or NaN"),
    ],
)
def test_a_recording_refuses_impossible_values(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UnusableData, match=message):
        recording(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_s": [1.0, 0.0]}, "stimuli.time_s: expected times that do not fall"),
        (
            {"frequency_hz": [5.0, -5.0]},
            "stimuli.frequency_hz: expected positive frequencies up to 1e.09 Hz, or NaN, got -5",
        ),
        ({"frequency_hz": [0.0, 5.0]}, "expected positive frequencies"),
        ({"electrodes": [1, 2]}, r"stimuli.electrodes: expected shape \(stimuli, electrodes\)"),
        ({"presentation": [1, 0]}, "stimuli.presentation: expected numbers that never fall over time"),
        ({"pattern": [1]}, "pattern: expected 2 values"),
        ({"pattern": [1, np.nan]}, "pattern: expected whole numbers, got nan"),
        ({"presentation": [1, 1.9]}, "presentation: expected whole numbers, got 1.9"),
    ],
)
def test_a_stimulus_table_refuses_impossible_values(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UnusableData, match=message):
        stimuli(**changes)


def test_a_presentation_refuses_impossible_values() -> None:
    with pytest.raises(InvalidArgument, match="pulses: expected at least 1, got 0"):
        Presentation("mixed", 0)
    with pytest.raises(InvalidArgument, match="order: expected 'blocked' or 'mixed'"):
        Presentation("shuffled")  # type: ignore[arg-type]


def test_a_recording_is_immutable_and_copies_its_inputs() -> None:
    times = np.array([-1.0, 0.5, 0.5])
    made = recording(spike_times_s=times, spike_channels=[2, 1, 0])
    times[0] = 7.0
    assert made.spike_times_s[0] == -1.0
    for array in (made.spike_times_s, made.spike_channels, made.stimuli.time_s, made.channels.x_um):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.start_s = 0.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        made.provenance["a"] = "b"  # type: ignore[index]


def test_simultaneous_spikes_have_one_order() -> None:
    assert recording(spike_channels=[2, 1, 0]).equals(recording(spike_channels=[2, 0, 1]))
    assert not recording(spike_channels=[2, 0, 0]).equals(recording(spike_channels=[2, 0, 1]))


@pytest.mark.parametrize(
    "changes",
    [
        {"start_min": 1.0},
        {"sampling_rate_hz": 20_000.0},
        {"presentation": Presentation("mixed")},
        {"provenance": {"source": "elsewhere"}},
        {"protocol": PAPER},
        {"findings": (Finding("a", "note", "b"),)},
        {"stimuli": stimuli(frequency_hz=[5.0, 5.0])},
        {"stimuli": stimuli(electrodes=[[1, 2, UNKNOWN], [3, UNKNOWN, UNKNOWN]])},
        {"channels": channels(4)},
    ],
)
def test_recordings_that_differ_in_any_value_are_not_equal(changes: dict[str, Any]) -> None:
    assert recording().equals(recording())
    assert not recording(**changes).equals(recording())


def test_the_response_is_read_after_the_last_pulse_of_a_trial() -> None:
    table = Stimuli(np.arange(5.0), np.full(5, 5.0), np.zeros(5), np.zeros((5, 1)), np.array([0, 0, 0, 4, 4]))
    assert table.is_last_of_presentation.tolist() == [False, False, True, False, True]


def test_provenance_protocol_and_findings_survive_a_file() -> None:
    noted = (Finding("a-thing", "warning", "something: odd", 0.1), Finding("another", "note", "less odd"))
    words = {"source": "virtual culture: of a test", "seed": "7", "of a rig": "its: words"}
    made = recording(provenance=words, protocol=PAPER, culture=RecordedCulture("virtual", 7), findings=noted)
    again = from_metadata(to_metadata(made))
    assert recording(**again).equals(made)
    assert from_metadata({"source": "CL1 (device)", "pattern_seed": "3"})["culture"] == RecordedCulture("cl1", 3)
    given = {"source": "CL1 (the SDK's simulator) by animat.cultures.cl1", "pattern_seed": "none: they were given"}
    assert from_metadata(given)["culture"] == RecordedCulture("cl1", None, is_simulated=True)
    assert from_metadata({"source": "MaxOne by animat.cultures.maxone"})["culture"] == RecordedCulture("maxone")
    assert from_metadata({"source": "rig.h5", "seed": "1"})["culture"] is None
    with pytest.raises(InvalidArgument, match="protocol: expected JSON"):
        from_metadata({"protocol": "mixed"})
    for values in ("many", '{"note: another": "many"}'):
        with pytest.raises(InvalidArgument, match=r"^values of findings.*: expected "):
            from_metadata({"values of findings": values})
    found = recording_findings(recording(findings=noted))
    assert [(f.name, f.severity, f.message) for f in found[:2]] == [
        ("a-thing", "warning", "something: odd"),
        ("another", "note", "less odd"),
    ]
    assert [f.name for f in found[2:]] == ["presentation-unknown"]


@pytest.mark.parametrize(
    ("source", "culture"),
    [
        ("CL1 (device) by animat.cultures.cl1", RecordedCulture("cl1")),
        ("CL1 (the SDK's simulator) by animat.cultures.cl1", RecordedCulture("cl1", None, is_simulated=True)),
        ("MaxOne by animat.cultures.maxone", RecordedCulture("maxone")),
        ("replay of recordings by animat.cultures.replay", RecordedCulture("replay")),
        ("CL1_day3.h5", None),
        ("MaxOne by animat.csv", None),
        ("virtual culture.csv", None),
    ],
)
def test_a_file_that_is_named_after_a_kind_of_culture_is_not_of_it(
    source: str, culture: RecordedCulture | None
) -> None:
    assert from_metadata({"source": source})["culture"] == culture


def test_two_findings_of_one_name_are_both_kept() -> None:
    noted = (Finding("columns-left-out", "note", "x of a.csv"), Finding("columns-left-out", "note", "y of b.csv"))
    assert merged(noted) == (Finding("columns-left-out", "note", "x of a.csv; y of b.csv"),)
    # Their values cannot be one value, but a finding that is alone keeps its own.
    valued = [dataclasses.replace(finding, value=1.0) for finding in noted]
    alone = Finding("start-unknown", "warning", "the start is not stated", 3.5)
    assert merged([*valued, alone]) == (*merged(noted), alone)


def test_problems_in_the_data_are_reported() -> None:
    silent = recording(spike_times_s=[], spike_channels=[], stimuli=Stimuli([], [], [], np.empty((0, 1)), []))
    assert {f.name: f.severity for f in recording_findings(silent)} == {"no-stimuli": "refuse", "no-spikes": "refuse"}
    electrodes = np.full((2, 2), UNKNOWN)
    partly = recording(spike_channels=[0, 0, 0], stimuli=stimuli(electrodes=electrodes))
    found = {f.name: f.value for f in recording_findings(partly)}
    assert found == {"silent-channels": 2.0, "stimulus-electrodes-unknown": 2.0, "presentation-unknown": None}


def test_the_date_of_a_recording_has_a_time_zone() -> None:
    with pytest.raises(UnusableData, match="recorded_at: expected a date with a time zone, got 2026-11-29 12:00:00"):
        recording(recorded_at=datetime(2026, 11, 29, 12))
