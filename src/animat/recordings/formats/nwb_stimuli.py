"""Finds the stimuli in NWB files from other programs; if there are several candidates, lists them to choose from."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import h5py
import numpy as np

from animat.errors import InvalidFile, some_of
from animat.recordings.columns import Column
from animat.recordings.findings import Finding, left_out_findings
from animat.recordings.formats.hdf5 import Hdf5File, choose, is_positive
from animat.recordings.formats.nwb_layout import ELECTRODES
from animat.recordings.formats.text_table import whole_numbers
from animat.tables import UNKNOWN, padded

FIRST = "stimulus/presentation"
ELSEWHERE = ("events", "intervals", "acquisition")
STIMULUS_NAME = re.compile(r"stim|pulse|trigger|ttl", re.IGNORECASE)
COLUMNS = {
    "stimulus_frequency_hz": ("frequency_hz", "frequency", "stimulus_frequency", "stim_frequency"),
    "stimulus_pattern": ("pattern", "stimulus_pattern", "stimulus_type", "stimulus_name", "condition", "label"),
    "stimulus_presentation": ("presentation",),
    "stimulus_electrodes": ("electrode_ids", "electrode_id", "electrodes", "electrode"),
}
NO_STIMULUS_COLUMNS = ("id", "start_time", "stop_time", "tags", "timeseries")
OF_EVENTS = ("duration", "annotation")
"""Columns that any table of intervals, and of events, may have."""
ONSET_NAME = re.compile(r"stim(ulus)?_?(on|onset|start)(_?times?)?", re.IGNORECASE)
"""A column of the times at which the stimuli of trials begin, which is later than the trials themselves."""
APART_S = 0.001
_BLOCK = 2**20


def read_stimuli(file: Hdf5File, asked: str | None, findings: list[Finding]) -> dict[str, Any]:
    """The stimulus columns of `PlainColumns`, with no times if the file has no stimuli; findings are added.

    The user may ask for stimuli by a path, or its last part, and must if there are several candidates.
    """
    at = _find_stimuli(file, asked, findings)
    if at is None:
        return {"stimulus_time_s": np.empty(0)}
    # The column of a table of events, or of intervals; a series has none.
    times = "timestamp" if file.has(f"{at}/timestamp") else None
    if times is None and file.has(f"{at}/start_time"):
        times = _onset_column(file, at) or "start_time"
    columns = {"stimulus_time_s": _from_series(file, at)} if times is None else _from_table(file, at, times, findings)
    n_rows, source = len(columns["stimulus_time_s"]), at
    if times not in (None, "start_time"):
        has_one = np.isfinite(columns["stimulus_time_s"])
        columns, source = {name: values[has_one] for name, values in columns.items()}, f"{at}/{times}"
    n = len(columns["stimulus_time_s"])
    without = f"; {n_rows - n:,} of {n_rows:,} rows have none" if n < n_rows else ""
    findings.append(Finding("stimuli-from", "note", f"{n:,} stimuli are taken from /{source}{without}", float(n)))
    return columns


def _find_stimuli(file: Hdf5File, asked: str | None, findings: list[Finding]) -> str | None:
    """Where the stimuli are: where asked, in /stimulus/presentation, or elsewhere under a name that mentions them."""
    first = [f"{FIRST}/{name}" for name in file.own_names(FIRST)]
    rooms = [*ELSEWHERE, *(f"processing/{module}" for module in file.own_names("processing"))]
    elsewhere = [f"{room}/{name}" for room in rooms for name in file.own_names(room)]
    # What holds series, such as BehavioralEvents.
    holders = [at for at in elsewhere if str(file.attribute(at, "neurodata_type")).startswith("Behavioral")]
    elsewhere += [f"{holder}/{name}" for holder in holders for name in file.own_names(holder)]
    first, elsewhere = ([at for at in places if _can_be_stimuli(file, at)] for places in (first, elsewhere))
    if asked is not None:
        every = [*first, *elsewhere]
        named = [at for at in every if asked.strip("/") in (at, at.rpartition("/")[2])]
        if not every:
            raise InvalidFile(f"{file.path}: stimuli: nothing in the file can be stimuli, got {asked}")
        if not named:
            choose(f"{file.path}: stimuli", "--stimuli", every, asked)
        return choose(f"{file.path}: stimuli named {asked}", "--stimuli", named, None)
    named = [at for at in elsewhere if STIMULUS_NAME.search(at.rpartition("/")[2])]
    candidates = first or named or [at for at in elsewhere if _onset_column(file, at) is not None]
    if not candidates:
        # What is linked from other files could be stimuli: it is refused.
        for at in [f"{room}/{name}" for room in (FIRST, "processing", *rooms) for name in file.names(room)]:
            file.node(at)
    # Regular samples and epochs are hardly ever stimuli.
    perhaps = [at for at in elsewhere if not (file.has(f"{at}/starting_time") or at.endswith("/epochs"))]
    if not candidates and perhaps:
        remedy = "choose it with --stimuli NAME (animat inspect, animat convert)"
        message = f"nothing in the file is named like stimuli; if one of {some_of(perhaps)} holds them, {remedy}"
        findings.append(Finding("stimuli-elsewhere", "note", message))
    return choose(f"{file.path}: stimuli", "--stimuli", candidates, None) if candidates else None


def _can_be_stimuli(file: Hdf5File, at: str) -> bool:
    if file.attribute(at, "neurodata_type") in ("ElectricalSeries", "LFP", "SpikeEventSeries"):
        return False
    return any(file.has(f"{at}/{name}") for name in ("start_time", "timestamp", "timestamps", "starting_time"))


def _onset_column(file: Hdf5File, at: str) -> str | None:
    """The name of the column with the times of the stimuli, if there is one, with times within their intervals."""
    named = [name for name in file.names(at) if ONSET_NAME.fullmatch(name)]
    columns = [f"{at}/{name}" for name in (*named, "start_time", "stop_time")]
    nodes = [file.node(column) for column in columns]
    if len(named) != 1 or not all(isinstance(node, h5py.Dataset) and node.dtype.kind == "f" for node in nodes):
        return None
    onset_s, start_s, stop_s = (file.read(column).reshape(-1) for column in columns)
    if not len(onset_s) == len(start_s) == len(stop_s):
        return None
    known = np.isfinite(onset_s)
    # Times that count from the trial's start, or are in ms, do not lie within their intervals.
    lies_within = (start_s <= onset_s) & (onset_s <= stop_s)
    return named[0] if np.any(known) and np.all(lies_within[known]) else None


def _from_table(file: Hdf5File, at: str, times: str, findings: list[Finding]) -> dict[str, Any]:
    """The columns of a table of intervals or events, with the times of the stimuli in the column `times`."""
    time_s = file.read(f"{at}/{times}").reshape(-1)
    columns: dict[str, Any] = {"stimulus_time_s": time_s}
    used = {*NO_STIMULUS_COLUMNS, times, *(OF_EVENTS if times == "timestamp" else ())}
    for column, names in COLUMNS.items():
        for name in names:
            if (values := _values(file, f"{at}/{name}", column, time_s)) is not None:
                columns[column] = values
                used.add(name)
                break
    missing = [name for column, names in COLUMNS.items() if column not in columns for name in names]
    present = file.names(at)
    # The index of a ragged column is part of it.
    used |= {f"{name}_index" for name in present}
    findings += left_out_findings("columns", [n for n in present if n not in used], f"/{at}", missing)
    return columns


def _values(file: Hdf5File, at: str, column: str, time_s: Column) -> Column | None:
    """The values of a column with a known name, as another program means them; None if they cannot be what it says."""
    if column == "stimulus_electrodes":
        electrodes = _electrodes(file, at, len(time_s))
        return None if electrodes is None else np.maximum(electrodes, UNKNOWN)
    node = file.node(at)
    if not isinstance(node, h5py.Dataset) or node.shape != time_s.shape or node.dtype.kind not in "iufbSO":
        return None
    values = file.read(at)
    if column == "stimulus_frequency_hz":
        return np.where(values > 0, values, np.nan) if values.dtype.kind in "iuf" else None
    is_whole = _are_whole(values)
    if column == "stimulus_pattern":
        # Conditions need not be numbered: fractions (a contrast), true and false are names.
        return values if is_whole else np.array(["" if value != value else str(value) for value in values])
    if not is_whole:
        return None
    # As floats, since differences of unsigned numbers never fall.
    number = np.nan_to_num(values.astype(np.float64), nan=UNKNOWN)[np.argsort(time_s, kind="stable")]
    # Numbers that start again, as in each block, do not number the trials of a recording.
    return None if np.any(np.diff(number[number != UNKNOWN]) < 0) else values


def _are_whole(values: Column) -> bool:
    """Whether values are whole numbers that fit, or not known (NaN)."""
    if values.dtype.kind in "iu":
        return not values.size or int(values.max()) < 2**63
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else np.array([np.inf])
    return bool(np.all((known == np.round(known)) & (np.abs(known) < 2**53)))


def _electrodes(file: Hdf5File, at: str, n: int) -> Column | None:
    """The electrodes of each of n rows, from whole numbers or text ("7 9"); None if they are neither."""
    if not isinstance(file.node(at), h5py.Dataset):
        return None
    dataset = file.dataset(at)
    if dataset.dtype.kind in "SO" and dataset.shape == (n,):
        try:
            return padded([whole_numbers(cell.replace(",", " ")) for cell in file.read(at).tolist()])
        except (ValueError, OverflowError):
            return None
    if dataset.dtype.kind not in "iu":
        return None
    values = file.read(at).astype(np.int64)
    if file.attribute(at, "neurodata_type") == "DynamicTableRegion":
        # Rows of the electrodes table, or of another table, whose electrodes are not known.
        table, to = file.node(ELECTRODES), dataset.attrs.get("table")
        if not isinstance(to, h5py.Reference) or not to or table is None or file.file[to] != table:
            return None
        numbers = file.read(f"{ELECTRODES}/id").astype(np.int64).reshape(-1)
        if np.any((values < 0) | (values >= len(numbers))):
            return None
        values = numbers[values]
    if file.has(f"{at}_index"):
        ends = [0, *file.read(f"{at}_index").astype(np.int64).reshape(-1).tolist()]
        # Stimuli are not refused for an index that does not fit: their electrodes are then unknown.
        if len(ends) != n + 1 or sorted(ends) != ends or ends[-1] > len(values) or values.size != len(values):
            return None
        flat = values.reshape(-1).tolist()
        return padded([flat[start:end] for start, end in pairwise(ends)])
    return values if values.shape[:1] == (n,) and values.ndim <= 2 else None


def _from_series(file: Hdf5File, at: str) -> Column:
    """The time of each pulse of a series: each entry that is not 0 (all if all are 0), or each onset if sampled."""
    if file.has(f"{at}/timestamps"):
        time_s = file.read(f"{at}/timestamps").reshape(-1)
        node, kind = file.node(f"{at}/data"), file.attribute(at, "neurodata_type")
        # In an IndexSeries, 0 is the first of the things that are presented.
        of_times = isinstance(node, h5py.Dataset) and node.ndim <= 2 and node.shape[:1] == time_s.shape
        if not of_times or kind == "IndexSeries":
            return time_s
        data = file.read(f"{at}/data")
        if data.dtype.kind == "U":
            return time_s
        # Of snippets around pulses, too.
        step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
        # Sampled, though it states no rate.
        if kind != "IntervalSeries" and 0 < step_s < APART_S:
            return np.asarray(time_s[_onsets(file, f"{at}/data", 1 / step_s, time_s).astype(np.int64)])
        # Where a digital input is recorded, a negative number is the end of a pulse.
        has_ends = kind == "IntervalSeries" or (data.dtype.kind == "i" and not at.startswith(FIRST))
        is_pulse = data > 0 if has_ends and np.any(data > 0) else _from_zero(file, f"{at}/data", data) != 0
        # In several columns, where any is not 0.
        is_pulse = is_pulse.any(axis=1) if is_pulse.ndim > 1 else is_pulse
        return np.asarray(time_s[is_pulse] if np.any(is_pulse) else time_s)
    rate_hz, start_s = file.attribute(f"{at}/starting_time", "rate"), file.first(f"{at}/starting_time")
    if not is_positive(rate_hz) or not isinstance(start_s, int | float):
        raise InvalidFile(f"{file.path}: expected the rate of /{at} in Hz at its starting_time, got {rate_hz}")
    return np.asarray(start_s + _onsets(file, f"{at}/data", float(rate_hz)) / rate_hz)


def _onsets(file: Hdf5File, at: str, rate_hz: float, time_s: Column | None = None) -> Column:
    """The samples at which a stimulus leaves 0, for the first time in 1 ms; without times all are equally far apart.

    If most samples are exactly 0, away from it is more than a hundredth of its largest magnitude: a converter from
    analog to digital is off by a step or two now and then. Otherwise there is more noise, and it is more than half.
    Samples are read in blocks, as they may be as many as the recording's.
    """
    dataset = file.dataset(at)
    is_column = dataset.ndim in (1, 2) and dataset.size == len(dataset)
    if not is_column or dataset.dtype.kind not in "iufb" or dataset.size > 8 * (file.path.stat().st_size + 10**6):
        raise InvalidFile(f"{file.path}: expected one column of numbers at /{at}, got {dataset.dtype} {dataset.shape}")
    blocks = range(0, len(dataset), _BLOCK)

    def magnitude(b: int) -> Column:
        # Samples that are not known (NaN) are no stimulus.
        return np.asarray(np.abs(np.nan_to_num(_from_zero(file, at, dataset[b : b + _BLOCK].reshape(-1)))))

    largest, n_zeros = 0.0, 0
    for b in blocks:
        block = magnitude(b)
        largest, n_zeros = max(largest, float(np.max(block))), n_zeros + int(np.count_nonzero(block == 0))
    if not largest > 0:
        return np.empty(0)
    least = largest / (100 if n_zeros > len(dataset) / 2 else 2)
    samples = np.concatenate([np.flatnonzero(magnitude(b) > least) + b for b in blocks])
    apart = np.diff(samples) if time_s is None else np.rint(np.diff(time_s[samples]) * rate_hz)
    return np.asarray(samples[np.append(True, apart > max(1, APART_S * rate_hz))])


def _from_zero(file: Hdf5File, at: str, data: Column) -> Column:
    """Samples as they are stored, less the one that stands for 0: NWB's values are data x conversion + offset."""
    offset, conversion = (file.attribute(at, name) for name in ("offset", "conversion"))
    if not isinstance(offset, float) or not isinstance(conversion, float) or not conversion or not offset:
        return data.astype(np.float64)
    zero = -offset / conversion
    # Offset and conversion are rounded.
    return np.where(np.isclose(data, zero, rtol=1e-6, atol=0), 0.0, data - zero)
