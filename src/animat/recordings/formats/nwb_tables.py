"""Makes the NWB tables of a recording as pynwb objects, as whole columns. Imports pynwb (1-2 s): import it late."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime
from typing import Any

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
from animat.recordings.formats.nwb_layout import FORMAT_VERSION, SUBJECT, expect_hdf5_text
from animat.recordings.metadata import LIKE_A_DATE, date_of, to_metadata
from animat.recordings.recorded_culture import UNKNOWN_SUBJECT_ID
from animat.recordings.recording import Channels, Recording
from animat.stimulation.stimulus import NOTHING, Stimuli
from animat.tables import UNKNOWN

UNKNOWN_DATE = datetime(1970, 1, 1, tzinfo=UTC)
"""NWB requires a date; a recording without `recorded_at` gets this one, which readers recognise as unknown."""

UNKNOWN_SUBJECT = {
    "subject_id": UNKNOWN_SUBJECT_ID,
    "sex": "U",
    "age": "P0D/",
    "description": "neuronal culture; nothing else is known",
}
"""Sex U is unknown, and an age from 0 days on without an upper limit is any age."""
_FILE_KEYS = ("experiment_description", "lab", "institution")


def nwb_file(recording: Recording, spike_counts: Int64[np.ndarray, " channels"]) -> NWBFile:
    """A recording as a pynwb object tree, with room for so many spikes of each channel, which the caller writes."""
    texts = to_metadata(recording)
    for text in (*texts, *texts.values()):
        expect_hdf5_text("provenance", text)
    date = date_of(texts) if "recorded_at" in texts else UNKNOWN_DATE
    if date is None:
        got = texts["recorded_at"]
        raise InvalidArgument(f"provenance['recorded_at']: expected {LIKE_A_DATE}, got {got!r}")
    nwb = NWBFile(
        session_description=texts.get(
            "session_description", "Spikes of a neuronal culture on a multi-electrode array, under stimulation."
        ),
        identifier=str(uuid.uuid4()),
        session_start_time=date,
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
        columns = [_column("key", "keyword", list(texts)), _column("words", "text", list(texts.values()))]
        description = "Where the recording came from, and findings made when it was read."
        module.add(_table(DynamicTable, "animat_provenance", description, columns))
    return nwb


def _table(kind: type[DynamicTable], name: str, description: str, columns: list[VectorData]) -> DynamicTable:
    return kind(name=name, description=description, id=np.arange(len(columns[0].data)), columns=columns)


def _column(name: str, description: str, data: Any) -> VectorData:
    return VectorData(name=name, description=description, data=data)


def _index(column: VectorData, ends: Int64[np.ndarray, " rows"]) -> VectorIndex:
    """Where the values of each row of a ragged column end."""
    return VectorIndex(name=f"{column.name}_index", data=ends.astype(np.int64), target=column)


def _add_electrodes(nwb: NWBFile, channels: Channels) -> None:
    """The electrodes table, one row per channel."""
    device = nwb.create_device(name="array", description="multi-electrode array")
    group = nwb.create_electrode_group(
        name="array", description="the recording electrodes", location="in vitro", device=device
    )
    rows = len(channels)
    labels = [expect_hdf5_text("channels.label", label) for label in channels.label]
    nwb.electrodes = ElectrodesTable(
        id=np.arange(rows),
        columns=[
            _column("location", "where the electrode is", ["in vitro"] * rows),
            _column("group", "the array", [group] * rows),
            _column("group_name", "the array", ["array"] * rows),
            _column("rel_x", "x on the array, um; NaN: unknown", channels.x_um),
            _column("rel_y", "y on the array, um; NaN: unknown", channels.y_um),
            _column("label", "the rig's own name of the channel", labels),
            _column("electrode_id", "electrode on the array; -1: unknown", channels.electrode),
        ],
    )


def _add_units(nwb: NWBFile, recording: Recording, spike_counts: Int64[np.ndarray, " channels"]) -> None:
    """The units table, one row per channel, so that silent channels are kept."""
    rows = len(recording.channels)
    room = H5DataIO(shape=(int(spike_counts.sum()),), dtype=np.dtype(np.float64))
    times = _column("spike_times", "spike times, s", room)
    span_s = np.tile([recording.start_s, recording.stop_s], (rows, 1))
    observed = _column("obs_intervals", "from the start to the end of the recording, s", span_s)
    electrodes = DynamicTableRegion(
        name="electrodes", description="row in the electrodes table", data=np.arange(rows), table=nwb.electrodes
    )
    one_each = np.arange(1, rows + 1)
    columns: list[VectorData] = []
    for column, ends in ((times, np.cumsum(spike_counts)), (observed, one_each), (electrodes, one_each)):
        columns += [column, _index(column, ends)]
    nwb.units = Units(
        name="units",
        description="All spikes of each recording channel (multi-unit activity, or sorted units; see provenance).",
        id=np.arange(rows),
        columns=columns,
        electrode_table=nwb.electrodes,
    )
    if np.isfinite(recording.sampling_rate_hz):
        nwb.units.resolution = 1.0 / recording.sampling_rate_hz


def _stimulus_table(stimuli: Stimuli) -> DynamicTable:
    """One row per pulse, with its electrodes up to the last known one, so that padding between known ones is kept."""
    known = stimuli.electrodes != UNKNOWN
    columns = np.arange(known.shape[1])
    lengths = np.max((columns + 1) * known, axis=1, initial=0)
    rests = f"; {NOTHING}: nothing was delivered" if np.any(stimuli.is_rest) else ""
    table = [
        _column("start_time", "start of the pulse, s", stimuli.time_s),
        # NWB requires an end; the pulse's length is not stored, and readers treat an empty interval as a mistake.
        _column("stop_time", "nominal: 1 us after start_time", stimuli.time_s + 1e-6),
        _column("frequency_hz", "stimulus frequency; NaN: unknown", stimuli.frequency_hz),
        _column("pattern", f"stimulation pattern; -1: unknown{rests}", stimuli.pattern),
        _column("presentation", "trial that the pulse belongs to", stimuli.presentation),
    ]
    kept = stimuli.electrodes[columns < lengths[:, None]]
    if len(kept):
        # A column without values is valid, but other programs fail on it.
        electrodes = _column("electrode_ids", "electrodes on the array pulsed together", kept)
        table += [electrodes, _index(electrodes, np.cumsum(lengths))]
    return _table(TimeIntervals, "stimuli", "Stimulation pulses, one row per pulse.", table)


def _recording_table(recording: Recording) -> DynamicTable:
    presentation = recording.presentation
    cells = [
        ("format_version", "version of the tables written by animat", FORMAT_VERSION),
        ("start_s", "start of the recording on its own clock, s", float(recording.start_s)),
        ("duration_s", "from start_s, s", float(recording.duration_s)),
        ("start_min", "start of the recording on the culture's clock, min", float(recording.start_min)),
        ("sampling_rate_hz", "of the raw signal, Hz; NaN: unknown", float(recording.sampling_rate_hz)),
        ("presentation_order", "blocked or mixed; empty: unknown", presentation.order if presentation else ""),
        ("presentation_pulses", "pulses per trial; 0: unknown", presentation.pulses if presentation else 0),
        ("stimulus_electrode_columns", "width of the padded electrode table", recording.stimuli.electrodes.shape[1]),
    ]
    columns = [_column(name, description, [value]) for name, description, value in cells]
    return _table(DynamicTable, "animat_recording", "The scalars of the recording, one row.", columns)


def _split(text: str, mark: str) -> list[str]:
    return [word.strip() for word in text.split(mark) if word.strip()]
