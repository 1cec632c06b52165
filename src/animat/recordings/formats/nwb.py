"""NWB, the recording's own format on disk: written with pynwb as whole columns, read with plain h5py.

    /units                         one unit a channel, silent ones included: spike_times, obs_intervals, electrodes
    /general/extracellular_ephys   /electrodes: label, electrode_id, rel_x, rel_y (um); one row a channel
                                   (both are absent where a recording has no channel)
    /stimulus/presentation/stimuli TimeIntervals, one row a pulse: start_time, frequency_hz, pattern, presentation,
                                   electrode_ids (ragged: ids on the array, which need not be recorded electrodes)
    /processing/ecephys            /animat_recording: one row, the scalars of `Recording` and its presentation;
                                   /animat_provenance: one row a key (absent where there is none)

NWB has fields of its own for who recorded what. They are filled from `Recording.provenance` where it has these
keys, all optional: `recorded_at` (ISO 8601; UTC where it names no zone), `session_description`,
`experiment_description`, `experimenter`, `lab`, `institution`, `keywords` (comma-separated), and for the subject
`subject_id`, `species` (Latin), `sex`, `age` (ISO 8601 duration), `subject_description`. So they travel with the
recording and need no second argument.
"""

from __future__ import annotations

import io
import os
import uuid
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument, InvalidFile, UnusableData
from animat.recordings.protocol import Presentation
from animat.recordings.recording import UNKNOWN, Channels, Recording, Stimuli
from animat.writing import written_whole

FORMAT_VERSION = 1
"""Of the tables above; written into every file, and a newer one is refused."""

RECORDING_TABLE = "processing/ecephys/animat_recording"
PROVENANCE_TABLE = "processing/ecephys/animat_provenance"
UNITS_TABLE = "units"
ELECTRODES_TABLE = "general/extracellular_ephys/electrodes"
STIMULI_TABLE = "stimulus/presentation/stimuli"
UNKNOWN_DATE = "1970-01-01T00:00:00+00:00"
"""NWB demands a date; a recording without `recorded_at` gets this one, which every reader sees to be none."""

_SUBJECT_KEYS = {
    "subject_id": "subject_id",
    "species": "species",
    "sex": "sex",
    "age": "age",
    "subject_description": "description",
}
_FILE_KEYS = ("experiment_description", "lab", "institution")


def write_nwb(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as one NWB file, complete or absent.

    Args:
        recording: what to write.
        path: the file; parent folders are made, an old file is replaced only by a complete new one.

    Raises:
        InvalidFile: if the file cannot be written (no permission, a full disk).
        InvalidArgument: for text that HDF5 cannot hold, or a `recorded_at` that is no date.
    """
    # The file is put together in memory: HDF5 does not recover from a disk that fills up under it, and a recording
    # is small (2 MB for 205,000 spikes).
    image = _nwb_image(recording)
    with written_whole(path) as beside:
        beside.write_bytes(image)


def read_nwb(path: str | os.PathLike[str]) -> Recording:
    """Read a recording that `write_nwb` wrote; it equals the one that was written.

    Args:
        path: the file.

    Raises:
        InvalidFile: if the file is missing, damaged, or not an NWB recording of animat.
    """
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            return _read(file, path)
    except FileNotFoundError as error:
        raise InvalidFile(f"{path}: no such file") from error
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, UnusableData) as error:
        raise InvalidFile(
            f"{path}: expected a whole NWB recording, but it is cut off or damaged ({_first_line(error)}); "
            "copy or record it again"
        ) from error


# --- writing ---------------------------------------------------------------------------------------------------------


def _nwb_image(recording: Recording) -> bytes:
    """The bytes of the NWB file."""
    from pynwb import NWBHDF5IO

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file, NWBHDF5IO(file=file, mode="w") as nwb_io:
        nwb_io.write(_nwb_file(recording))
    return buffer.getvalue()


def _nwb_file(recording: Recording) -> Any:
    from pynwb import NWBFile
    from pynwb.file import Subject

    words = {_text("provenance", k): _text("provenance", v) for k, v in recording.provenance.items()}
    nwb = NWBFile(
        session_description=words.get(
            "session_description", "Spikes of a neuronal culture on a multi-electrode array, under stimulation."
        ),
        identifier=str(uuid.uuid4()),
        session_start_time=_date(words.get("recorded_at", UNKNOWN_DATE)),
        experimenter=[words["experimenter"]] if "experimenter" in words else None,
        keywords=_split(words.get("keywords", "multi-electrode array, neuronal culture, electrical stimulation")),
        source_script="animat.recordings.formats.nwb.write_nwb",
        source_script_file_name="nwb.py",
        **{key: words[key] for key in _FILE_KEYS if key in words},
    )
    subject = {field: words[key] for key, field in _SUBJECT_KEYS.items() if key in words}
    if subject:
        nwb.subject = Subject(**subject)
    if len(recording.channels):
        _add_electrodes(nwb, recording.channels)
        _add_units(nwb, recording)
    nwb.add_stimulus(_stimulus_table(recording.stimuli))
    module = nwb.create_processing_module(name="ecephys", description="What the recording is, for the package animat.")
    module.add(_recording_table(recording))
    if words:
        module.add(_provenance_table(words))
    return nwb


def _add_electrodes(nwb: Any, channels: Channels) -> None:
    """The electrodes table, one row a channel."""
    from hdmf.common import VectorData
    from pynwb.ecephys import ElectrodesTable

    device = nwb.create_device(name="array", description="multi-electrode array")
    group = nwb.create_electrode_group(
        name="array", description="the recording electrodes", location="in vitro", device=device
    )
    rows = len(channels)
    labels = [_text("channels.label", label) for label in channels.label]
    nwb.electrodes = ElectrodesTable(
        id=np.arange(rows),
        columns=[
            VectorData(name="location", description="where the electrode is", data=["in vitro"] * rows),
            VectorData(name="group", description="the array", data=[group] * rows),
            VectorData(name="group_name", description="the array", data=["array"] * rows),
            VectorData(name="rel_x", description="x on the array, um; NaN: unknown", data=channels.x_um),
            VectorData(name="rel_y", description="y on the array, um; NaN: unknown", data=channels.y_um),
            VectorData(name="label", description="the rig's own name of the channel", data=labels),
            VectorData(name="electrode_id", description="electrode on the array; -1: unknown", data=channels.electrode),
        ],
    )


def _add_units(nwb: Any, recording: Recording) -> None:
    """The units table, one row a channel, so that a silent channel stays a channel."""
    from hdmf.common import DynamicTableRegion, VectorData, VectorIndex
    from pynwb.misc import Units

    rows = len(recording.channels)
    by_channel = np.argsort(recording.spike_channels, kind="stable")
    ends = np.cumsum(np.bincount(recording.spike_channels, minlength=rows)).astype(np.int64)
    times = VectorData(name="spike_times", description="spike times, s", data=recording.spike_times_s[by_channel])
    observed = VectorData(
        name="obs_intervals",
        description="from the start to the end of the recording, s",
        data=np.tile([recording.start_s, recording.stop_s], (rows, 1)).reshape(rows, 2),
    )
    electrodes = DynamicTableRegion(
        name="electrodes", description="row in the electrodes table", data=np.arange(rows), table=nwb.electrodes
    )
    one_each = np.arange(1, rows + 1)
    nwb.units = Units(
        name="units",
        description="All spikes of each recording channel (multi-unit activity, or sorted units; see provenance).",
        id=np.arange(rows),
        columns=[
            times,
            VectorIndex(name="spike_times_index", data=ends, target=times),
            observed,
            VectorIndex(name="obs_intervals_index", data=one_each, target=observed),
            electrodes,
            VectorIndex(name="electrodes_index", data=one_each, target=electrodes),
        ],
        electrode_table=nwb.electrodes,
    )
    if np.isfinite(recording.sampling_rate_hz):
        nwb.units.resolution = 1.0 / recording.sampling_rate_hz


def _stimulus_table(stimuli: Stimuli) -> Any:
    from hdmf.common import VectorData, VectorIndex
    from pynwb.epoch import TimeIntervals

    # A row keeps its electrodes up to the last known one, so that padding between known ones survives too.
    known = stimuli.electrodes != UNKNOWN
    position = np.arange(1, stimuli.electrodes.shape[1] + 1)
    lengths = np.max(known * position, axis=1, initial=0)
    kept = position[None, :] <= lengths[:, None]
    electrodes = VectorData(
        name="electrode_ids", description="electrodes on the array pulsed together", data=stimuli.electrodes[kept]
    )
    columns = [
        VectorData(name="start_time", description="start of the pulse, s", data=stimuli.time_s),
        # NWB demands an end; the pulse's length is not kept, and readers take an empty interval for a mistake.
        VectorData(name="stop_time", description="nominal: 1 us after start_time", data=stimuli.time_s + 1e-6),
        VectorData(name="frequency_hz", description="stimulus frequency; NaN: unknown", data=stimuli.frequency_hz),
        VectorData(name="pattern", description="stimulation pattern; -1: unknown", data=stimuli.pattern),
        VectorData(
            name="presentation", description="presentation that the pulse belongs to", data=stimuli.presentation
        ),
        electrodes,
        VectorIndex(name="electrode_ids_index", data=np.cumsum(lengths).astype(np.int64), target=electrodes),
    ]
    return TimeIntervals(
        name="stimuli",
        description="Stimulation pulses, one row a pulse.",
        id=np.arange(len(stimuli)),
        columns=columns,
    )


def _recording_table(recording: Recording) -> Any:
    from hdmf.common import DynamicTable, VectorData

    presentation = recording.presentation
    cells: dict[str, tuple[object, str]] = {
        "format_version": (FORMAT_VERSION, "of the tables that animat writes"),
        "start_s": (float(recording.start_s), "start of the recording on its own clock, s"),
        "duration_s": (float(recording.duration_s), "from start_s, s"),
        "start_min": (float(recording.start_min), "start of the recording on the culture's clock, min"),
        "sampling_rate_hz": (float(recording.sampling_rate_hz), "of the raw signal, Hz; NaN: unknown"),
        "presentation_order": (presentation.order if presentation else "", "blocked or mixed; empty: unknown"),
        "presentation_pulses": (presentation.pulses if presentation else 0, "pulses a presentation; 0: unknown"),
        "stimulus_electrode_columns": (recording.stimuli.electrodes.shape[1], "width of the padded electrode table"),
    }
    return DynamicTable(
        name="animat_recording",
        description="The scalars of the recording, one row.",
        id=np.arange(1),
        columns=[VectorData(name=n, description=words, data=[value]) for n, (value, words) in cells.items()],
    )


def _provenance_table(words: Mapping[str, str]) -> Any:
    from hdmf.common import DynamicTable, VectorData

    return DynamicTable(
        name="animat_provenance",
        description="Where the recording came from, and what was noticed when it was read.",
        id=np.arange(len(words)),
        columns=[
            VectorData(name="key", description="what the words are about", data=list(words)),
            VectorData(name="words", description="the words", data=list(words.values())),
        ],
    )


def _text(name: str, text: object) -> str:
    text = str(text)
    try:
        encoded = text.encode("utf-8")
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise InvalidArgument(f"{name}: expected text without null characters or lone surrogates, got {text!r}")
    return text


def _date(text: str) -> datetime:
    try:
        date = datetime.fromisoformat(text)
    except ValueError as error:
        raise InvalidArgument(
            f"provenance['recorded_at']: expected an ISO 8601 date such as 2024-05-31T14:00:00+09:00, got {text!r}"
        ) from error
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def _split(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


# --- reading ---------------------------------------------------------------------------------------------------------

T = TypeVar("T", int, float, str)


def _read(file: h5py.File, path: Path) -> Recording:
    if "nwb_version" not in file.attrs:
        raise InvalidFile(f"{path}: expected NWB, got another HDF5 file (it holds: {_listed(file)})")
    if RECORDING_TABLE not in file:
        raise InvalidFile(
            f"{path}: expected an NWB recording written by animat (with /{RECORDING_TABLE}), got another program's; "
            "bring its spikes and stimuli as NPZ or CSV"
        )
    table = file[RECORDING_TABLE]
    version = _cell(table, "format_version", int)
    if version > FORMAT_VERSION:
        raise InvalidFile(
            f"{path}: expected format version {FORMAT_VERSION} or older, got {version}: update animat to read it"
        )
    order, pulses = _cell(table, "presentation_order", str), _cell(table, "presentation_pulses", int)
    times, channels = _spikes(file)
    return Recording(
        spike_times_s=times,
        spike_channels=channels,
        channels=_channels(file),
        stimuli=_stimuli(file[STIMULI_TABLE], _cell(table, "stimulus_electrode_columns", int)),
        sampling_rate_hz=_cell(table, "sampling_rate_hz", float),
        start_s=_cell(table, "start_s", float),
        duration_s=_cell(table, "duration_s", float),
        start_min=_cell(table, "start_min", float),
        presentation=Presentation(order, pulses) if order else None,  # type: ignore[arg-type]
        provenance=_provenance(file),
    )


def _cell(table: h5py.Group, name: str, kind: Callable[[Any], T]) -> T:
    value = table[name][0]
    return kind(value.decode() if isinstance(value, bytes) else value)


def _spikes(file: h5py.File) -> tuple[Float64[np.ndarray, " spikes"], Int64[np.ndarray, " spikes"]]:
    if UNITS_TABLE not in file:
        return np.empty(0), np.empty(0, dtype=np.int64)
    units = file[UNITS_TABLE]
    times = units["spike_times"][:]
    counts = np.diff(units["spike_times_index"][:].astype(np.int64), prepend=0)
    channels = np.repeat(np.arange(len(counts)), counts)
    # Channel after channel: a stable sort leaves simultaneous spikes in the order of their channels, as Recording does.
    order = np.argsort(times, kind="stable")
    return times[order], channels[order]


def _channels(file: h5py.File) -> Channels:
    if ELECTRODES_TABLE not in file:
        return Channels(label=np.empty(0, np.str_), electrode=np.empty(0, np.int64), x_um=np.empty(0), y_um=np.empty(0))
    table = file[ELECTRODES_TABLE]
    return Channels(
        label=np.array(_words(table["label"]), dtype=np.str_),
        electrode=table["electrode_id"][:],
        x_um=table["rel_x"][:],
        y_um=table["rel_y"][:],
    )


def _provenance(file: h5py.File) -> dict[str, str]:
    if PROVENANCE_TABLE not in file:
        return {}
    table = file[PROVENANCE_TABLE]
    return dict(zip(_words(table["key"]), _words(table["words"]), strict=True))


def _words(column: h5py.Dataset) -> list[str]:
    return [text.decode() for text in column[:]]


def _stimuli(table: h5py.Group, columns: int) -> Stimuli:
    lengths = np.diff(table["electrode_ids_index"][:].astype(np.int64), prepend=0)
    electrodes = np.full((len(lengths), columns), UNKNOWN, dtype=np.int64)
    electrodes[np.arange(columns)[None, :] < lengths[:, None]] = table["electrode_ids"][:]
    return Stimuli(
        time_s=table["start_time"][:],
        frequency_hz=table["frequency_hz"][:],
        pattern=table["pattern"][:],
        electrodes=electrodes,
        presentation=table["presentation"][:],
    )


def _listed(group: h5py.Group) -> str:
    names = list(group)
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "") if names else "nothing"


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
