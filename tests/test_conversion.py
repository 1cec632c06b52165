"""Conversion to NWB. Oracles: nwbinspector, pynwb, the original recording, raw traces with known spikes."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pynwb import NWBHDF5IO

from animat.cli import main
from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.conversion import Origin, convert_recording
from animat.recordings.detection.settings import Detection
from animat.recordings.formats import with_spikeinterface
from animat.recordings.formats.nwb_tables import nwb_file
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from rig_files import event_table, mapping_table, spike_table, write_cl1, write_maxwell
from test_detection import noisy
from test_rig_readers import other_nwb

WHO = Origin(
    subject_id="culture-1",
    species="Rattus norvegicus",
    age="P42D",
    experimenter="Doe, Jane",
    institution="An Institute",
    keywords="culture, stimulation",
    recorded_at="2024-05-31T14:00:00+09:00",
    experiment_description="Responses to stimuli.",
)


def rig_file(kind: str, folder: Path) -> Path:
    path = folder / kind
    if kind == "maxwell":
        table = mapping_table([3, 9], [1000, 2000])
        events = event_table([0.2, 0.4], ["frequency 5", "frequency 20"])
        return write_maxwell(
            path, mapping=table, spikes=spike_table([0.3, 0.5], [9, 3]), events=events, recorded=[3, 9]
        )
    if kind == "cl1":
        return write_cl1(path, spikes=[(50_001, 8), (25_002, 63)], stims=[(1000, 9)])
    if kind == "other nwb":
        return other_nwb(path.with_suffix(".nwb"))
    times = {
        "spike_time_s": np.array([0.1, 0.2]),
        "spike_channel": np.array([4, 5]),
        "stimulus_time_s": np.array([0.05]),
    }
    np.savez(path.with_suffix(".npz"), **times)
    return path.with_suffix(".npz")


@pytest.mark.parametrize("kind", ["maxwell", "cl1", "other nwb", "npz"])
def test_the_converted_recording_equals_the_one_read(kind: str, tmp_path: Path) -> None:
    path = rig_file(kind, tmp_path)
    source = read_recording(path)
    convert_recording(path, tmp_path / "out.nwb", WHO, start_min=30.0)
    written = read_recording(tmp_path / "out.nwb")
    assert written.start_min == 30.0
    assert written.provenance["experimenter"] == "Doe, Jane"
    assert written.provenance["format"] == source.provenance["format"]
    for name in ("spike_times_s", "spike_channels"):
        np.testing.assert_array_equal(getattr(written, name), getattr(source, name))
    for name in ("time_s", "frequency_hz", "electrodes", "presentation"):
        np.testing.assert_array_equal(getattr(written.stimuli, name), getattr(source.stimuli, name))


def test_the_subject_stated_in_the_file_is_kept(tmp_path: Path) -> None:
    path = rig_file("npz", tmp_path)
    convert_recording(path, tmp_path / "unknown.nwb", Origin(subject_id="c1"))
    convert_recording(path, tmp_path / "female.nwb", Origin(subject_id="c1", sex="F"))
    convert_recording(tmp_path / "female.nwb", tmp_path / "renamed.nwb", Origin(subject_id="c2"))
    found = [read_recording(tmp_path / f"{name}.nwb").provenance["sex"] for name in ("unknown", "female", "renamed")]
    assert found == ["U", "F", "F"]


def test_a_choice_that_would_be_ignored_is_refused(tmp_path: Path) -> None:
    path = rig_file("maxwell", tmp_path)
    with pytest.raises(InvalidArgument, match=r"stimuli_path: .* holds its own stimuli"):
        convert_recording(path, tmp_path / "a.nwb", detection=Detection(), stimuli_path=tmp_path / "pulses.csv")
    for choice in ({"part": "well000/rec0000"}, {"stimuli": "x"}):
        with pytest.raises(InvalidArgument, match="stimuli, part: expected none for traces read with a reader"):
            convert_recording(path, tmp_path / "a.nwb", reader="intan", **choice)
    assert not (tmp_path / "a.nwb").exists()


@pytest.mark.oracle
@pytest.mark.parametrize("who", [WHO, None, Origin(species="Rattus norvegicus")], ids=["all said", "nothing", "some"])
@pytest.mark.parametrize("kind", ["maxwell", "cl1", "other nwb", "npz"])
def test_nwbinspector_finds_nothing_critical(kind: str, who: Origin | None, tmp_path: Path) -> None:
    pytest.importorskip("nwbinspector", reason="nwbinspector is not installed")
    from nwbinspector import Importance, inspect_nwbfile

    convert_recording(rig_file(kind, tmp_path), tmp_path / "out.nwb", who)
    messages = list(inspect_nwbfile(nwbfile_path=str(tmp_path / "out.nwb")))
    grave = (Importance.CRITICAL, Importance.ERROR, Importance.PYNWB_VALIDATION)
    assert [m.message for m in messages if m.importance in grave] == []


def test_the_command_finds_spikes_in_raw_traces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    voltage, truth = noisy(64, 0.5, step_uv=0.195)
    path = write_cl1(tmp_path / "a.h5", spikes=[], stims=None, samples=voltage)
    arguments = ["convert", str(path), "--out", str(tmp_path / "out.nwb"), "--raw"]
    assert main([*arguments, "--subject-id", "c", "--experimenter", "Doe, Jane", "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["spikes"] >= 0.5 * sum(map(len, truth))
    with h5py.File(tmp_path / "out.nwb") as file:
        assert file["general/experimenter"][0] == b"Doe, Jane"
        assert file["general/subject/subject_id"][()] == b"c"


def test_the_command_reports_errors_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file("maxwell", tmp_path)
    assert main(["convert", str(path), "--out", str(tmp_path / "out.nwb"), "--raw"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "expected raw traces at /wells/well000/rec0000/groups, found none: the rig kept spikes only" in said
    assert not (tmp_path / "out.nwb").exists()
    assert main(["inspect", str(path), "--part", "well7"]) == 1
    assert "expected one of well000/rec0000; got well7" in capsys.readouterr().err
    assert main(["convert", str(tmp_path), "--out", str(tmp_path / "out.nwb")]) == 1
    assert "expected one recording, got a folder; convert its files one by one" in capsys.readouterr().err
    state = tmp_path / "culture.state"
    with state.open("wb") as file:
        np.savez(file, head=np.zeros(1), state_last_spike=np.zeros(1))
    assert main(["inspect", str(state)]) == 1
    assert "expected a recording, got the state of a virtual culture" in capsys.readouterr().err


@pytest.mark.parametrize("age", ["P42D", "P6W", "P1Y2M3DT4H", "P2.5W", "PT36H", "P20D/P22D", "P90Y/"])
def test_an_age_is_a_duration(age: str) -> None:
    assert Origin(subject_id="c", age=age).age == age


@pytest.mark.parametrize(
    "age", ["banana", "42", "P", "PT", "P42", "42D", "P1D2Y", "P1DT", "/P3D", "P3D/banana", "p3d", "P٣D"]
)
def test_an_invalid_age_is_refused_before_anything_is_read(
    age: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.nwb"
    assert main(["convert", str(tmp_path / "none.h5"), "--out", str(out), f"--age={age}"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"age: expected an ISO 8601 duration such as P42D (days), P6W or P3M, got {age!r}" in said
    with pytest.raises(InvalidArgument, match=r"species: expected the name in Latin, .* got 'mouse'"):
        Origin(species="mouse")
    with pytest.raises(InvalidArgument, match="recorded_at: expected an ISO 8601 date"):
        Origin(recorded_at="yesterday")
    # Bytes that are no UTF-8, from a command line.
    with pytest.raises(InvalidArgument, match="lab: expected text without null characters or lone surrogates"):
        Origin(lab=b"\xff".decode(errors="surrogateescape"))


def test_spikes_without_traces_are_distinguished_from_a_damaged_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.csv").write_text("time_s,channel\n0.1,3\n")
    (tmp_path / "a.rhd").write_bytes(b"\xc6\x91\x12\xd6" + bytes(40))
    expected = {"a.rhd": "got another file; for traces in another format name it with --reader, such as intan"}
    expected["a.csv"] = "got CSV, which holds spikes (leave out --raw to convert these)"
    expected[rig_file("npz", tmp_path).name] = "got NPZ, which holds spikes (leave out --raw to convert these)"
    for name, message in expected.items():
        assert main(["convert", str(tmp_path / name), "--out", str(tmp_path / "out.nwb"), "--raw"]) == 1
        said = capsys.readouterr().err
        assert "expected HDF5 with raw traces (MaxWell, CL1, NWB), " + message in said
        assert said.count("\n") == 1
    assert main(["convert", str(tmp_path), "--out", str(tmp_path / "out.nwb"), "--raw"]) == 1
    assert "expected one recording, got a folder" in capsys.readouterr().err


def test_text_with_an_hdf5_name_is_reported_as_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.nwb").write_text("<html>not found</html>\n")
    for more in ([], ["--raw"]):
        assert main(["convert", str(tmp_path / "a.nwb"), "--out", str(tmp_path / "out.nwb"), *more]) == 1
        said = capsys.readouterr().err
        assert "a.nwb: expected HDF5 " in said
        assert said.count("\n") == 1
    # What a file is its content says: spikes under a wrong name are read.
    (tmp_path / "b.nwb").write_text("time_s,channel\n0.1,3\n")
    assert len(read_recording(tmp_path / "b.nwb").spike_times_s) == 1


def test_a_file_is_not_written_over_itself(tmp_path: Path) -> None:
    path = rig_file("maxwell", tmp_path)
    before = path.read_bytes()
    with pytest.raises(InvalidArgument, match="--out: expected a new file, got"):
        convert_recording(path, path)
    assert path.read_bytes() == before


def test_a_file_that_another_program_wrote_in_the_meantime_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = rig_file("npz", tmp_path), tmp_path / "out.nwb"

    def read(*given: Any, **named: Any) -> Recording:
        out.write_text("another program's")
        return read_recording(*given, **named)

    monkeypatch.setattr("animat.recordings.conversion.read_recording", read)
    with pytest.raises(InvalidArgument, match="--out: expected a new file, got"):
        convert_recording(path, out)
    assert out.read_text() == "another program's"


def test_a_link_that_leads_nowhere_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    (tmp_path / "out.nwb").symlink_to(tmp_path / "nowhere.nwb")
    with pytest.raises(InvalidArgument, match="--out: expected a new file, got"):
        convert_recording(tmp_path / "no such recording.npz", tmp_path / "out.nwb")
    assert [file.name for file in tmp_path.iterdir()] == ["out.nwb"]


@pytest.mark.parametrize("has_links", [True, False])
def test_a_file_that_another_program_wrote_during_the_last_step_is_kept(
    has_links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = rig_file("npz", tmp_path), tmp_path / "out.nwb"

    def write(recording: Recording, of_channels: Any) -> Any:
        out.write_text("another program's")
        return nwb_file(recording, of_channels)

    def no_links(*_: object) -> None:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))

    monkeypatch.setattr("animat.recordings.formats.nwb_tables.nwb_file", write)
    if not has_links:
        monkeypatch.setattr(os, "link", no_links)
    with pytest.raises(InvalidFile, match=r"out\.nwb: cannot be written: File exists; any"):
        convert_recording(path, out)
    assert out.read_text() == "another program's" and {*tmp_path.iterdir()} == {path, out}
    out.unlink()
    monkeypatch.setattr("animat.recordings.formats.nwb_tables.nwb_file", nwb_file)
    assert convert_recording(path, out).equals(read_recording(out)) and {*tmp_path.iterdir()} == {path, out}


def test_what_nwb_cannot_hold_is_refused_with_the_file_s_name(tmp_path: Path) -> None:
    path = rig_file("cl1", tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["created_utc"] = "the first of May"
    with pytest.raises(
        InvalidFile, match=rf"^{path}: provenance\['recorded_at'\]: expected .*, got 'the first of May'"
    ):
        convert_recording(path, tmp_path / "out.nwb")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("name", ["x.csv", "x", "x.nwb.gz"])
def test_the_output_name_must_end_in_nwb(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidArgument, match=r"^--out: expected a name ending in \.nwb, as NWB is written, got "):
        convert_recording(rig_file("npz", tmp_path), tmp_path / name)
    assert not (tmp_path / name).exists()


def test_spikeinterface_is_asked_for_by_the_formats_name(tmp_path: Path) -> None:
    path = rig_file("maxwell", tmp_path)
    installed = True
    try:
        import spikeinterface  # noqa: F401
    except ImportError:
        installed = False
    message = "reader: expected one of" if installed else r"reader: .* not installed: .* -m pip install 'animat\[raw\]'"
    with pytest.raises(InvalidArgument, match=message):
        convert_recording(path, tmp_path / "out.nwb", reader="nosuchformat")
    with pytest.raises(InvalidFile, match="no such file"):
        convert_recording(tmp_path / "none", tmp_path / "out.nwb", reader="intan")
    if installed:
        with pytest.raises(InvalidArgument, match="reader: expected one of ") as refused:
            convert_recording(path, tmp_path / "out.nwb", reader="phy")
        listed = str(refused.value).partition("one of ")[2].partition(";")[0].split(", ")
        assert {"intan", "maxwell", "mda_recording", "spikeglx"} <= set(listed)
        assert not {"phy", "kilosort", "binary", "zarr", "npz_sorting", "mda_sorting", "maxwell_event"} & set(listed)


# What writes the folder leaves a file open.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_a_folder_is_read_by_a_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("spikeinterface", reason="SpikeInterface is not installed (animat[raw])")
    from spikeinterface.core import NumpyRecording
    from spikeinterface.extractors.extractor_classes import MdaRecordingExtractor

    voltage, truth = noisy(3, 1.0)
    traces = NumpyRecording([voltage.astype(np.float32) * np.float32(0.1)], 20_000.0)
    traces.set_dummy_probe_from_locations(np.column_stack([np.arange(3) * 17.5, np.zeros(3)]))
    MdaRecordingExtractor.write_recording(traces, tmp_path / "mda")
    arguments = ["convert", str(tmp_path / "mda"), "--out", str(tmp_path / "out.nwb"), "--reader", "mda_recording"]
    assert main(arguments) == 0, capsys.readouterr().err
    assert abs(len(read_recording(tmp_path / "out.nwb").spike_times_s) - sum(map(len, truth))) <= 3


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (
            ["--threshold", "6", "--band-hz", "300", "3000", "--blank-ms", "1", "3"],
            "--band-hz, --threshold, --blank-ms",
        ),
        (["--dead-time-ms", "2"], "--dead-time-ms"),
    ],
)
def test_options_of_finding_spikes_are_not_ignored(
    options: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.nwb"
    assert main(["convert", str(rig_file("npz", tmp_path)), "--out", str(out), *options]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{named}: expected only where spikes are found in raw traces" in said
    assert not out.exists()


def test_traces_that_spikeinterface_reads(tmp_path: Path) -> None:
    pytest.importorskip("spikeinterface", reason="SpikeInterface is not installed (animat[raw])")
    voltage, truth = noisy(3, 1.0)
    path = write_maxwell(
        tmp_path / "a.h5",
        mapping=mapping_table([0, 1, 2], [1000, 2000, 3000]),
        spikes=None,
        recorded=[0, 1, 2],
        raw=(voltage.T / 63 + 512).astype("<u2"),
    )
    (tmp_path / "a_stimuli.csv").write_text("0.5\n")
    written = convert_recording(path, tmp_path / "out.nwb", reader="maxwell")
    assert len(written.channels) == 3
    assert written.stimuli.time_s.tolist() == [0.5]
    assert abs(len(written.spike_times_s) - sum(map(len, truth))) <= 3


@pytest.mark.oracle
def test_stimuli_before_and_after_the_traces_of_a_reader_leave_spikes_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    voltage, _ = noisy(3, 1.0)

    class Traces:
        """As SpikeInterface has it."""

        get_channel_ids = staticmethod(lambda: [0, 1, 2])
        has_probe, has_scaleable_traces = staticmethod(lambda: True), staticmethod(lambda: False)
        get_channel_locations = staticmethod(lambda: [[1.0, 2.0, 0.0], [3.0, 4.0, 0.0], [5.0, 6.0, 0.0]])
        get_num_samples = staticmethod(lambda segment_index: len(voltage))
        get_sampling_frequency = staticmethod(lambda: 20_000.0)
        get_num_segments = staticmethod(lambda: 1)

        @staticmethod
        def get_traces(segment_index: int, start_frame: int, end_frame: int, return_in_uV: bool) -> np.ndarray:
            return voltage[start_frame:end_frame] * 0.1

    given: list[dict[str, bool]] = []

    def read(path: Path, **options: bool) -> Traces:
        given.append(options)
        return Traces()

    monkeypatch.setattr(with_spikeinterface, "_reader", lambda name: read)
    (tmp_path / "a.rhd").touch()
    (tmp_path / "a_stimuli.csv").write_text("-3.0\n1.5\n")
    recording = convert_recording(tmp_path / "a.rhd", tmp_path / "with.nwb", reader="intan")
    (tmp_path / "a_stimuli.csv").unlink()
    without = convert_recording(tmp_path / "a.rhd", tmp_path / "without.nwb", reader="intan")
    assert len(without.spike_times_s) > 10 and (without.start_s, without.stop_s) == (0.0, 1.0)
    assert recording.spike_times_s.tolist() == without.spike_times_s.tolist()
    assert recording.start_s == -3.0 and recording.stop_s >= 1.5
    assert (recording.channels.x_um.tolist(), recording.channels.y_um.tolist()) == ([1.0, 3.0, 5.0], [2.0, 4.0, 6.0])
    # Nothing is installed behind the user's back.
    with_spikeinterface.open_with_spikeinterface(tmp_path / "a.rhd", "maxwell")
    assert given == [{}, {}, {"install_maxwell_plugin": False}]
    (tmp_path / "a_stimuli.csv").write_text("time_s,frequncy_hz\n0.2,5\n")
    _, misspelt = with_spikeinterface.open_with_spikeinterface(tmp_path / "a.rhd", "intan")
    assert [finding.message for finding in misspelt.findings if finding.name == "columns-left-out"] == [
        "unknown columns of a_stimuli.csv were left out: frequncy_hz (did you mean frequency_hz?)"
    ]
    (tmp_path / "a_stimuli.csv").write_text("time_s,presentation\n0.2,2\n0.3,1\n")
    with pytest.raises(InvalidFile, match=r"a_stimuli\.csv: stimulus_presentation: expected numbers that never fall"):
        with_spikeinterface.open_with_spikeinterface(tmp_path / "a.rhd", "intan")
    (tmp_path / "a_stimuli.csv").unlink()
    monkeypatch.setattr(Traces, "get_num_segments", staticmethod(lambda: 2))
    with pytest.raises(InvalidFile, match="expected one segment of traces, got 2"):
        with_spikeinterface.open_with_spikeinterface(tmp_path / "a.rhd", "intan")


@pytest.mark.parametrize(("age", "fits"), [("P40D/P42D", True), ("P6W/P42D", True), ("P42D/P40D", False),
                                           ("P1Y/P6M", False), ("PT36H/P1D", False), ("P1D/", True)])  # fmt: skip
def test_a_range_of_ages_begins_with_the_younger(age: str, fits: bool) -> None:
    if fits:
        assert Origin(age=age).age == age
    else:
        with pytest.raises(InvalidArgument, match="age: expected a range with the younger age first"):
            Origin(age=age)


@pytest.mark.parametrize("who", ["Jane Doe", "Doe, Jane; Max", ""])
def test_an_experimenter_is_last_first(who: str) -> None:
    assert Origin(experimenter="Doe, Jane; Müller, Max").experimenter == "Doe, Jane; Müller, Max"
    with pytest.raises(InvalidArgument, match="experimenter: expected Last, First, several separated by semicolons"):
        Origin(experimenter=who)


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("date", "is_noted"),
    [
        ("2024-05-31T14:00:00", True),
        ("2024-05-31", True),
        ("2024-05-31T14:00:00+09:00", False),
        ("2024-05-31T14:00Z", False),
    ],
)
def test_a_date_without_a_zone_is_taken_as_utc_with_a_note(date: str, is_noted: bool, tmp_path: Path) -> None:
    origin = Origin(recorded_at=date, subject_id="c")
    written = convert_recording(rig_file("npz", tmp_path), tmp_path / "out.nwb", origin, start_min=30.0)
    findings = {finding.name: finding for finding in written.findings}
    assert ("zone-unknown" in findings) == is_noted
    with h5py.File(tmp_path / "out.nwb") as file:
        assert ("+00:00" in file["session_start_time"][()].decode()) == (is_noted or date.endswith("Z"))
    again = convert_recording(tmp_path / "out.nwb", tmp_path / "again.nwb", start_min=0.0)
    assert (written.start_min, again.start_min) == (30.0, 0.0)
    with NWBHDF5IO(tmp_path / "again.nwb", "r") as io:
        assert again.recorded_at == written.recorded_at == io.read().session_start_time
    # The culture has the name that was given.
    assert written.culture is not None and written.culture == again.culture
    assert [finding.name for finding in again.findings] == [finding.name for finding in written.findings]


def test_what_a_killed_conversion_left_is_removed_by_the_next(tmp_path: Path) -> None:
    path = rig_file("npz", tmp_path)
    for name in (".out.nwb.0123abcd.partial.nwb", ".other.nwb.0123abcd.partial.nwb"):
        (tmp_path / name).write_bytes(b"half")
    convert_recording(path, tmp_path / "out.nwb")
    assert sorted(file.name for file in tmp_path.glob(".*")) == [".other.nwb.0123abcd.partial.nwb"]
