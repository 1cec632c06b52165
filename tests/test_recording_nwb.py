"""NWB: a saved recording reads back equal. Oracles: pynwb's validator and reader, nwbinspector, real full disks."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.findings import Finding
from animat.recordings.formats.hdf5_formats import read_hdf5
from animat.recordings.formats.nwb import _ErrorKeepingFile, write_nwb
from animat.recordings.formats.nwb_spikes import write_spikes
from animat.recordings.reading import read_recording
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN
from synthetic_recordings import synthetic_recording

TEXT = st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)), max_size=8)
FEW = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def recordings(draw: st.DrawFn, max_channels: int = 6) -> Recording:
    n_channels = draw(st.integers(0, max_channels))
    n_spikes = draw(st.integers(0, 30)) if n_channels else 0
    n_stimuli, width = draw(st.integers(0, 8)), draw(st.integers(0, 4))
    start_s = draw(st.floats(-1e4, 1e4))
    # Few distinct times, so that spikes and stimuli coincide.
    times = st.integers(0, 20).map(lambda step: start_s + 0.5 * step)
    spike_s = draw(npst.arrays(np.float64, n_spikes, elements=times))
    stimulus_s = draw(npst.arrays(np.float64, n_stimuli, elements=times))
    whole = st.integers(-1, 2**40)
    presentations = st.builds(Presentation, st.sampled_from(["blocked", "mixed"]), st.integers(1, 9))
    position = st.floats(allow_nan=True, allow_infinity=False)
    return Recording(
        spike_times_s=np.sort(spike_s),
        spike_channels=draw(npst.arrays(np.int64, n_spikes, elements=st.integers(0, max(n_channels - 1, 0)))),
        channels=Channels(
            # numpy's text arrays do not keep null characters at the end, nor does anyone need them.
            label=np.array(draw(st.lists(TEXT, min_size=n_channels, max_size=n_channels, unique=True)), dtype=np.str_),
            electrode=draw(npst.arrays(np.int64, n_channels, elements=whole)),
            x_um=draw(npst.arrays(np.float64, n_channels, elements=position)),
            y_um=draw(npst.arrays(np.float64, n_channels, elements=position)),
        ),
        stimuli=Stimuli(
            time_s=np.sort(stimulus_s),
            frequency_hz=draw(
                npst.arrays(np.float64, n_stimuli, elements=st.sampled_from([np.nan, 0.2, 5.0, 80.0, 1 / 3]))
            ),
            pattern=draw(npst.arrays(np.int64, n_stimuli, elements=whole)),
            electrodes=draw(npst.arrays(np.int64, (n_stimuli, width), elements=st.sampled_from([UNKNOWN, 7, 26_399]))),
            presentation=np.sort(draw(npst.arrays(np.int64, n_stimuli, elements=whole))),
        ),
        sampling_rate_hz=draw(st.sampled_from([np.nan, 20_000.0, 25_000.0])),
        start_s=start_s,
        duration_s=draw(st.floats(10.1, 1e5)),
        start_min=draw(st.floats(-1e6, 1e6)),
        presentation=draw(st.none() | presentations),
        provenance=draw(st.dictionaries(TEXT, TEXT, max_size=3)),
    )


@pytest.fixture(scope="module")
def synthetic() -> Recording:
    return synthetic_recording(3, start_min=20.0, patterns=12, channels=32)


@FEW
@given(recording=recordings())
def test_a_saved_recording_reads_back_equal(recording: Recording, tmp_path: Path) -> None:
    write_nwb(recording, tmp_path / "a.nwb")
    assert read_recording(tmp_path / "a.nwb").equals(recording)


@pytest.mark.oracle
@settings(FEW, max_examples=4)
@given(recording=recordings())
def test_pynwb_finds_every_saved_recording_valid(recording: Recording, tmp_path: Path) -> None:
    import pynwb

    write_nwb(recording, tmp_path / "a.nwb")
    assert pynwb.validate(path=str(tmp_path / "a.nwb")) == []


def test_a_recording_of_205_000_spikes_on_1024_channels_reads_back_equal(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    recording = Recording(
        spike_times_s=np.sort(np.round(rng.uniform(-1, 100, 205_000) * 20_000) / 20_000),
        spike_channels=rng.integers(0, 1024, 205_000),
        channels=Channels(np.arange(1024).astype(str), np.arange(1024), rng.random(1024), rng.random(1024)),
        stimuli=synthetic_recording(0).stimuli,
        sampling_rate_hz=20_000.0,
        start_s=-1.0,
        duration_s=101.0,
    )
    write_nwb(recording, tmp_path / "a.nwb")
    assert read_hdf5(tmp_path / "a.nwb").equals(recording)


def test_pynwb_reads_the_same_spikes_electrodes_and_stimuli(synthetic: Recording, tmp_path: Path) -> None:
    import pynwb

    write_nwb(synthetic, tmp_path / "a.nwb")
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "r") as nwb_io:
        nwb = nwb_io.read()
        assert len(nwb.units) == len(synthetic.channels)
        for channel in range(len(synthetic.channels)):
            expected_s = synthetic.spike_times_s[synthetic.spike_channels == channel]
            np.testing.assert_array_equal(nwb.units["spike_times"][channel], expected_s)
            region = nwb.units["electrodes"][channel]
            assert region["label"].tolist() == [synthetic.channels.label[channel]]
        electrodes = nwb.electrodes.to_dataframe()
        np.testing.assert_array_equal(electrodes["electrode_id"], synthetic.channels.electrode)
        np.testing.assert_array_equal(electrodes["rel_x"], synthetic.channels.x_um)
        stimuli = nwb.stimulus["stimuli"].to_dataframe()
        np.testing.assert_array_equal(stimuli["start_time"], synthetic.stimuli.time_s)
        np.testing.assert_array_equal(stimuli["frequency_hz"], synthetic.stimuli.frequency_hz)
        np.testing.assert_array_equal(np.stack(stimuli["electrode_ids"].tolist()), synthetic.stimuli.electrodes)
        np.testing.assert_array_equal(nwb.units["obs_intervals"][0], [[synthetic.start_s, synthetic.stop_s]])
        assert nwb.units.resolution == 1 / 20_000


def test_the_origin_is_written_to_nwbs_own_fields(synthetic: Recording, tmp_path: Path) -> None:
    import pynwb

    write_nwb(with_subject(synthetic), tmp_path / "a.nwb")
    with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "r") as nwb_io:
        nwb = nwb_io.read()
        assert nwb.experimenter == ("Doe, Jane", "Roe, Richard")
        assert nwb.subject.species == "Rattus norvegicus"
        assert nwb.session_start_time.isoformat() == "2024-05-31T14:00:00+09:00"
        assert nwb.keywords[:].tolist() == ["culture", "stimulation"]


@pytest.mark.oracle
def test_nwbinspector_finds_nothing_critical_and_no_violation(synthetic: Recording, tmp_path: Path) -> None:
    pytest.importorskip("nwbinspector", reason="nwbinspector is not installed")
    from nwbinspector import Importance, inspect_nwbfile

    write_nwb(with_subject(synthetic), tmp_path / "a.nwb")
    messages = list(inspect_nwbfile(nwbfile_path=str(tmp_path / "a.nwb")))
    # What is left is a suggestion: the table of scalars has one row.
    assert [m.check_function_name for m in messages if m.importance != Importance.BEST_PRACTICE_SUGGESTION] == []


@pytest.mark.oracle
def test_nwbinspector_finds_nothing_critical_in_what_a_culture_records(synthetic: Recording, tmp_path: Path) -> None:
    pytest.importorskip("nwbinspector", reason="nwbinspector is not installed")
    from nwbinspector import Importance, inspect_nwbfile

    write_nwb(synthetic, tmp_path / "a.nwb")
    messages = list(inspect_nwbfile(nwbfile_path=str(tmp_path / "a.nwb")))
    grave = (Importance.CRITICAL, Importance.ERROR, Importance.PYNWB_VALIDATION)
    assert [m.check_function_name for m in messages if m.importance in grave] == []
    # No species is made up for a culture that nobody named one of.
    violations = [m.check_function_name for m in messages if m.importance == Importance.BEST_PRACTICE_VIOLATION]
    assert violations == ["check_subject_species_exists"]


def with_subject(recording: Recording) -> Recording:
    import dataclasses

    who = {
        "experimenter": "Doe, Jane; Roe, Richard",
        "institution": "An Institute",
        "lab": "A Laboratory",
        "recorded_at": "2024-05-31T14:00:00+09:00",
        "keywords": "culture, stimulation",
        "experiment_description": "Responses to five frequencies.",
        "subject_id": "culture-1",
        "species": "Rattus norvegicus",
        "sex": "U",
        "age": "P42D",
        "subject_description": "dissociated cortical culture",
    }
    return dataclasses.replace(recording, provenance={**recording.provenance, **who})


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused_in_one_line(synthetic: Recording, tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.nwb"
    write_nwb(synthetic, path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InvalidFile, match=r"a\.nwb: expected a complete HDF5 recording, but it is cut off") as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)


@pytest.mark.oracle
def test_damage_anywhere_in_the_file_raises_our_error_or_is_harmless(synthetic: Recording, tmp_path: Path) -> None:
    path = tmp_path / "a.nwb"
    write_nwb(synthetic, path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for start in rng.integers(8, len(content) - 64, 60).tolist():
        path.write_bytes(content[:start] + rng.bytes(64) + content[start + 64 :])
        try:
            read_hdf5(path)
        except InvalidFile as error:
            assert "\n" not in str(error)


def test_another_programs_files_are_refused(tmp_path: Path) -> None:
    import datetime

    import pynwb

    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["voltage"] = np.zeros(3)
    with pytest.raises(InvalidFile, match=r"a\.h5: expected NWB, MaxWell or CL1, got another HDF5 file \(it holds: vo"):
        read_recording(tmp_path / "a.h5")
    start = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    with pynwb.NWBHDF5IO(str(tmp_path / "b.nwb"), "w") as nwb_io:
        nwb_io.write(pynwb.NWBFile(session_description="x", identifier="x", session_start_time=start))
    with pytest.raises(
        InvalidFile,
        match=r"b\.nwb: expected spikes in /units or in a processing module, found none and no traces either",
    ):
        read_recording(tmp_path / "b.nwb")


def test_a_file_of_a_later_format_version_is_refused(synthetic: Recording, tmp_path: Path) -> None:
    write_nwb(synthetic, tmp_path / "a.nwb")
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        file["processing/ecephys/animat_recording/format_version"][0] = 2
    with pytest.raises(InvalidFile, match="expected format version 1 or older, got 2: update animat"):
        read_hdf5(tmp_path / "a.nwb")


@pytest.mark.parametrize(
    ("provenance", "message"),
    [({"source": "a\0b"}, "without null characters"), ({"recorded_at": "yesterday"}, "ISO 8601 date")],
)
def test_text_that_the_file_cannot_hold_is_refused(
    synthetic: Recording, tmp_path: Path, provenance: dict[str, str], message: str
) -> None:
    import dataclasses

    with pytest.raises(InvalidArgument, match=message):
        write_nwb(dataclasses.replace(synthetic, provenance=provenance, culture=None), tmp_path / "a.nwb")
    assert list(tmp_path.iterdir()) == []


SAVE_ON_A_FULL_DISK = """
import resource, signal, sys
from animat.errors import InvalidFile
from animat.recordings.formats.nwb import write_nwb
from synthetic_recordings import synthetic_recording
recording = synthetic_recording(4)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    write_nwb(recording, sys.argv[1])
except InvalidFile as error:
    print(error)
    sys.exit(3)
"""


@pytest.mark.oracle
def test_a_full_disk_leaves_the_old_file_intact(synthetic: Recording, tmp_path: Path) -> None:
    path = tmp_path / "a.nwb"
    write_nwb(synthetic, path)
    before = path.read_bytes()
    assert len(before) > 100_000
    done = subprocess.run(
        [sys.executable, "-c", SAVE_ON_A_FULL_DISK, str(path)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    assert "a.nwb: cannot be written: File too large; any previous file is unchanged" in done.stdout
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.nwb"]
    assert read_hdf5(path).equals(synthetic)


def test_what_a_full_disk_did_not_take_is_read_as_zeros(tmp_path: Path) -> None:
    """Otherwise HDF5 works on with whatever the buffer held, which ended the process."""
    (tmp_path / "a.nwb").touch()
    with _ErrorKeepingFile(tmp_path / "a.nwb", "r+") as file:
        file.write(b"taken")
        file.error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        assert file.write(b"not taken") == 9
        file.seek(0)
        buffer = bytearray(b"x" * 14)
        assert file.readinto(buffer) == 14
    assert buffer == b"taken" + bytes(9)


WRITE_BESIDE_A_HALF_WRITTEN_CACHE = """
import sys
from pathlib import Path
import hdmf
from importlib.metadata import version
from platformdirs import PlatformDirs
from animat.recordings.formats.nwb import write_nwb
from synthetic_recordings import synthetic_recording
own = PlatformDirs(appname="pynwb-hdmf", version=f"{version('pynwb')}-{hdmf.__version__}", ensure_exists=True)
(own.user_cache_path / "pynwb_core_typemap.pkl").write_bytes(b"")
write_nwb(synthetic_recording(4), sys.argv[1])
"""


@pytest.mark.oracle
def test_a_cache_that_another_process_is_writing_is_not_read(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYNWB_NO_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    done = subprocess.run(
        [sys.executable, "-c", WRITE_BESIDE_A_HALF_WRITTEN_CACHE, str(tmp_path / "a.nwb")],
        cwd=Path(__file__).parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert len(read_hdf5(tmp_path / "a.nwb").channels) > 0


@pytest.mark.parametrize(
    "changed",
    [
        {"provenance": {"protocol": "five frequencies, blocked"}},
        {"provenance": {"note: slice": "7"}},
        {"culture": RecordedCulture("virtual", 3)},
        {"provenance": {"source": "virtual culture of a colleague", "seed": "7"}},
    ],
)
def test_provenance_that_would_read_back_differently_is_not_written(changed: dict[str, object], tmp_path: Path) -> None:
    recording = replace(synthetic_recording(seed=1), **{"culture": None, "provenance": {}, **changed})
    with pytest.raises(InvalidArgument, match=r"^(provenance|culture): expected "):
        write_nwb(recording, tmp_path / "recording.nwb")
    assert not list(tmp_path.iterdir())


@given(st.lists(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2)), max_size=6), max_size=5))
def test_spikes_in_any_order_and_in_any_blocks_are_written_in_ascending_order(
    blocks: list[list[tuple[int, int]]],
) -> None:
    spikes = [spike for block in blocks for spike in block]
    arrays = [(np.array([t for t, _ in b], np.float64), np.array([c for _, c in b], np.int64)) for b in blocks]
    counts = np.bincount([c for _, c in spikes], minlength=3)
    with h5py.File("any.h5", "w", driver="core", backing_store=False) as file:
        dataset = file.create_dataset("times", len(spikes), np.float64)
        write_spikes(dataset, arrays, counts)
        assert dataset[:].tolist() == [t for c in range(3) for t in sorted(t for t, of in spikes if of == c)]


def test_a_date_and_findings_alike_are_kept(tmp_path: Path) -> None:
    lost = Finding("left-out", "note", "3 keys", 3.0), Finding("left-out", "note", "4 rows", 4.0)
    recording = replace(
        synthetic_recording(1, patterns=3, channels=4), findings=(*lost, Finding("bad #12", "note", "5 rows"))
    )
    dated = replace(recording, recorded_at=datetime(2024, 5, 31, 14, tzinfo=UTC))
    write_nwb(dated, tmp_path / "dated.nwb")
    read = read_recording(tmp_path / "dated.nwb")
    assert read.recorded_at == dated.recorded_at and read.findings == dated.findings
    with pytest.raises(InvalidArgument, match=r"recorded_at: expected 2024-05-31 .* by the provenance, got 2025"):
        write_nwb(replace(read, recorded_at=datetime(2025, 1, 1, tzinfo=UTC)), tmp_path / "other.nwb")
