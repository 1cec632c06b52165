"""NWB from other programs, read with plain h5py: units as channels, and stimuli wherever they are."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from animat.errors import InvalidFile, some_of
from animat.recordings.columns import Column, PlainColumns, count_out_of_order, duration_between, unsorted_finding
from animat.recordings.findings import Finding
from animat.recordings.formats.hdf5 import Hdf5File
from animat.recordings.formats.nwb_layout import ELECTRODES, SUBJECT, UNITS
from animat.recordings.formats.nwb_stimuli import read_stimuli
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN

POSITIONS = (("rel_x", "rel_y"), ("x", "y"))
UNIT_LABELS = ("unit_name", "label", "cluster_id", "id")
ELECTRODE_LABELS = ("label", "channel_name", "electrode_name", "id")
TEXTS = ("experiment_description", "session_description", "institution", "lab")


def read_foreign_nwb(file: Hdf5File, stimuli: str | None, *, spikes: bool = True) -> Recording:
    """Read an open file of another program; every unit becomes a channel, at its first electrode's position.

    Units must exist; for raw traces, only channels and stimuli are read.
    """
    findings: list[Finding] = []
    units = _units_table(file) if spikes else UNITS
    if spikes:
        columns = _units(file, units, findings)
    else:
        channels = _electrodes(file) or {"channel_label": np.empty(0, np.str_)}
        columns = {"spike_time_s": np.empty(0), "spike_channel": np.empty(0, np.int64), **channels}
    columns |= read_stimuli(file, stimuli, findings)
    columns |= _observed(file, units, columns["spike_time_s"], columns["stimulus_time_s"])
    provenance = {"source": file.path.name, "format": "NWB of another program", **_origin(file)}
    if spikes:
        provenance["channels"] = "units"
    resolution = file.attribute(f"{units}/spike_times", "resolution")
    if isinstance(resolution, float) and 1e-9 < resolution < 1:
        columns["sampling_rate_hz"] = 1 / resolution
    return PlainColumns(**columns).to_recording(provenance, tuple(findings))


def _units_table(file: Hdf5File) -> str:
    """Where the units are: in /units, or else in the only table with spike times in a processing module."""
    if file.has(f"{UNITS}/spike_times"):
        return UNITS
    modules = [f"processing/{name}" for name in file.own_names("processing")]
    tables = [f"{module}/{name}" for module in modules for name in file.own_names(module)]
    found = [table for table in tables if file.has(f"{table}/spike_times")]
    if len(found) == 1:
        return found[0]
    what = "none and no traces either"
    if found:
        what = f"several tables of units: {some_of(found, 4)}; link the one to use as /{UNITS}"
    elif raw := [name for name in file.own_names("acquisition") if file.has(f"acquisition/{name}/data")]:
        what = f"none: it holds traces ({some_of(raw, 4)}); find spikes in them with animat convert --raw"
    raise InvalidFile(f"{file.path}: expected spikes in /{UNITS} or in a processing module, found {what}")


def _units(file: Hdf5File, at: str, findings: list[Finding]) -> dict[str, Any]:
    """The spikes, and the units as channel columns."""
    time_s = file.read(f"{at}/spike_times").reshape(-1)
    counts = _row_lengths(file, f"{at}/spike_times", len(time_s))
    n = len(counts)
    labels = _labels(file, at, UNIT_LABELS, n)
    # Units follow each other; spikes count as out of order only within a unit.
    if early := sum(map(count_out_of_order, np.split(time_s, np.cumsum(counts)[:-1]))):
        findings.append(unsorted_finding("spikes", early, len(time_s)))
    order = np.argsort(time_s, kind="stable")
    columns: dict[str, Any] = {"spike_time_s": time_s[order], "channel_label": labels}
    columns["spike_channel"] = np.repeat(labels, counts)[order]
    row, table = _electrode_of_unit(file, at, n), _electrodes(file)
    n_electrodes = len(table.get("channel_label", ()))
    if row is None or not n_electrodes:
        message = "the units name no electrodes: positions are unknown"
        findings.append(Finding("units-without-electrodes", "note", message))
        return columns
    known = (row >= 0) & (row < n_electrodes)
    electrode, xy_um = np.full(n, UNKNOWN), np.full((n, 2), np.nan)
    electrode[known] = table["channel_electrode"][row[known]]
    xy_um[known] = table["channel_xy_um"][row[known]]
    return columns | {"channel_electrode": electrode, "channel_xy_um": xy_um}


def _observed(file: Hdf5File, units: str, spike_s: Column, stimulus_s: Column) -> dict[str, float]:
    """When the recording starts and how long it is, if intervals in which units were observed cover all spikes."""
    at = f"{units}/obs_intervals"
    edge_s = file.read(at).astype(np.float64) if file.has(at) else np.empty(0)
    edge_s = edge_s[np.isfinite(edge_s)]
    if not len(edge_s) or not len(spike_s) or np.any(spike_s.clip(edge_s.min(), edge_s.max()) != spike_s):
        return {}
    every_s = np.concatenate([edge_s, stimulus_s])
    start_s = float(every_s.min())
    return {"start_s": start_s, "duration_s": duration_between(start_s, float(every_s.max()))}


def _electrode_of_unit(file: Hdf5File, units: str, n: int) -> Column | None:
    """The first row of the electrodes table that each unit refers to, -1 for none; None without such a column."""
    at = f"{units}/electrodes"
    if not file.has(at):
        return None
    rows = file.read(at).astype(np.int64).reshape(-1)
    counts = _row_lengths(file, at, len(rows))
    if len(counts) != n:
        return None
    first = np.full(n, UNKNOWN)
    starts = np.cumsum(counts) - counts
    first[counts > 0] = rows[starts[counts > 0]]
    return first


def _electrodes(file: Hdf5File) -> dict[str, Any]:
    """The electrodes table as channel columns; empty if there is none."""
    at = ELECTRODES
    if not file.has(f"{at}/id"):
        return {}
    number = file.read(f"{at}/id").astype(np.int64).reshape(-1)
    n = len(number)
    xy_um = np.full((n, 2), np.nan)
    for pair in POSITIONS:
        if all(file.has(f"{at}/{axis}") for axis in pair):
            axes = [file.read(f"{at}/{axis}").astype(np.float64).reshape(-1) for axis in pair]
            if all(len(axis) == n for axis in axes):
                xy_um = np.column_stack(axes)
                break
    labels = _labels(file, at, ELECTRODE_LABELS, n)
    return {"channel_label": labels, "channel_electrode": np.maximum(number, UNKNOWN), "channel_xy_um": xy_um}


def _row_lengths(file: Hdf5File, at: str, n_values: int) -> Column:
    return file.row_lengths(at, n_values) if file.has(f"{at}_index") else np.ones(n_values, np.int64)


def _labels(file: Hdf5File, at: str, columns: tuple[str, ...], n: int) -> Column:
    """The first of a table's columns that names each of its n rows differently; without one, rows are numbered."""
    for column in columns:
        if file.has(f"{at}/{column}"):
            labels = file.read(f"{at}/{column}").reshape(-1).astype(np.str_)
            if len(labels) == n == len(np.unique(labels)):
                return labels
    return np.arange(n).astype(np.str_)


def _origin(file: Hdf5File) -> dict[str, str]:
    """Who recorded what, as far as the file states it."""
    # All times in the file count from the reference.
    began = _text(file, "timestamps_reference_time") or _text(file, "session_start_time")
    texts: dict[str, Any] = {"recorded_at": began}
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
