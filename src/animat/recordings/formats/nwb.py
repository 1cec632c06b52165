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
`experiment_description`, `experimenter` (`Last, First`, several separated by semicolons), `lab`, `institution`,
`keywords` (separated by commas), and for the subject `subject_id`, `species` (Latin), `sex`, `age` (ISO 8601 duration),
`subject_description`. So they travel with the recording and need no second argument.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidFile, UnusableData
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

T = TypeVar("T", int, float, str)


def write_nwb(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as one NWB file, complete or absent.

    Args:
        recording: what to write.
        path: the file; parent folders are made, an old file is replaced only by a complete new one.

    Raises:
        InvalidFile: if the file cannot be written (no permission, a full disk).
        InvalidArgument: for text that HDF5 cannot hold, or a `recorded_at` that is no date.
    """
    from pynwb import NWBHDF5IO

    from animat.recordings.formats.nwb_tables import nwb_file

    # The file is put together in memory: HDF5 does not recover from a disk that fills up under it, and a recording
    # is small (2 MB for 205,000 spikes).
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file, NWBHDF5IO(file=file, mode="w") as nwb_io:
        nwb_io.write(nwb_file(recording))
    with written_whole(path) as beside:
        beside.write_bytes(buffer.getbuffer())


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
    return str(error).strip().partition("\n")[0] or type(error).__name__
