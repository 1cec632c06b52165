"""Readers of MaxWell, CL1 and NWB from other programs. Oracles: files made row by row, pynwb's writer."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from animat.cultures.devices.cl1 import CL1Culture
from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.conversion import read_traces
from animat.recordings.formats.cl1_layout import SITES
from animat.recordings.formats.hdf5_formats import open_traces, read_hdf5
from animat.recordings.formats.stimulus_text import stimulus_columns
from animat.recordings.quality import recording_findings
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.stimulation.protocol import Presentation
from animat.tables import UNKNOWN
from rig_files import (
    BITS,
    FIRST_FRAME,
    event_table,
    mapping_table,
    packed_text,
    spike_table,
    write_cl1,
    write_maxwell,
    write_old_maxwell,
)

TABLE = mapping_table([3, 9, 40], [1000, 2000, 26_399])


def found(recording: Recording) -> dict[str, str]:
    return {finding.name: finding.message for finding in recording_findings(recording)}


def said(frequency: float, presentation: int) -> str:
    words = {"frequency_hz": frequency, "pattern": 2, "presentation": presentation, "electrodes": [909, 23_923]}
    return json.dumps({**words, "order": "mixed", "pulses": 2})


# --- MaxWell ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("linked", [False, True])
def test_maxwell_spikes_stimuli_and_electrodes(tmp_path: Path, linked: bool) -> None:
    path = write_maxwell(
        tmp_path / "no_ending",
        mapping=TABLE,
        spikes=spike_table([0.5, 1.25, 1.0], [9, 40, 3]),
        events=event_table([0.2, 0.4, 0.7, 0.9], [said(5, 0), said(5, 0), said(20, 1), said(20, 1)]),
        recorded=[3, 9, 40],
        linked=linked,
    )
    recording = read_recording(path)
    assert recording.spike_times_s.tolist() == [0.5, 1.0, 1.25]
    assert recording.channels.label[recording.spike_channels].tolist() == ["9", "3", "40"]
    assert recording.channels.electrode.tolist() == [1000, 2000, 26_399]
    assert recording.channels.x_um.tolist() == [1000 % 220 * 17.5, 2000 % 220 * 17.5, 219 * 17.5]
    assert recording.channels.y_um.tolist() == [4 * 17.5, 9 * 17.5, 119 * 17.5]
    stimuli = recording.stimuli
    np.testing.assert_allclose(stimuli.time_s, [0.2, 0.4, 0.7, 0.9], rtol=0, atol=1e-12)
    assert stimuli.frequency_hz.tolist() == [5, 5, 20, 20]
    assert stimuli.electrodes.tolist() == [[909, 23_923]] * 4
    assert stimuli.is_last_of_presentation.tolist() == [False, True, False, True]
    assert recording.presentation == Presentation("mixed", 2)
    assert (recording.sampling_rate_hz, recording.duration_s) == (20_000.0, 10.0)
    assert recording.provenance["recorded_at"] == "2023-11-14T22:13:20.000+00:00"


def test_maxwell_events_with_unknown_text_are_read_without_it(tmp_path: Path) -> None:
    words = {"frequency_hz": 20, "order": [1, 2], "pulses": {"a": 1}, "electrodes": {"b": 2}, "pattern": "x"}
    path = write_maxwell(
        tmp_path / "a.h5",
        mapping=mapping_table([0, 9, -1, 8], [0, 2000, 7, -1]),
        spikes=spike_table([0.5], [0]),
        events=event_table([0.2, 0.4], [json.dumps(words)] * 2),
    )
    recording = read_recording(path)
    assert recording.stimuli.frequency_hz.tolist() == [20, 20]
    assert recording.presentation is None
    # Channels and electrodes count from 0; -1 is none.
    assert recording.channels.electrode[recording.spike_channels].tolist() == [0]
    assert recording.channels.label.tolist() == ["0", "9"]


def test_maxwell_channels_listed_twice_are_one_channel(tmp_path: Path) -> None:
    twice = mapping_table([3, 9, 9, 40, 40], [1000, 2000, 2000, 26_399, 7])
    path = write_maxwell(
        tmp_path / "a.h5", mapping=twice, spikes=spike_table([0.5, 0.6], [9, 40]), recorded=[3, 9, 40], events=None
    )
    recording = read_recording(path)
    assert recording.channels.label.tolist() == ["3", "9", "40"]
    assert recording.channels.electrode.tolist() == [1000, 2000, 26_399]
    assert "repeats 2 channels; each counts once" in found(recording)["duplicate-channels"]
    assert "another electrode (1 times)" in found(recording)["duplicate-channels"]
    assert "no-stimuli" in found(recording)


def test_maxwell_only_recorded_channels_count_and_spikes_elsewhere_are_counted(tmp_path: Path) -> None:
    path = write_maxwell(
        tmp_path / "a.h5", mapping=TABLE, spikes=spike_table([0.5, 0.6, 0.7], [9, 40, 1023]), recorded=[9, 3]
    )
    recording = read_recording(path)
    assert recording.channels.label.tolist() == ["3", "9"]
    assert recording.spike_times_s.tolist() == [0.5]
    (stray,) = (each for each in recording.findings if each.name == "spikes-not-routed")
    assert stray.severity == "warning" and "2 of 3 spikes are on channels without a routed electrode" in stray.message


def test_maxwell_frames_that_are_missing_are_counted_and_the_clock_starts_with_the_first(tmp_path: Path) -> None:
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=spike_table([0.5], [9]), recorded=[9])
    with h5py.File(path, "r+") as file:
        groups = file["wells/well000/rec0000/groups"]
        whole = groups["routed/frame_nos"][:]
        del groups["routed/frame_nos"]
        groups["routed/frame_nos"] = np.delete(whole, np.s_[100:400])
        groups["shorter/channels"], groups["shorter/frame_nos"] = np.array([3], "<u4"), whole[50:1000]
    recording = read_recording(path)
    assert (recording.spike_times_s.tolist(), recording.start_s, recording.duration_s) == ([0.5], 0.0, 10.0)
    (lost,) = (each for each in recording.findings if each.name == "frames-lost")
    assert (lost.value, lost.severity) == (300.0, "warning") and lost.message.startswith("300 frames (0.015 s) are")


def test_maxwell_events_without_patterns_in_their_text_have_their_number(tmp_path: Path) -> None:
    for words, numbers, pattern in (
        ("frequency 5", [3, 8, 3], [3, 8, 3]),
        ("pattern 1", [3, 8, 3], [1, 1, 1]),
        # The same for all says nothing.
        ("frequency 6", [3, 3, 3], [UNKNOWN] * 3),
    ):
        events = event_table([0.1, 0.2, 0.3], [words] * 3)
        given: dict[str, Any] = {"mapping": TABLE, "spikes": spike_table([0.5], [9]), "events": events, "recorded": [9]}
        events["eventid"] = numbers
        recording = read_recording(write_maxwell(tmp_path / f"{words}.h5", **given))
        assert recording.stimuli.pattern.tolist() == pattern
        assert ("stimulus_pattern" in recording.provenance) == (words == "frequency 5")
        # The vendor's examples, and animat, count the events.
        events["eventid"] = [1, 2, 3]
        counted = read_hdf5(write_maxwell(tmp_path / f"{words} counted.h5", **given))
        assert counted.stimuli.pattern.tolist() == (pattern if words == "pattern 1" else [UNKNOWN] * 3)


def test_what_is_in_the_text_of_some_pulses_only_is_not_guessed() -> None:
    def columns(*pulses: dict[str, Any]) -> dict[str, Any]:
        read = stimulus_columns([json.dumps(pulse) for pulse in pulses])
        return {name: value if isinstance(value, str | int) else value.tolist() for name, value in read.items()}

    # A trial ends where its number changes.
    assert columns({"presentation": 7}, {"presentation": 3}, {"presentation": 3}) == {
        "stimulus_presentation": [0, 1, 1]
    }
    assert columns({"presentation": 7}, {}, {"presentation": 3}) == {}
    assert columns({"presentation": 7}, {"presentation": 7}) == {}
    assert columns({"pattern": 2.5}, {"pattern": 3}) == {"stimulus_pattern": [UNKNOWN, 3]}
    assert columns({"frequency": 0}, {"frequency": -5}) == {}
    # Of several pulses it must be known which are a trial.
    trials = [{"order": "mixed", "pulses": pulses} for pulses in (1, 5)]
    assert columns(trials[0], trials[0]) == {"presentation_order": "mixed", "presentation_pulses": 1}
    assert columns(trials[1], trials[1]) == columns(*trials) == columns() == {}


@pytest.mark.parametrize(("number", "trial"), [([0] * 3, [0] * 3), ([0] * 6 + [1] * 3, [0] * 3 + [1] * 3 + [2] * 3)])
def test_trials_with_the_same_number_end_after_their_pulses(number: list[int], trial: list[int]) -> None:
    read = stimulus_columns([json.dumps({"presentation": n, "order": "mixed", "pulses": 3}) for n in number])
    assert read.pop("stimulus_presentation").tolist() == trial
    assert read == {"presentation_order": "mixed", "presentation_pulses": 3}


def test_maxwell_is_read_without_groups_or_mapping(tmp_path: Path) -> None:
    spikes = spike_table([0.5, 0.25], [9, 40])
    recording = read_recording(write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=spikes))
    assert recording.spike_times_s.tolist() == [0.0, 0.25]
    assert "the clock starts at the first spike" in found(recording)["clock-from-first-event"]
    recording = read_recording(write_maxwell(tmp_path / "b.h5", mapping=None, spikes=spikes))
    assert recording.channels.electrode.tolist() == [-1, -1]
    assert "the electrodes of channels are not known" in found(recording)["mapping-missing"]
    assert recording.provenance.keys() >= {"recorded_at"}
    with h5py.File(tmp_path / "b.h5", "r+") as file:
        file["wells/well000/rec0000/start_time"][:] = 1_700_000_000_000_000
        file["wellplate/id"] = np.array([7])
    # What cannot be a date, or a chip's name, is left out.
    assert read_recording(tmp_path / "b.h5").provenance.keys().isdisjoint({"recorded_at", "chip_id"})


def test_maxwell_without_spikes_says_what_to_do(tmp_path: Path) -> None:
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=None, recorded=[3])
    with pytest.raises(InvalidFile, match=r"expected spikes at /wells/well000/rec0000/spikes.*animat convert --raw"):
        read_recording(path)


def test_maxwell_with_several_recordings_lists_them(tmp_path: Path) -> None:
    parts = (("well000", "rec0000"), ("well001", "rec0000"))
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=spike_table([0.5], [9]), parts=parts, recorded=[9])
    with pytest.raises(InvalidFile, match=r"found 2: well000/rec0000, well001/rec0000; choose with --part NAME"):
        read_recording(path)
    assert read_recording(path, part="well001/rec0000").provenance["part"] == "well001/rec0000"
    with pytest.raises(InvalidFile, match=r"expected one of well000/rec0000.*got well9"):
        read_recording(path, part="well9")


def test_maxwell_events_of_several_types_are_not_guessed(tmp_path: Path) -> None:
    events = event_table([0.1, 0.2, 0.3], ["", "frequency 20 electrode 909", ""], [1, 2, 1])
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=spike_table([0.5], [9]), events=events, recorded=[9])
    with pytest.raises(InvalidFile, match=r"found 2: 1 \(2 events\), 2 \(1 events\); choose with --stimuli NAME"):
        read_recording(path)
    recording = read_recording(path, stimuli="2")
    assert found(recording)["events-left-out"] == "2 events of other types than 2 are left out"
    stimuli = recording.stimuli
    assert (stimuli.frequency_hz.tolist(), stimuli.electrodes.tolist()) == ([20.0], [[909]])
    # Numbers are of the events that were chosen.
    several = event_table([0.1, 0.2, 0.3, 0.4], [""] * 4, [2, 1, 1, 1])
    several["eventid"] = [9, 3, 8, 3]
    path = write_maxwell(tmp_path / "b.h5", mapping=TABLE, spikes=spike_table([0.5], [9]), events=several)
    assert read_recording(path, stimuli="1").stimuli.pattern.tolist() == [3, 8, 3]


def test_numbers_in_the_text_of_events_are_read_whole(tmp_path: Path) -> None:
    words = ["electrode 909.0 frequency 20.0", "electrode=-1 freq=2e1", "electrodes: 909,23923+7, pattern 3."]
    events = event_table([0.1, 0.2, 0.3], words)
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=spike_table([0.5], [9]), events=events, recorded=[9])
    stimuli = read_recording(path).stimuli
    np.testing.assert_array_equal(stimuli.frequency_hz, [20, 20, np.nan])
    assert stimuli.electrodes.tolist() == [[909, -1, -1], [-1, -1, -1], [909, 23923, 7]]
    assert stimuli.pattern.tolist() == [-1, -1, 3]
    words = ["electrodes 9 7 0.5 mA", "electrodes: 9, 7; pattern 2", "electrode 9 electrode 7", "electrode 9 20 Hz"]
    assert stimulus_columns(words)["stimulus_electrodes"].tolist() == [[9, 7], [9, 7], [9, 7], [9, -1]]


def test_maxwell_raw_without_the_plugin_spikes_still_read(tmp_path: Path) -> None:
    path = write_maxwell(
        tmp_path / "a.h5",
        mapping=TABLE,
        spikes=spike_table([0.0005], [9]),
        recorded=[3, 9, 40],
        raw=np.zeros((3, 400), "<u2"),
        compressed=True,
    )
    assert read_recording(path).spike_times_s.tolist() == [0.0005]
    with pytest.raises(
        InvalidFile, match=r"compressed by filter 32001.*not installed.*HDF5_PLUGIN_PATH.*spikes detected by the rig"
    ):
        read_traces(path)


def test_old_maxwell_reads_bits_as_stimuli(tmp_path: Path) -> None:
    bits = np.zeros(5, BITS)
    bits["frameno"] = FIRST_FRAME + np.array([2000, 2100, 4000, 4100, 4200])
    bits["bits"] = [1, 0, 2, 2, 0]
    given: dict[str, Any] = {"mapping": TABLE, "spikes": spike_table([0.11, 0.21], [9, 3]), "bits": bits}
    recording = read_recording(write_old_maxwell(tmp_path / "a.h5", **given))
    assert recording.stimuli.time_s.tolist() == [0.1, 0.2]
    assert recording.stimuli.pattern.tolist() == [1, 2]
    assert recording.spike_times_s.tolist() == [0.11, 0.21]
    assert recording.channels.electrode[recording.spike_channels].tolist() == [2000, 1000]
    assert "3 of 5 entries of /bits" in found(recording)["bits-not-rising"]
    bits["bits"] = [1, 0, 1, 1, 0]
    path = write_old_maxwell(tmp_path / "b.h5", mapping=TABLE, spikes=spike_table([0.11], [9]), bits=bits)
    assert read_recording(path).stimuli.pattern.tolist() == [UNKNOWN] * 2
    assert "frames-lost" not in found(recording)
    some_lost = read_hdf5(write_old_maxwell(tmp_path / "b.h5", **given, lost=9900))
    assert (some_lost.start_s, some_lost.stop_s) == (0.0, 0.5)
    assert found(some_lost)["frames-lost"].startswith("9,900 frames (0.495 s) are missing")


# --- CL1 -------------------------------------------------------------------------------------------------------------


# Frames that count from the start of the rig, also if that was less long before than the recording lasts.
@pytest.mark.parametrize("start", [0, 90_000_000, 240_000])
def test_cl1_spikes_and_stimuli_with_parameters_from_the_data_stream(tmp_path: Path, start: int) -> None:
    mark = tmp_path / "unpickled"
    path = write_cl1(
        tmp_path / "a",
        spikes=[(start + 50_000, 8), (start + 25_000, 62)],
        stims=[(start + 1000, 9), (start + 1000, 12), (start + 6000, 9), (start + 11_000, 20)],
        # The second text is longer than a byte can say. Entries are in any order.
        # Of two at the same time, the later one applies.
        stream=[
            (start + 10_000, packed_text(said(40, 1) + 300 * " ")),
            (start + 990, packed_text(said(20, 0))),
            (start + 990, packed_text(said(5, 0))),
        ],
        start=start,
        mark=mark,
    )
    recording = read_recording(path)
    assert not mark.exists()
    assert recording.spike_times_s.tolist() == [1.0, 2.0]
    assert recording.channels.electrode[recording.spike_channels].tolist() == [62, 8]
    stimuli = recording.stimuli
    assert stimuli.time_s.tolist() == [0.04, 0.24, 0.44]
    assert stimuli.electrodes.tolist() == [[9, 12], [9, -1], [20, -1]]
    assert stimuli.frequency_hz.tolist() == [5, 5, 40]
    assert stimuli.is_last_of_presentation.tolist() == [False, True, True]
    assert recording.presentation == Presentation("mixed", 2)
    assert (recording.sampling_rate_hz, recording.duration_s) == (25_000.0, 10.0)


def test_cl1_electrodes_of_a_stimulus_may_be_a_frame_or_two_apart(tmp_path: Path) -> None:
    stims = [(1000, 9), (1001, 11), (1002, 20), (1005, 9), (2000, 30), (2000, 31)]
    source = read_recording(write_cl1(tmp_path / "a.h5", spikes=[(1100, 9)], stims=stims))
    assert (source.stimuli.time_s * 25_000).round().tolist() == [1000, 1005, 2000]
    assert [{*row} - {-1} for row in source.stimuli.electrodes.tolist()] == [{9, 11, 20}, {9}, {30, 31}]


def test_cl1_ground_and_reference_count_neither_in_files_nor_in_animats_own_recordings(tmp_path: Path) -> None:
    spikes = [(5, 1), (6, 0), (7, 4), (8, 63), (9, 63), (10, 62)]
    recording = read_recording(write_cl1(tmp_path / "a.h5", spikes=spikes, stims=[(1, 2)]))
    own = CL1Culture().channels
    for name in ("label", "electrode"):
        assert getattr(recording.channels, name).tolist() == getattr(own, name).tolist()
    assert len(recording.channels) == 64 - 5
    assert recording.channels.electrode[recording.spike_channels].tolist() == [1, 62]
    said = found(recording)["spikes-not-on-electrodes"]
    assert said.startswith("4 of 6 spikes are on channels 0 (ground), 4 (reference), 63 (ground)")


def test_cl1_channels_are_as_many_as_the_file_says_or_have_spikes(tmp_path: Path) -> None:
    path = write_cl1(tmp_path / "a.h5", spikes=[(5, 1), (9, 30)], stims=[(7, 2)])
    for stated, channels in ((32, range(32)), (20, range(31)), (0, SITES), (10**6, SITES)):
        with h5py.File(path, "r+") as file:
            file.attrs["channel_count"] = stated
        recording = read_recording(path)
        assert recording.channels.electrode.tolist() == list(channels)
        assert recording.channels.electrode[recording.spike_channels].tolist() == [1, 30]
        assert ("channel-count-missing" in found(recording)) == (channels is SITES)
    with h5py.File(path, "r+") as file:
        del file.attrs["frames_per_second"]
    assert found(read_recording(path))["sampling-missing"].endswith("assumed to be 25 kHz")


def test_cl1_without_stream_stimuli_or_spikes(tmp_path: Path) -> None:
    recording = read_recording(write_cl1(tmp_path / "a.h5", spikes=[(5, 1)], stims=[(1, 2)]))
    assert np.isnan(recording.stimuli.frequency_hz).all()
    assert len(read_recording(write_cl1(tmp_path / "b.h5", spikes=[(5, 1)], stims=None)).stimuli) == 0
    for start, spike, stimulus, times_s in (
        # Longer than the rig had run before: its frames cannot be told from those of a recording that begins with 0.
        (20_000, 50_000, 25_000, (2.0, 1.0)),
        (100_000, 250_000, 150_000, (10.0, 6.0)),
        # A spike in the first frame.
        (240_000, 240_000, 260_000, (0.0, 0.8)),
        # Frames beyond the end do not count from the start of the rig if others lie before it.
        (50_000, 260_000, 25_000, (10.4, 1.0)),
    ):
        path = write_cl1(tmp_path / "d.h5", spikes=[(spike, 1)], stims=[(stimulus, 2)], start=start)
        recording = read_recording(path)
        assert (*recording.spike_times_s.tolist(), *recording.stimuli.time_s.tolist()) == times_s
    path = write_cl1(tmp_path / "c.h5", spikes=None, stims=[(1, 2)], samples=np.zeros((10, 64), "<i2"))
    with pytest.raises(InvalidFile, match=r"expected spikes at /spikes.*include_spikes=False.*animat convert --raw"):
        read_recording(path)


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\xd9\xff", packed_text("{" * 5000), packed_text("[]"), b"\xff" * 99])
def test_invalid_parameters_in_the_data_stream_are_left_out(tmp_path: Path, data: bytes) -> None:
    path = write_cl1(tmp_path / "a.h5", spikes=[(5, 1)], stims=[(100, 2)], stream=[(50, data)])
    assert np.isnan(read_recording(path).stimuli.frequency_hz).all()


# --- NWB of other programs -------------------------------------------------------------------------------------------


def other_nwb(path: Path, electrodes: bool = True, stimuli: tuple[str, ...] = ("pulses",)) -> Path:
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    if electrodes:
        device = nwb.create_device(name="d")
        group = nwb.create_electrode_group(name="g", description="g", location="in vitro", device=device)
        for i in range(3):
            nwb.add_electrode(location="in vitro", group=group, rel_x=10.0 * i, rel_y=5.0 * i)
    for i, times in enumerate(([0.5, 2.0], [], [1.0])):
        nwb.add_unit(spike_times=times, **({"electrodes": [2 - i]} if electrodes else {}))
    for name in stimuli:
        if name == "pulses":
            table = pynwb.epoch.TimeIntervals(name=name, description="pulses")
            table.add_column(name="frequency_hz", description="Hz")
            table.add_column(name="stimulus_type", description="kind")
            for t, kind in ((0.25, "left"), (0.75, "right")):
                table.add_row(start_time=t, stop_time=t + 0.001, frequency_hz=20.0, stimulus_type=kind)
            nwb.add_stimulus(table)
        elif name == "events":
            nwb.add_stimulus(pynwb.TimeSeries(name=name, data=[1.0, 0.0, 2.0], timestamps=[0.1, 0.2, 0.3], unit="V"))
        elif name == "wave":
            data = np.zeros(20_000)
            for at in (1000, 9000):
                data[at : at + 4], data[at + 4 : at + 8] = -1.0, 1.0
            nwb.add_stimulus(pynwb.TimeSeries(name=name, data=data, rate=10_000.0, starting_time=1.0, unit="V"))
        elif name == "line_ttl":
            # As Open Ephys writes it: the number of the line, negative where it falls.
            data, times_s = np.array([1, -1, 2, -2, 1], np.int8), [0.1, 0.11, 0.4, 0.41, 0.9]
            nwb.add_acquisition(pynwb.TimeSeries(name=name, data=data, timestamps=times_s, unit="n/a"))
        else:
            nwb.add_acquisition(pynwb.TimeSeries(name=name, data=[1.0, 1.0], timestamps=[0.1, 0.9], unit="V"))
    with pynwb.NWBHDF5IO(str(path), "w") as nwb_io:
        nwb_io.write(nwb)
    return path


def test_other_nwb_units_with_electrodes_and_intervals(tmp_path: Path) -> None:
    recording = read_recording(other_nwb(tmp_path / "a.nwb"))
    assert recording.spike_times_s.tolist() == [0.5, 1.0, 2.0]
    assert recording.spike_channels.tolist() == [0, 2, 0]
    assert recording.channels.x_um.tolist() == [20.0, 10.0, 0.0]
    assert recording.channels.y_um.tolist() == [10.0, 5.0, 0.0]
    assert recording.stimuli.time_s.tolist() == [0.25, 0.75]
    assert recording.stimuli.frequency_hz.tolist() == [20.0, 20.0]
    assert recording.provenance["patterns"] == "0: left, 1: right"
    assert recording.provenance["recorded_at"] == "2024-01-01T00:00:00+00:00"
    # Of several electrodes the first counts, of several coordinates those on the array, of labels those that differ.
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        units, electrodes = file["units"], file["general/extracellular_ephys/electrodes"]
        del units["electrodes"], units["electrodes_index"]
        units["electrodes"], units["electrodes_index"] = [2, 0, 1, 0], [2, 3, 4]
        units["label"] = ["u", "u", "v"]
        units["spike_times"].attrs["resolution"] = 4e-5
        electrodes["x"], electrodes["y"] = np.ones(3), np.ones(3)
    again = read_hdf5(tmp_path / "a.nwb")
    assert again.channels.x_um.tolist() == [20.0, 10.0, 0.0]
    assert again.channels.label.tolist() == ["0", "1", "2"]
    assert again.sampling_rate_hz == pytest.approx(25_000.0)


def test_other_nwb_columns_that_are_not_read_are_named(tmp_path: Path) -> None:
    import pynwb

    path = other_nwb(tmp_path / "a.nwb")
    assert "columns-left-out" not in found(read_recording(path))
    with pynwb.NWBHDF5IO(str(path), "a") as nwb_io:
        table = pynwb.epoch.TimeIntervals(name="more", description="x")
        table.add_column(name="stim_freq", description="Hz")
        table.add_row(start_time=0.25, stop_time=0.26, stim_freq=20.0)
        nwb = nwb_io.read()
        nwb.add_stimulus(table)
        nwb_io.write(nwb)
    left = next(f for f in read_recording(path, stimuli="more").findings if f.name == "columns-left-out")
    assert left.message.startswith("unknown columns of /stimulus/presentation/more were left out: stim_freq (did you")


@pytest.mark.parametrize(
    ("column", "values", "read"),
    [
        ("condition", [0.5, 0.1, 0.5], ("pattern", [1, 0, 1])),
        ("condition", np.array([0.5, 0.1, np.nan], np.float32), ("pattern", [1, 0, UNKNOWN])),
        ("condition", [True, False, True], ("pattern", [1, 0, 1])),
        ("condition", [3.0, 7.0, np.nan], ("pattern", [3, 7, UNKNOWN])),
        ("presentation", [4, UNKNOWN, 6], ("presentation", [0, 1, 2])),
        ("presentation", [4, 4, 6], ("presentation", [4, 4, 6])),
        ("presentation", [0, 1, 0], None),
        ("presentation", np.array([0, 1, 0], np.uint8), None),
        ("presentation", np.array([1, np.nan, 0]), None),
        ("condition", np.array([np.inf, 1, np.inf]), ("pattern", [1, 0, 1])),
        ("condition", np.array([2**64 - 1, 1, 1], np.uint64), ("pattern", [1, 0, 0])),
        ("presentation", [0.0, 0.5, 1.0], None),
        ("frequency", ["5 Hz", "5 Hz", "9 Hz"], None),
        ("frequency", [5.0, 0.0, 9.0], ("frequency_hz", [5, np.nan, 9])),
    ],
)
def test_other_nwb_columns_with_other_values_than_ours(
    column: str, values: list[object], read: tuple[str, list[int]] | None, tmp_path: Path
) -> None:
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    nwb.add_unit(spike_times=[0.1, 0.5, 0.9])
    table = pynwb.epoch.TimeIntervals(name="stimuli", description="x")
    table.add_column(column, "of the other program")
    for i, value in enumerate(values):
        table.add_row(start_time=0.2 * i, stop_time=0.2 * i + 0.1, **{column: value})
    nwb.add_stimulus(table)
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "w") as nwb_io:
        nwb_io.write(nwb)
    recording = read_recording(tmp_path / "a.nwb")
    assert recording.stimuli.time_s.tolist() == pytest.approx([0.0, 0.2, 0.4])
    if read is None:
        left_out = f"columns of /stimulus/presentation/stimuli were left out: {column} (cannot have such values)"
        assert found(recording)["columns-left-out"].startswith(left_out)
        assert np.isnan(recording.stimuli.frequency_hz).all()
        assert recording.stimuli.presentation.tolist() == [0, 1, 2]
    else:
        np.testing.assert_array_equal(getattr(recording.stimuli, read[0]), read[1])
        assert "columns-left-out" not in found(recording)
    if values[0] == 0.5:
        assert recording.provenance["patterns"] == "0: 0.1, 1: 0.5"


def test_other_nwb_lasts_as_long_as_its_units_were_observed(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb")
    for spike_s, stimulus_s, observed, span_s in (
        ([105.0, 120.0, 119.0], [100.5, 110.0], [[101.0, 110.0], [115.0, 121.5]], (100.5, 121.5)),
        ([105.0, 120.0, 119.0], [103.0, 122.0], [[101.0, 110.0], [115.0, 121.5]], (101.0, 122.0)),
        # Intervals that leave out spikes are on another clock, or of some units only.
        ([105.0, 120.0, 129.0], [100.5, 110.0], [[101.0, 110.0], [115.0, 121.5]], (0.0, 129.0)),
        ([105.0, 120.0, 119.0], [100.5, 110.0], [[np.nan, np.inf]], (0.0, 120.0)),
    ):
        with h5py.File(path, "r+") as file:
            file["units/spike_times"][...] = spike_s
            file["stimulus/presentation/pulses/start_time"][...] = stimulus_s
            file["units"].pop("obs_intervals", None)
            file["units/obs_intervals"] = observed
        recording = read_hdf5(path)
        assert (recording.start_s, recording.stop_s) == span_s


def test_other_nwb_units_in_a_processing_module(tmp_path: Path) -> None:
    """Written by PyNWB; then also twice, where one would have to be guessed."""
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    units = pynwb.misc.Units(name="sorted", description="spikes", resolution=1 / 20_000)
    for times_s in ([0.5, 2.0], [], [1.0]):
        units.add_unit(spike_times=times_s, obs_intervals=[[0.0, 3.0]])
    nwb.create_processing_module(name="ecephys", description="x").add(units)
    nwb.add_stimulus(pynwb.TimeSeries(name="pulses", data=[1.0, 1.0], timestamps=[0.1, 0.2], unit="V"))
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "w") as nwb_io:
        nwb_io.write(nwb)
    recording = read_recording(tmp_path / "a.nwb")
    assert recording.spike_times_s.tolist() == [0.5, 1.0, 2.0]
    assert (len(recording.channels), recording.duration_s, recording.sampling_rate_hz) == (3, 3.0, 20_000)
    with h5py.File(tmp_path / "a.nwb", "a") as file:
        for elsewhere in ("processing/ecephys/LFP", "processing/behaviour", "acquisition/raw"):
            file[elsewhere] = h5py.ExternalLink("other.nwb", "/LFP")
    assert read_recording(tmp_path / "a.nwb").spike_times_s.tolist() == [0.5, 1.0, 2.0]
    with h5py.File(tmp_path / "a.nwb", "a") as file:
        file.copy("processing/ecephys/sorted", "processing/ecephys/sorted_again")
    words = "found several tables of units: processing/ecephys/sorted, processing/ecephys/sorted_again; link the one"
    with pytest.raises(InvalidFile, match=words):
        read_recording(tmp_path / "a.nwb")


def test_other_nwb_with_links_to_other_files(tmp_path: Path) -> None:
    """They do not matter where stimuli are found; else they are refused, as stimuli could be among them."""
    for name, stimuli in (("with.nwb", ("pulses",)), ("without.nwb", ())):
        with h5py.File(other_nwb(tmp_path / name, stimuli=stimuli), "a") as file:
            file["acquisition/raw"] = h5py.ExternalLink("other.nwb", "/acquisition/raw")
    recording = read_recording(tmp_path / "with.nwb")
    assert (recording.stimuli.time_s.tolist(), recording.spike_times_s.tolist()) == ([0.25, 0.75], [0.5, 1.0, 2.0])
    with pytest.raises(InvalidFile, match="acquisition/raw is a link to another file"):
        read_recording(tmp_path / "without.nwb")


def test_other_nwb_units_without_electrodes(tmp_path: Path) -> None:
    recording = read_recording(other_nwb(tmp_path / "a.nwb", electrodes=False))
    assert len(recording.channels) == 3
    assert np.isnan(recording.channels.x_um).all()
    assert "units-without-electrodes" in found(recording)


@pytest.mark.parametrize(
    ("name", "times_s"),
    [
        ("events", [0.1, 0.3]),
        ("wave", [1.1, 1.9]),
        ("stim_ttl", [0.1, 0.9]),
        ("line_ttl", [0.1, 0.4, 0.9]),
        ("lever", []),
    ],
)
def test_other_nwb_stimuli_in_series(tmp_path: Path, name: str, times_s: list[float]) -> None:
    path = other_nwb(tmp_path / "a.nwb", stimuli=(name,))
    np.testing.assert_allclose(read_recording(path).stimuli.time_s, times_s)
    if name == "events":
        with h5py.File(path, "r+") as file:
            file["stimulus/presentation/events"].attrs["neurodata_type"] = "IndexSeries"
        assert read_hdf5(path).stimuli.time_s.tolist() == [0.1, 0.2, 0.3]


def test_entries_of_a_series_are_stimuli_unless_their_numbers_are_0(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb", stimuli=("events",))
    for data, times_s in (
        (np.zeros((3, 2)), [0.1, 0.2, 0.3]),
        (np.array([[0.0, 0.0], [0.0, 1.0], [2.0, 0.0]]), [0.2, 0.3]),
        (np.array([[0.0], [1.0], [0.0]]), [0.2]),
        (np.ones((3, 2, 2)), [0.1, 0.2, 0.3]),
        (np.ones(2), [0.1, 0.2, 0.3]),
        (None, [0.1, 0.2, 0.3]),
    ):
        with h5py.File(path, "r+") as file:
            del file["stimulus/presentation/events/data"]
            if data is not None:
                file["stimulus/presentation/events/data"] = data
        assert read_hdf5(path).stimuli.time_s.tolist() == times_s
    for empty in (np.zeros(0), np.zeros((0, 2))):
        with h5py.File(path, "r+") as file:
            for name, values in (("data", empty), ("timestamps", np.zeros(0))):
                _ = file.pop(f"stimulus/presentation/events/{name}", None)
                file[f"stimulus/presentation/events/{name}"] = values
        assert len(read_hdf5(path).stimuli) == 0


@pytest.mark.parametrize("before", [8, 0])
@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_samples_that_are_kept_around_pulses_only_are_sampled(
    before: int, shape: tuple[int, ...], tmp_path: Path
) -> None:
    """Each of their samples was a pulse. Without samples before and after, one's end was taken for the next one's."""
    path, pulse_s = other_nwb(tmp_path / "a.nwb", stimuli=("events",)), np.arange(0.1, 1.0, 0.2)
    snippet = np.pad([1.0, 1.0, -1.0, -1.0], before)
    times_s = pulse_s[:, None] + (np.arange(len(snippet)) - before) / 2000
    with h5py.File(path, "r+") as file:
        del file["stimulus/presentation/events/data"], file["stimulus/presentation/events/timestamps"]
        file["stimulus/presentation/events/data"] = np.tile(snippet, len(pulse_s)).reshape(shape)
        file["stimulus/presentation/events/timestamps"] = times_s.ravel()
    np.testing.assert_allclose(read_hdf5(path).stimuli.time_s, pulse_s)


def test_a_recording_began_at_the_time_that_its_times_count_from(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb")
    assert read_hdf5(path).recorded_at == datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    with h5py.File(path, "r+") as file:
        file["timestamps_reference_time"][()] = "2024-01-01T01:00:00+00:00"
    assert read_hdf5(path).recorded_at == datetime.datetime(2024, 1, 1, 1, tzinfo=datetime.UTC)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("of", "times_s"),
    [
        ("several amplitudes", [0.1, 0.5, 0.9]),
        ("true and false", [0.1, 0.5, 0.9]),
        ("noise", [0.1, 0.9]),
        ("steps of a converter", [0.1, 0.5, 0.9]),
        ("an offset", [0.1, 0.5, 0.9]),
        ("samples 2 ms apart", [0.1, 0.5, 0.9]),
        ("a column", [0.1, 0.5, 0.9]),
    ],
)
def test_a_sampled_stimulus_begins_each_time_it_leaves_0(
    of: str, times_s: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pynwb

    # Of the second pulse, half is in one block and half in the next.
    monkeypatch.setattr("animat.recordings.formats.nwb_stimuli._BLOCK", 5004)
    path = other_nwb(tmp_path / "a.nwb", stimuli=())
    rate_hz = 500 if of == "samples 2 ms apart" else 10_000
    data = np.zeros(rate_hz)
    for at, amplitude in ((rate_hz // 10, 300.0), (rate_hz // 2, -100.0), (rate_hz // 10 * 9, 200.0)):
        data[at : at + 4], data[at + 4 : at + 8] = amplitude, -amplitude
    if of == "noise":
        data += np.random.default_rng(0).normal(0, 20, len(data))
    if of == "steps of a converter":
        data = np.rint(data + np.random.default_rng(0).normal(0, 0.4, len(data)))
        assert 0.1 < np.mean(data != 0) < 0.5
    data[0] = np.nan if of == "several amplitudes" else data[0]
    data = data != 0 if of == "true and false" else data
    with pynwb.NWBHDF5IO(str(path), "a") as nwb_io:
        nwb = nwb_io.read()
        stored: dict[str, object] = {"data": data[:, None] if of == "a column" else data}
        if of == "an offset":
            # As a converter from analog to digital: 2048 is 0.
            stored = {"data": (data + 2048).astype(np.uint16), "conversion": 0.1, "offset": -204.8}
        nwb.add_stimulus(pynwb.TimeSeries(name="wave", rate=float(rate_hz), starting_time=0.0, unit="mV", **stored))
        wave = {
            **stored,
            "data": np.take(stored["data"], [900, 950, 1000], axis=0, mode="clip"),
            "timestamps": [0.1, 0.2, 0.3],
        }
        nwb.add_acquisition(pynwb.TimeSeries(name="each", unit="mV", **wave))
        nwb.add_acquisition(
            pynwb.TimeSeries(name="timed", unit="mV", timestamps=3.0 + np.arange(rate_hz) / rate_hz, **stored)
        )
        nwb_io.write(nwb)
    np.testing.assert_allclose(read_hdf5(path).stimuli.time_s, times_s)
    if of != "samples 2 ms apart":
        np.testing.assert_allclose(read_hdf5(path, stimuli="timed").stimuli.time_s, 3.0 + np.array(times_s))
    if of not in ("noise", "steps of a converter", "samples 2 ms apart"):
        np.testing.assert_allclose(read_recording(path, stimuli="each").stimuli.time_s, [0.3])


def test_stimuli_are_found_in_what_holds_behavioural_series(tmp_path: Path) -> None:
    import pynwb

    path = other_nwb(tmp_path / "a.nwb", stimuli=())
    with pytest.raises(InvalidFile, match="stimuli: nothing in the file can be stimuli, got pulses"):
        read_hdf5(path, stimuli="pulses")
    with pynwb.NWBHDF5IO(str(path), "a") as nwb_io:
        nwb = nwb_io.read()
        module = nwb.create_processing_module(name="behavior", description="x")
        for name, times_s in (("pulses", [0.1, 0.3]), ("licks", [0.2])):
            series = pynwb.TimeSeries(name=name, data=np.ones(len(times_s)), timestamps=times_s, unit="n/a")
            module.add(pynwb.behavior.BehavioralTimeSeries(name=f"of {name}", time_series=series))
        nwb_io.write(nwb)
    assert read_hdf5(path).stimuli.time_s.tolist() == [0.1, 0.3]
    assert read_hdf5(path, stimuli="licks").stimuli.time_s.tolist() == [0.2]


def test_other_nwb_with_several_stimuli_lists_them(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb", stimuli=("pulses", "events", "lever"))
    with pytest.raises(
        InvalidFile, match=r"found 2: stimulus/presentation/events, stimulus/presentation/pulses; choose"
    ):
        read_recording(path)
    assert read_recording(path, stimuli="events").stimuli.time_s.tolist() == [0.1, 0.3]
    assert read_recording(path, stimuli="acquisition/lever").stimuli.time_s.tolist() == [0.1, 0.9]
    # Where stimuli are presented comes before names that mention them.
    both = read_recording(other_nwb(tmp_path / "b.nwb", stimuli=("pulses", "stim_ttl")))
    assert both.stimuli.time_s.tolist() == [0.25, 0.75]
    with pytest.raises(InvalidFile, match=r"expected one of .*got nothing"):
        read_recording(path, stimuli="nothing")


def test_a_choice_that_a_format_does_not_offer_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match="part: expected only for MaxWell"):
        read_recording(other_nwb(tmp_path / "a.nwb"), part="well000")
    np.savez(tmp_path / "a.npz", spike_time_s=np.zeros(1))
    with pytest.raises(InvalidArgument, match="only for HDF5 files"):
        read_recording(tmp_path / "a.npz", stimuli="x")
    with pytest.raises(InvalidArgument, match=r"^part: expected only for HDF5 files, got 'well000' for .*a\.npz$"):
        read_recording(tmp_path / "a.npz", part="well000")
    (tmp_path / "a_spikes.csv").write_text("time_s,channel\n0.1,1\n")
    with pytest.raises(InvalidArgument, match=r"^stimuli: .*got 'p.csv'.*name the file of stimuli NAME_stimuli\.csv"):
        read_recording(tmp_path / "a_spikes.csv", stimuli="p.csv")
    # The file need not hold stimuli.
    with pytest.raises(InvalidArgument, match=r"^stimuli_path: expected only with CSV spikes, got .*a\.npz; put"):
        read_recording(tmp_path / "a.npz", stimuli_path=tmp_path / "p.csv")


# --- what every reader refuses ---------------------------------------------------------------------------------------


def test_links_to_other_files_are_never_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["spikes"] = spike_table([0.5], [9])
    path = write_maxwell(tmp_path / "a.h5", mapping=TABLE, spikes=None, recorded=[9])
    at = "wells/well000/rec0000"
    with h5py.File(path, "r+") as file:
        file[f"{at}/spikes"] = h5py.ExternalLink(str(secret), "/spikes")
    with pytest.raises(InvalidFile, match="is a link to another file, which is never followed"):
        read_recording(path)
    with h5py.File(path, "r+") as file:
        del file[f"{at}/spikes"]
        file["out"] = h5py.ExternalLink(str(secret), "/")
        file[f"{at}/spikes"] = h5py.SoftLink("/out/spikes")
    with pytest.raises(InvalidFile, match="is a link to another file, which is never followed"):
        read_recording(path)
    with h5py.File(path, "r+") as file:
        del file[f"{at}/spikes"]
        file[f"{at}/spikes"] = h5py.SoftLink(f"/{at}/spikes")
    with pytest.raises(InvalidFile, match="circular links"):
        read_recording(path)


def test_values_in_other_files_are_never_read(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(bytes(800))
    path = other_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        del file["units/spike_times"]
        file.create_dataset("units/spike_times", (3,), "f8", external=[(str(tmp_path / "secret"), 0, 24)])
    with pytest.raises(InvalidFile, match="they are in other files, which are never opened"):
        read_recording(path)
    with h5py.File(path, "r+") as file:
        del file["units/spike_times"]
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (3,))
        file.create_virtual_dataset("units/spike_times", layout)
    with pytest.raises(InvalidFile, match="they are in other files, which are never opened"):
        read_recording(path)


@pytest.mark.parametrize("shape", [(2**40,), (2**62,), (2**31, 2**20)])
def test_absurd_sizes_are_refused_before_memory_is_allocated(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = other_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        del file["units/spike_times"]
        file.create_dataset("units/spike_times", shape, "f8", chunks=(1024,) + (1,) * (len(shape) - 1))
    with pytest.raises(InvalidFile, match=r"claims [\d,]+ values, more than a file of"):
        read_recording(path)


def test_a_chunk_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["uV_per_sample_unit"] = 0.2
        chunks = (16_000_000, 64)
        file.create_dataset("samples", (50, 64), "<i2", maxshape=(None, 64), chunks=chunks, compression="gzip")
    with pytest.raises(InvalidFile, match="samples is stored in chunks of an absurd size"):
        open_traces(tmp_path / "a.h5")


def test_a_column_that_is_empty_by_type_is_named(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        del file["units/spike_times"]
        file["units/spike_times"] = h5py.Empty("f8")
    with pytest.raises(InvalidFile, match="expected values at units/spike_times, got an empty dataspace"):
        read_recording(path)


@pytest.mark.parametrize(
    ("ends", "electrodes"),
    [((2, 3), [[5, 6], [7, UNKNOWN]]), ((2,), None), ((2, 1), None), ((2, 9), None), ((-1, 2), None)],
)
def test_stimuli_whose_electrodes_have_no_sound_index_are_read_without(
    tmp_path: Path, ends: tuple[int, ...], electrodes: list[list[int]] | None
) -> None:
    path = other_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "r+") as file:
        at = "stimulus/presentation/pulses/electrodes"
        file[at], file[f"{at}_index"] = np.array([5, 6, 7]), np.array(ends)
    stimuli = read_recording(path).stimuli
    assert stimuli.time_s.tolist() == [0.25, 0.75]
    assert stimuli.electrodes.tolist() == (electrodes or [[UNKNOWN], [UNKNOWN]])


def test_units_of_other_nwb_are_out_of_order_only_within_one(tmp_path: Path) -> None:
    def unsorted_message(units: list[list[float]]) -> str | None:
        import pynwb

        start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
        nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
        for times_s in units:
            nwb.add_unit(spike_times=times_s)
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.nwb"
        with pynwb.NWBHDF5IO(str(path), "w") as nwb_io:
            nwb_io.write(nwb)
        recording = read_recording(path)
        assert recording.spike_times_s.tolist() == sorted(t for times_s in units for t in times_s)
        return next((f.message for f in recording.findings if f.name == "unsorted-spikes"), None)

    assert unsorted_message([[0.1, 0.5, 0.9], [0.2, 0.4]]) is None
    assert str(unsorted_message([[0.1, 0.9, 0.5], [0.4, 0.2]])).startswith(
        "spikes that follow a later one in the file: 2 of 5"
    )


def write_trials(path: Path, electrodes: list[Any] | None, stimuli: bool = False) -> Path:
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    nwb.add_unit(spike_times=[0.1, 0.5, 0.9])
    table = pynwb.epoch.TimeIntervals(name="stimuli" if stimuli else "sweeps", description="x")
    if electrodes is not None:
        table.add_column("electrodes", "on the array")
    for i in range(3):
        row = {} if electrodes is None else {"electrodes": electrodes[i]}
        table.add_interval(start_time=0.2 * i, stop_time=0.2 * i + 0.1, **row)
    nwb.add_stimulus(table) if stimuli else nwb.add_time_intervals(table)
    with pynwb.NWBHDF5IO(str(path), "w") as nwb_io:
        nwb_io.write(nwb)
    return path


def write_onsets(path: Path, onset_s: list[float], name: str = "stim_onset_time") -> Path:
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    nwb.add_unit(spike_times=[0.1, 5.5, 9.9])
    nwb.add_trial_column(name, "in s")
    nwb.add_trial_column("stim_frequency", "in Hz")
    for i, onset in enumerate(onset_s):
        nwb.add_trial(start_time=2.0 * i, stop_time=2.0 * i + 1.5, **{name: onset, "stim_frequency": 5.0 + i})
    with pynwb.NWBHDF5IO(str(path), "w") as nwb_io:
        nwb_io.write(nwb)
    return path


@pytest.mark.parametrize("name", ["stim_onset_time", "stimulus_start", "stimOnTimes"])
def test_stimuli_of_trials_begin_where_a_column_says(name: str, tmp_path: Path) -> None:
    recording = read_recording(write_onsets(tmp_path / "a.nwb", [0.5, np.nan, 4.75, 7.5], name))
    assert recording.stimuli.time_s.tolist() == [0.5, 4.75, 7.5]
    assert recording.stimuli.frequency_hz.tolist() == [5.0, 7.0, 8.0]
    assert found(recording)["stimuli-from"] == (
        f"3 stimuli are taken from /intervals/trials/{name}; 1 of 4 rows have none"
    )
    assert "columns-left-out" not in found(recording)


@pytest.mark.parametrize("onset_s", [[0.5, 0.5, 0.5, 0.5], [500.0, 2500.0, 4500.0, 6500.0], [np.nan] * 4])
def test_times_of_stimuli_outside_their_trials_are_not_taken(onset_s: list[float], tmp_path: Path) -> None:
    path = write_onsets(tmp_path / "a.nwb", onset_s)
    assert "stimuli-elsewhere" in found(read_recording(path))
    recording = read_recording(path, stimuli="trials")
    assert recording.stimuli.time_s.tolist() == [0.0, 2.0, 4.0, 6.0]
    assert "stim_onset_time" in found(recording)["columns-left-out"]


@pytest.mark.parametrize("name", ["stimuli", "sweeps"])
def test_stimuli_are_read_from_a_table_of_events(name: str, tmp_path: Path) -> None:
    event = pytest.importorskip("pynwb.event", reason="this version of pynwb has no tables of events")
    import pynwb

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    nwb.add_unit(spike_times=[0.1, 0.5, 0.9])
    table = event.EventsTable(name=name, description="x")
    table.add_column("frequency_hz", "of the pulses")
    for time_s, frequency_hz in ((0.75, 20.0), (np.nan, 20.0), (0.25, 5.0)):
        table.add_event(timestamp=time_s, duration=0.001, annotation="by hand", frequency_hz=frequency_hz)
    nwb.add_events_table(table)
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "w") as nwb_io:
        nwb_io.write(nwb)
    if name == "sweeps":
        assert "events/sweeps" in found(read_recording(tmp_path / "a.nwb"))["stimuli-elsewhere"]
    recording = read_recording(tmp_path / "a.nwb", stimuli=None if name == "stimuli" else name)
    assert recording.stimuli.time_s.tolist() == [0.25, 0.75]
    assert recording.stimuli.frequency_hz.tolist() == [5.0, 20.0]
    assert found(recording)["stimuli-from"] == (
        f"2 stimuli are taken from /events/{name}/timestamp; 1 of 3 rows have none"
    )
    assert "columns-left-out" not in found(recording)


def test_nothing_is_known_after_a_cl1s_index_repeats_itself(tmp_path: Path) -> None:
    said = [packed_text(json.dumps({"frequency_hz": hz, "pattern": n})) for n, hz in enumerate((5.0, 10.0, 20.0, 40.0))]
    frames = (1000, 2000, 3000, 4000)
    stims = [(frame, 2) for frame in frames]
    path = write_cl1(tmp_path / "a.h5", spikes=[(5, 1)], stims=stims, stream=list(zip(frames, said, strict=True)))
    assert read_recording(path).stimuli.frequency_hz.tolist() == [5.0, 10.0, 20.0, 40.0]
    with h5py.File(path, "r+") as file:
        index = file["data_stream/animat_stimuli/index"][:]
        index[2:] = index[:2]
        file["data_stream/animat_stimuli/index"][:] = index
    read = read_recording(path)
    np.testing.assert_array_equal(read.stimuli.frequency_hz, [5.0, 10.0, np.nan, np.nan])
    lost = next(finding for finding in read.findings if finding.name == "stimulus-words-lost")
    assert lost.severity == "warning" and "after 2 of 4 entries" in lost.message
    assert "of the last 2 stimuli are not known" in lost.message


def test_tables_that_may_be_stimuli_are_listed_if_none_is_named_like_stimuli(tmp_path: Path) -> None:
    path = write_trials(tmp_path / "a.nwb", None)
    found = {f.name: f for f in recording_findings(read_recording(path))}
    listed = found["stimuli-elsewhere"].message
    assert found["no-stimuli"].severity == "refuse" and "intervals/sweeps" in listed and "--stimuli" in listed
    assert read_recording(path, stimuli="sweeps").stimuli.time_s.tolist() == pytest.approx([0.0, 0.2, 0.4])


@pytest.mark.parametrize(
    ("words", "read"),
    [
        (["7", "7 9", ""], [[7, -1], [7, 9], [-1, -1]]),
        (["7,9", "8", "9"], [[7, 9], [8, -1], [9, -1]]),
        (["7", "north", "9"], [[-1], [-1], [-1]]),
        ([7, -1, 9], [[7], [-1], [9]]),
        ([[7, 9], [8, -1], [9, 7]], [[7, 9], [8, -1], [9, 7]]),
        ([7, -5, 9], [[7], [-1], [9]]),
        (["7 -5", "-5", "9"], [[7, -1], [-1, -1], [9, -1]]),
    ],
)
def test_electrodes_of_each_stimulus_are_read_as_in_csv(
    words: list[Any], read: list[list[int]], tmp_path: Path
) -> None:
    recording = read_recording(write_trials(tmp_path / "a.nwb", words, stimuli=True))
    assert recording.stimuli.electrodes.tolist() == read
    left_out = found(recording).get("columns-left-out", "")
    assert left_out.endswith("electrodes (cannot have such values)") == ("north" in words)


@pytest.mark.parametrize("of_another_table", [False, True])
def test_electrodes_by_row_of_the_electrodes_table_have_its_numbers(tmp_path: Path, of_another_table: bool) -> None:
    import pynwb
    from hdmf.common import DynamicTable

    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    nwb = pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start)
    device = nwb.create_device(name="d")
    group = nwb.create_electrode_group(name="g", description="g", location="in vitro", device=device)
    for electrode in (10, 20, 30):
        nwb.add_electrode(id=electrode, location="in vitro", group=group, rel_x=0.0, rel_y=0.0)
    nwb.add_unit(spike_times=[0.5], electrodes=[1])
    to: DynamicTable = nwb.electrodes
    if of_another_table:
        to = DynamicTable(name="sites", description="not on the array", id=[7, 8, 9])
        nwb.add_scratch(to)
    table = pynwb.epoch.TimeIntervals(name="stimuli", description="x")
    table.add_column("electrodes", "pulsed together", index=True, table=to)
    for i, rows in enumerate(([0], [1, 2], [])):
        table.add_row(start_time=0.2 * i, stop_time=0.2 * i + 0.1, electrodes=rows)
    nwb.add_stimulus(table)
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "w") as nwb_io:
        nwb_io.write(nwb)
    recording = read_recording(tmp_path / "a.nwb")
    assert recording.channels.electrode.tolist() == [20]
    if of_another_table:
        assert np.all(recording.stimuli.electrodes == UNKNOWN)
        assert found(recording)["columns-left-out"].endswith("left out: electrodes (cannot have such values)")
    else:
        assert recording.stimuli.electrodes.tolist() == [[10, UNKNOWN], [20, 30], [UNKNOWN, UNKNOWN]]


def test_the_advice_to_choose_names_the_commands_that_can(tmp_path: Path) -> None:
    path = other_nwb(tmp_path / "a.nwb", stimuli=("pulses", "events"))
    with pytest.raises(InvalidFile, match="choose with --stimuli NAME in animat inspect or animat convert"):
        read_recording(path)
