"""NWB from other programs, read with plain h5py: units as channels, and stimuli wherever they are.

    /units                  spike_times and its index; electrodes (rows of the electrodes table), if there are any
    /general/extracellular_ephys/electrodes      rel_x, rel_y or x, y; label, channel_name or electrode_name
    stimuli                 see `animat.recordings.formats.nwb_stimuli`

Every unit becomes a channel, including silent ones; a unit on several electrodes takes the position of its first.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from animat.errors import InvalidFile, UnusableData
from animat.recordings.columns import Column, PlainColumns, count_out_of_order, unsorted_finding
from animat.recordings.findings import Finding
from animat.recordings.formats.hdf5 import Hdf5File
from animat.recordings.formats.nwb_layout import SUBJECT
from animat.recordings.formats.nwb_stimuli import read_stimuli
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN

UNITS = "units"
ELECTRODES = "general/extracellular_ephys/electrodes"
POSITIONS = (("rel_x", "rel_y"), ("x", "y"))
UNIT_LABELS = ("unit_name", "label", "cluster_id")
ELECTRODE_LABELS = ("label", "channel_name", "electrode_name")
TEXTS = ("experiment_description", "session_description", "institution", "lab")


def read_foreign_nwb(file: Hdf5File, stimuli: str | None, spikes: bool = True) -> Recording:
    """Read a recording written by another program.

    Args:
        file: open.
        stimuli: the name of the stimuli, if the file has several candidates.
        spikes: whether to read units, which must exist; otherwise only channels and stimuli, for raw traces.

    Raises:
        InvalidFile: if the file holds no units, or several candidates for stimuli and none is chosen.
        UnusableData: if a column is invalid.
    """
    path, findings = file.path, list[Finding]()
    columns: dict[str, Any]
    if spikes:
        if not file.has(f"{UNITS}/spike_times"):
            raw = [n for n in file.names("acquisition") if file.has(f"acquisition/{n}/data")]
            raise InvalidFile(
                f"{path}: expected spikes in /{UNITS}, found none"
                + (
                    f": it holds traces ({', '.join(raw[:4])}); find spikes in them with animat convert --raw"
                    if raw
                    else " and no traces either"
                )
            )
        columns = _units(file, findings)
    else:
        columns = {"spike_time_s": np.empty(0), "spike_channel": np.empty(0, np.int64), **_electrodes(file)}
    columns |= read_stimuli(file, stimuli, findings)
    provenance = {"source": path.name, "format": "NWB of another program", **_origin(file)}
    if spikes:
        provenance["channels"] = "units"
    resolution = file.attribute(f"{UNITS}/spike_times", "resolution")
    if isinstance(resolution, float) and 1e-9 < resolution < 1:
        columns["sampling_rate_hz"] = 1 / resolution
    try:
        return PlainColumns(**columns).to_recording(provenance, tuple(findings))
    except UnusableData as error:
        # The file is not damaged; its contents are invalid.
        raise InvalidFile(f"{path}: {error}") from error


def ragged(file: Hdf5File, at: str, n_values: int) -> Column:
    """How many values each row of a ragged column has.

    Raises:
        InvalidFile: if the index does not divide the values.
    """
    ends = file.read(f"{at}_index").astype(np.int64).reshape(-1)
    counts = np.diff(ends, prepend=0)
    if np.any(counts < 0) or (int(ends[-1]) if len(ends) else 0) != n_values:
        raise InvalidFile(f"{file.path}: /{at}_index does not divide the {n_values:,} values of /{at}: damaged")
    return counts


def _units(file: Hdf5File, findings: list[Finding]) -> dict[str, Any]:
    time_s = file.read(f"{UNITS}/spike_times").reshape(-1)
    if file.has(f"{UNITS}/spike_times_index"):
        counts = ragged(file, f"{UNITS}/spike_times", len(time_s))
    else:
        counts = np.ones(len(time_s), np.int64)
    n = len(counts)
    names = next((f"{UNITS}/{name}" for name in (*UNIT_LABELS, "id") if file.has(f"{UNITS}/{name}")), None)
    labels = np.arange(n).astype(np.str_) if names is None else file.read(names).reshape(-1).astype(np.str_)
    if len(labels) != n or len(np.unique(labels)) != n:
        labels = np.arange(n).astype(np.str_)
    # Units follow each other; spikes count as out of order only within a unit.
    if early := sum(map(count_out_of_order, np.split(time_s, np.cumsum(counts)[:-1]))):
        findings.append(unsorted_finding("spikes", early, len(time_s)))
    order = np.argsort(time_s, kind="stable")
    columns: dict[str, Any] = {
        "spike_time_s": time_s[order],
        "spike_channel": np.repeat(labels, counts)[order],
        "channel_label": labels,
    }
    row = _electrode_of_unit(file, n)
    table = _electrodes(file)
    n_electrodes = len(table.get("channel_label", ()))
    if row is None or not n_electrodes:
        findings.append(
            Finding("units-without-electrodes", "note", "the units name no electrodes: positions are unknown")
        )
        return columns
    known = (row >= 0) & (row < n_electrodes)
    electrode, xy_um = np.full(n, UNKNOWN), np.full((n, 2), np.nan)
    electrode[known] = table["channel_electrode"][row[known]]
    xy_um[known] = table["channel_xy_um"][row[known]]
    return columns | {"channel_electrode": electrode, "channel_xy_um": xy_um}


def _electrode_of_unit(file: Hdf5File, n: int) -> Column | None:
    """The first row of the electrodes table that each unit refers to, -1 for none; None without such a column."""
    if not file.has(f"{UNITS}/electrodes"):
        return None
    rows = file.read(f"{UNITS}/electrodes").astype(np.int64).reshape(-1)
    if not file.has(f"{UNITS}/electrodes_index"):
        return rows if len(rows) == n else None
    counts = ragged(file, f"{UNITS}/electrodes", len(rows))
    if len(counts) != n:
        return None
    first = np.full(n, UNKNOWN)
    starts = np.cumsum(counts) - counts
    first[counts > 0] = rows[starts[counts > 0]]
    return first


def _electrodes(file: Hdf5File) -> dict[str, Any]:
    """The electrodes table as channel columns; empty if there is none."""
    if not file.has(f"{ELECTRODES}/id"):
        return {}
    number = file.read(f"{ELECTRODES}/id").astype(np.int64).reshape(-1)
    n = len(number)
    labels = number.astype(np.str_)
    for name in ELECTRODE_LABELS:
        if file.has(f"{ELECTRODES}/{name}"):
            names = file.read(f"{ELECTRODES}/{name}").reshape(-1).astype(np.str_)
            if len(names) == n == len(np.unique(names)):
                labels = names
                break
    xy_um = np.full((n, 2), np.nan)
    for pair in POSITIONS:
        if all(file.has(f"{ELECTRODES}/{axis}") for axis in pair):
            axes = [file.read(f"{ELECTRODES}/{axis}").astype(np.float64).reshape(-1) for axis in pair]
            if all(len(axis) == n for axis in axes):
                xy_um = np.column_stack(axes)
                break
    return {"channel_label": labels, "channel_electrode": np.maximum(number, UNKNOWN), "channel_xy_um": xy_um}


def _origin(file: Hdf5File) -> dict[str, str]:
    """Who recorded what, as far as the file states it."""
    texts: dict[str, Any] = {"recorded_at": _text(file, "session_start_time")}
    texts |= {name: _text(file, f"general/{name}") for name in TEXTS}
    texts["session_description"] = _text(file, "session_description") or texts["session_description"]
    texts |= {key: _text(file, f"general/subject/{name}") for name, key in SUBJECT.items()}
    if isinstance(node := file.node("general/experimenter"), h5py.Dataset) and node.size and node.size < 100:
        texts["experimenter"] = "; ".join(str(name) for name in file.read("general/experimenter").reshape(-1).tolist())
    return {key: text for key, text in texts.items() if isinstance(text, str) and text and "\0" not in text}


def _text(file: Hdf5File, at: str) -> str | None:
    node = file.node(at)
    if not isinstance(node, h5py.Dataset) or node.size != 1:
        return None
    value = file.first(at)
    return value if isinstance(value, str) and len(value) < 10_000 else None
