"""Makes the NWB tables of a recording as pynwb objects, as whole columns. Imports pynwb (1-2 s): import it late."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime

import numpy as np
from hdmf.backends.hdf5.h5_utils import H5DataIO
from hdmf.common import DynamicTable, DynamicTableRegion, VectorData, VectorIndex
from jaxtyping import Int64
from pynwb import NWBFile
from pynwb.ecephys import ElectrodesTable
from pynwb.epoch import TimeIntervals
from pynwb.file import Subject
from pynwb.misc import Units

from animat.errors import InvalidArgument
from animat.recordings.formats.nwb_layout import FORMAT_VERSION, SUBJECT
from animat.recordings.metadata import to_metadata
from animat.recordings.recording import Channels, Recording
from animat.stimulation.stimulus import NOTHING, Stimuli
from animat.tables import UNKNOWN

UNKNOWN_DATE = "1970-01-01T00:00:00+00:00"
"""NWB requires a date; a recording without `recorded_at` gets this one, which readers recognise as unknown."""

UNKNOWN_SUBJECT = {
    "subject_id": "unknown",
    "sex": "U",
    "age": "P0D/",
    "description": "neuronal culture; nothing else is known",
}
"""Sex U is unknown, and an age from 0 days on without an upper limit is any age."""
_FILE_KEYS = ("experiment_description", "lab", "institution")


def nwb_file(recording: Recording, spike_counts: Int64[np.ndarray, " channels"]) -> NWBFile:
    """A recording as a pynwb object tree, with room for spikes; see `animat.recordings.formats.nwb_layout`.

    Args:
        recording: everything but its spikes is used.
        spike_counts: of each channel; the caller writes the times.
    """
    texts = {_text("provenance", k): _text("provenance", v) for k, v in to_metadata(recording).items()}
    nwb = NWBFile(
        session_description=texts.get(
            "session_description", "Spikes of a neuronal culture on a multi-electrode array, under stimulation."
        ),
        identifier=str(uuid.uuid4()),
        session_start_time=_date(texts.get("recorded_at", UNKNOWN_DATE)),
        experimenter=_split(texts["experimenter"], ";") if "experimenter" in texts else None,
        keywords=_split(texts.get("keywords", "multi-electrode array, neuronal culture, electrical stimulation"), ","),
        source_script="animat.recordings.formats.nwb.write_nwb",
        source_script_file_name="nwb.py",
        **{key: texts[key] for key in _FILE_KEYS if key in texts},
    )
    # NWB's checkers require a subject; an unknown one is written as unknown.
    known = {field: texts[key] for field, key in SUBJECT.items() if key in texts}
    nwb.subject = Subject(**(UNKNOWN_SUBJECT | known))
    if len(recording.channels):
        _add_electrodes(nwb, recording.channels)
        _add_units(nwb, recording, spike_counts)
    nwb.add_stimulus(_stimulus_table(recording.stimuli))
    module = nwb.create_processing_module(name="ecephys", description="Data of the recording for the package animat.")
    module.add(_recording_table(recording))
    if texts:
        module.add(
            DynamicTable(
                name="animat_provenance",
                description="Where the recording came from, and findings made when it was read.",
                id=np.arange(len(texts)),
                columns=[
                    VectorData(name="key", description="keyword", data=list(texts)),
                    VectorData(name="words", description="text", data=list(texts.values())),
                ],
            )
        )
    return nwb


def _add_electrodes(nwb: NWBFile, channels: Channels) -> None:
    """The electrodes table, one row per channel."""
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


def _add_units(nwb: NWBFile, recording: Recording, spike_counts: Int64[np.ndarray, " channels"]) -> None:
    """The units table, one row per channel, so that silent channels are kept."""
    rows = len(recording.channels)
    ends = np.cumsum(spike_counts).astype(np.int64)
    room = H5DataIO(shape=(int(spike_counts.sum()),), dtype=np.dtype(np.float64))
    times = VectorData(name="spike_times", description="spike times, s", data=room)
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


def _stimulus_table(stimuli: Stimuli) -> TimeIntervals:
    # A row keeps its electrodes up to the last known one, so that padding between known ones is kept too.
    known, columns = stimuli.electrodes != UNKNOWN, stimuli.electrodes.shape[1]
    lengths = np.zeros(len(stimuli), np.int64)
    for column in range(columns):
        lengths[known[:, column]] = column + 1
    kept = np.arange(columns)[None, :] < lengths[:, None]
    rests = f"; {NOTHING}: nothing was delivered" if np.any(stimuli.is_rest) else ""
    electrodes = VectorData(
        name="electrode_ids", description="electrodes on the array pulsed together", data=stimuli.electrodes[kept]
    )
    table = [
        VectorData(name="start_time", description="start of the pulse, s", data=stimuli.time_s),
        # NWB requires an end; the pulse's length is not stored, and readers treat an empty interval as a mistake.
        VectorData(name="stop_time", description="nominal: 1 us after start_time", data=stimuli.time_s + 1e-6),
        VectorData(name="frequency_hz", description="stimulus frequency; NaN: unknown", data=stimuli.frequency_hz),
        VectorData(name="pattern", description=f"stimulation pattern; -1: unknown{rests}", data=stimuli.pattern),
        VectorData(name="presentation", description="trial that the pulse belongs to", data=stimuli.presentation),
    ]
    if len(electrodes.data):
        # A column without values is valid, but other programs fail on it.
        index = VectorIndex(name="electrode_ids_index", data=np.cumsum(lengths).astype(np.int64), target=electrodes)
        table += [electrodes, index]
    return TimeIntervals(
        name="stimuli",
        description="Stimulation pulses, one row per pulse.",
        id=np.arange(len(stimuli)),
        columns=table,
    )


def _recording_table(recording: Recording) -> DynamicTable:
    presentation = recording.presentation
    cells: dict[str, tuple[object, str]] = {
        "format_version": (FORMAT_VERSION, "version of the tables written by animat"),
        "start_s": (float(recording.start_s), "start of the recording on its own clock, s"),
        "duration_s": (float(recording.duration_s), "from start_s, s"),
        "start_min": (float(recording.start_min), "start of the recording on the culture's clock, min"),
        "sampling_rate_hz": (float(recording.sampling_rate_hz), "of the raw signal, Hz; NaN: unknown"),
        "presentation_order": (presentation.order if presentation else "", "blocked or mixed; empty: unknown"),
        "presentation_pulses": (presentation.pulses if presentation else 0, "pulses per trial; 0: unknown"),
        "stimulus_electrode_columns": (recording.stimuli.electrodes.shape[1], "width of the padded electrode table"),
    }
    return DynamicTable(
        name="animat_recording",
        description="The scalars of the recording, one row.",
        id=np.arange(1),
        columns=[VectorData(name=n, description=text, data=[value]) for n, (value, text) in cells.items()],
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


def _split(text: str, mark: str) -> list[str]:
    return [word.strip() for word in text.split(mark) if word.strip()]
