"""Recordings of several cultures, or of other channels, and policies of another culture are reported."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from animat.cli import main
from animat.errors import Mismatch
from animat.evaluation.transfer import timeline_differences
from animat.neurons.timeline import fit_timeline, load_timeline, save_timeline
from animat.recordings.conversion import Origin, convert_recording
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.reading import read_recording
from animat.recordings.recorded_culture import RecordedCulture, names_in
from animat.recordings.recording import Channels, Recording
from animat.responses.extraction import extract_series
from animat.responses.quality.one_culture import series_findings, series_mismatch, unlike_finding
from animat.responses.responses import Responses
from animat.training.policy import Policy
from rig_files import mapping_table, spike_table, write_cl1, write_maxwell
from synthetic_recordings import synthetic_recording
from test_responses import recording
from test_run_on_recordings import FIVE_HZ, policy_of

RIGS = [
    RecordedCulture("virtual", 1),
    RecordedCulture("virtual", 2),
    RecordedCulture("synthetic", 1),
    RecordedCulture("maxone"),
    RecordedCulture("cl1", 1, names=(("chip_id", "A"), ("system_id", "s"))),
    RecordedCulture("cl1", 1, names=(("chip_id", "B"), ("system_id", "s"))),
    RecordedCulture("cl1", 1, is_simulated=True),
    RecordedCulture(names=(("subject_id", "c1"),)),
    RecordedCulture(names=(("subject_id", "c2"), ("well", "well000"))),
    RecordedCulture(names=(("well", "well001"),)),
]
"""Each is another culture than each other one, as far as both state the same thing."""
NOT_COMPARABLE = {(3, 7), (3, 8), (3, 9), (4, 7), (4, 8), (4, 9), (5, 7), (5, 8), (5, 9), (6, 7), (6, 8), (6, 9)} | {
    (simulated, file) for simulated in (0, 1, 2) for file in (7, 8, 9)
}


def test_cultures_differ_by_what_is_known_of_both() -> None:
    for (i, one), (j, other) in itertools.combinations_with_replacement(enumerate(RIGS), 2):
        difference = one.difference(other)
        expected = i != j and (i, j) not in NOT_COMPARABLE | {(7, 9)}
        assert (difference is not None) == expected, (one, other)
        assert other.difference(one) == (difference and difference[::-1])
    assert RIGS[0].difference(RIGS[1]) == ("virtual culture 1", "virtual culture 2")
    assert RIGS[3].difference(RIGS[4]) == ("a MaxOne", "a CL1")
    assert RIGS[4].difference(RIGS[5]) == ("chip_id A", "chip_id B")
    # A CL1's seed draws its patterns, and a replay responds from any recording.
    assert RecordedCulture("cl1", 1).difference(RecordedCulture("cl1", 2)) is None
    assert all(RecordedCulture("replay").difference(each) is None for each in RIGS)


def plate(path: Path, well: str, chip: str) -> Path:
    """A MaxWell file with 20 channels; newer versions state the chip."""
    rng = np.random.default_rng(1)
    seconds, channels = np.sort(rng.uniform(0, 5, 400)), rng.integers(0, 20, 400)
    table = spike_table(seconds.tolist(), channels.tolist())
    write_maxwell(path, mapping=mapping_table(range(20), range(100, 120)), spikes=table, parts=[(well, "rec0000")])
    with h5py.File(path, "a") as file:
        file["wellplate/id"] = np.array([chip.encode()])
    return path


def test_chips_wells_and_subjects_are_read_from_files(tmp_path: Path) -> None:
    read = read_recording(plate(tmp_path / "a.raw.h5", "well003", "P001"))
    assert read.culture == RecordedCulture(names=(("chip_id", "P001"), ("well", "well003")))
    # Where a file lists wells by recording, they are the same wells.
    with h5py.File(tmp_path / "a.raw.h5", "a") as file:
        file["recordings/rec0000/well003"] = file["wells/well003/rec0000"]
        del file["wells"]
    assert read_recording(tmp_path / "a.raw.h5").culture == read.culture
    cl1 = write_cl1(tmp_path / "cl1.h5", spikes=[(10, 1)], stims=[(5, 2)])
    assert read_recording(cl1).culture is None
    with h5py.File(cl1, "a") as file:
        file.attrs["chip_id"], file.attrs["cell_batch_id"] = "chip 7", "batch 2"
    read = read_recording(cl1)
    assert read.culture == RecordedCulture(names=(("cell_batch_id", "batch 2"), ("chip_id", "chip 7")))
    with h5py.File(cl1, "a") as file:
        file.attrs["system_id"] = "cl-sdk"
    assert read_recording(cl1).culture == read.culture
    # NWB keeps them; a subject that was named, and only that, is one.
    converted = convert_recording(cl1, tmp_path / "named.nwb", Origin(subject_id="culture-7"))
    again = read_recording(tmp_path / "named.nwb")
    assert again.culture == converted.culture
    assert again.culture == RecordedCulture(names=(("subject_id", "culture-7"), *read.culture.names))
    for nameless in ("unknown", "Unknown", "N/A", " "):
        assert names_in({"subject_id": nameless, "chip_id": "chip 7"}) == (("chip_id", "chip 7"),)
    assert names_in({"subject_id": "dish\n A "}) == (("subject_id", "dish A"),)
    write_nwb(synthetic_recording(1, patterns=5, channels=16), tmp_path / "unnamed.nwb")
    assert read_recording(tmp_path / "unnamed.nwb").culture == RecordedCulture("synthetic", 1)


def named(start_min: float, names: dict[str, str], **changes: Any) -> Recording:
    """As read from a laboratory's file that names what was recorded."""
    made = synthetic_recording(1, patterns=20, channels=32, start_min=start_min)
    return replace(made, culture=RecordedCulture(names=tuple(names.items())), provenance=names, **changes)


def responses_of(*recordings: Recording) -> list[Responses]:
    return extract_series(recordings, allow=["several-cultures"])


@pytest.mark.parametrize(
    "name",
    [
        *("subject_id", "well"),
        *(pytest.param(name, marks=pytest.mark.oracle) for name in ("cell_batch_id", "chip_id", "system_id")),
    ],
)
def test_recordings_of_two_real_cultures_are_not_one_series(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "recordings"
    for minute, value in ((0.0, "first"), (10.0, "second")):
        write_nwb(named(minute, {name: value}), folder / f"at {minute:.0f} min.nwb")
    train = ["train", "cartpole", "--recordings", str(folder), "--out", str(tmp_path / "policies")]
    assert main(train) == 1
    words = (
        f"expected recordings of one culture, got {name} first (at 0 min) and {name} second (at 10 min); "
        "leave out all but one culture's"
    )
    error = capsys.readouterr().err
    assert (
        f"animat: --recordings: {words} (to allow it: --allow several-cultures, in Python allow=['several-cultures'])"
        in error
    )
    assert not (tmp_path / "policies").exists()
    # Each is usable by itself, and it is said that the two do not belong together.
    assert main(["inspect", str(folder), "--json"]) == 1
    *printed, last = capsys.readouterr().out.splitlines()
    assert "all together:" in printed and f"  refuse   several-cultures: {words}" in printed
    inspected = json.loads(last)
    assert [finding["name"] for finding in inspected["together"]] == ["several-cultures"]
    assert inspected["unusable"] == []
    # They have a value, as those of each recording.
    assert inspected["together"][0]["value"] is None


@pytest.mark.oracle
@pytest.mark.parametrize(
    "start_min, frequencies_hz, words",
    [
        (10.0, None, None),
        (0.0, None, "start_min: expected recordings at different minutes, got two at 0 min"),
        (10.0, (5.0, 20.0), "conditions: expected the same in all recordings, got 5 Hz, 10 Hz, 20 Hz, 40 Hz, 80 Hz at"),
    ],
)
def test_inspect_reports_what_training_refuses(
    start_min: float,
    frequencies_hz: tuple[float, ...] | None,
    words: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stimulated = {} if frequencies_hz is None else {"frequencies_hz": frequencies_hz}
    folder = tmp_path / "recordings"
    write_nwb(named(0.0, {}), folder / "first.nwb")
    second = synthetic_recording(1, patterns=20, channels=32, start_min=start_min, **stimulated)
    write_nwb(second, folder / "second.nwb")
    # It is no fault of one recording, and they may be meant apart: the status is 0.
    assert main(["inspect", str(folder), "--json"]) == 0
    together = json.loads(capsys.readouterr().out.splitlines()[-1])["together"]
    assert [finding["name"] for finding in together] == ([] if words is None else ["not-a-series"])
    if words is not None:
        assert words in together[0]["message"]
        train = ["train", "cartpole", "--recordings", str(folder), "--out", str(tmp_path / "policies")]
        assert main(train) == 1
        assert ("both start at 0 min" if start_min == 0.0 else words) in capsys.readouterr().err


def test_other_channels_are_found_by_electrode_and_otherwise_by_label() -> None:
    first = named(0.0, {})
    n, electrode = len(first.channels), first.channels.electrode
    assert not list(series_findings(responses_of(first, named(10.0, {}))))

    def found(channels: Channels) -> list[tuple[str, float | None]]:
        second = replace(first, channels=channels, start_min=10.0)
        return [(finding.name, finding.value) for finding in series_findings(responses_of(first, second))]

    moved = replace(first.channels, electrode=np.concatenate([electrode[3:], 26_000 + np.arange(3)]))
    assert found(moved) == [("other-channels", 3.0)]
    # The same electrodes in another order, or under other names, are the same channels.
    assert found(replace(first.channels, electrode=electrode[::-1].copy())) == []
    assert found(replace(first.channels, label=np.array([f"unit {i}" for i in range(n)]))) == []
    nowhere = replace(first.channels, electrode=np.full(n, -1))
    assert found(nowhere) == []
    assert found(replace(nowhere, label=np.array([f"unit {i}" for i in range(n)]))) == [("other-channels", float(n))]


def test_channels_that_differ_in_any_recording_are_counted() -> None:
    first = named(0.0, {})
    electrode = first.channels.electrode
    others = [26_000 + electrode[:2], electrode[2:]], [electrode[:-3], 26_100 + electrode[-3:]]
    series = [
        replace(first, channels=replace(first.channels, electrode=np.concatenate(other)), start_min=10.0 * (i + 1))
        for i, other in enumerate(others)
    ]
    (finding,) = series_findings(responses_of(first, *series))
    assert (finding.name, finding.value) == ("other-channels", 5.0)
    assert finding.message.startswith("5 of the 32 channels are not the same in all recordings")


def test_a_policy_knows_its_culture_and_another_one_is_reported(tmp_path: Path) -> None:
    of_c1, of_c2 = (fit_timeline(responses_of(named(0.0, {"subject_id": name}))) for name in ("c1", "c2"))
    stored = load_timeline(save_timeline(of_c1, tmp_path / "simulators.safetensors"))
    assert stored.culture == of_c1.culture == RecordedCulture(names=(("subject_id", "c1"),))
    culture = {"kind": None, "seed": None, "is_simulated": False, "names": [["subject_id", "c1"]]}
    policy = replace(policy_of(0, FIVE_HZ), conditions=of_c1.conditions, provenance={"culture": culture})
    policy.save(tmp_path / "p0.safetensors")
    policy = Policy.load(tmp_path / "p0.safetensors")
    assert policy.culture == of_c1.culture

    def said(of: Policy) -> list[str]:
        noticed = timeline_differences(of, of_c2)
        return [finding.message for finding in noticed if finding.name == "other-culture"]

    assert said(policy) == [
        "the policies were trained on recordings of subject_id c1, but these are of subject_id c2: another culture "
        "responds differently"
    ]
    # What only a later recording states is known too.
    minutes = enumerate(({"subject_id": "c1"}, {"subject_id": "c1", "chip_id": "7"}))
    of_both = fit_timeline(responses_of(*(named(10.0 * i, names) for i, names in minutes)))
    assert of_both.culture == RecordedCulture(names=(("subject_id", "c1"), ("chip_id", "7")))
    # Of another culture, whose finding was allowed, nothing is taken over.
    others = enumerate(({"subject_id": "c1"}, {"subject_id": "c2", "chip_id": "7"}))
    of_two = fit_timeline(responses_of(*(named(10.0 * i, names) for i, names in others)))
    assert of_two.culture == of_c1.culture
    # Policies of earlier versions do not state it.
    assert said(replace(policy, provenance={})) == []
    assert not [each for each in timeline_differences(policy, of_c1) if each.name == "other-culture"]


@pytest.mark.parametrize(("start_min", "over_s"), [(0.3, 12.0), (0.5, None), (10.0, None)])
def test_recordings_that_overlap_in_time_cause_a_warning(start_min: float, over_s: float | None) -> None:
    spikes = [(t + 0.005 + 0.0001 * i, i) for t in range(1, 29) for i in range(4)]
    first = replace(recording(spikes, np.arange(1.0, 29.0), 4, 30.0), start_min=0.0)
    series = extract_series([first, replace(first, start_min=start_min)])
    found = {finding.name: finding for finding in series_findings(series)}
    assert ("recordings-overlap" in found) == (over_s is not None)
    if over_s is not None:
        assert found["recordings-overlap"].value == pytest.approx(over_s)
        assert "that at 0 min lasts 12 s longer than to the next, at 0.3 min" in found["recordings-overlap"].message


def test_names_of_patterns_that_files_number_differently_are_no_series(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    of_days: list[list[Any]] = [["left", "right"], ["right", "up"], ["right", "left"], ["left", "right", "up"], [0, 1]]
    for day, names in enumerate(of_days):
        time_s, pattern = 0.5 + 0.25 * np.arange(80), rng.choice(names, 80)
        spikes_s = np.sort(np.concatenate([time_s + 0.005, rng.uniform(0, 20, 200)]))
        columns = {"spike_time_s": spikes_s, "spike_channel": rng.integers(0, 4, 280), "channel_label": np.arange(4)}
        stimuli = {"stimulus_time_s": time_s, "stimulus_pattern": pattern}
        np.savez(tmp_path / f"{day}.npz", **columns, **stimuli, start_min=60.0 * day, duration_s=21.0)
    recordings = [read_recording(tmp_path / f"{day}.npz") for day in range(5)]
    first, other, same, _, numbered = extract_series(recordings, "pattern")
    assert series_mismatch([first, same]) is None
    (found,) = unlike_finding([first, other])
    expected = "patterns: expected the same names in all recordings"
    assert f"{expected}, got 'left' at 0 min and 'right' at 60 min for pattern 0" in found.message
    with pytest.raises(Mismatch, match=f"^{expected}"):
        fit_timeline([first, other])
    assert f"{expected}, got 'left' at 0 min and 'none' at 240 min" in str(series_mismatch([first, numbered]))
    # Not where conditions are others, nor by a pattern that only one of them has.
    assert series_mismatch([replace(first, by="frequency"), replace(other, by="frequency")]) is None
    two, _, _, three, _ = extract_series(recordings, "pattern:0,1")
    assert series_mismatch([two, three]) is None
