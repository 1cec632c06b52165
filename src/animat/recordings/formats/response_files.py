"""Response tables in CSV and NPZ: a count or a rate per stimulus and channel (see docs/recordings.md)."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidFile, UnusableData, some_of
from animat.recordings.columns import Column, PlainColumns
from animat.recordings.findings import Finding, left_out_findings
from animat.recordings.formats.csv import SPIKE_COLUMNS, STIMULUS_COLUMNS, nearest, plain_column, text_stem
from animat.recordings.formats.npz import KEYS, load_columns
from animat.recordings.formats.text_table import TextTable, as_numbers, folded
from animat.recordings.recording import ResponseKind, ResponseTable

KINDS: tuple[ResponseKind, ...] = ("count", "rate_hz")
TABLE_COLUMNS = STIMULUS_COLUMNS | {"stimulus_pattern": (*STIMULUS_COLUMNS["stimulus_pattern"], "condition")}
NPZ_KEYS = {f"response_{kind}": kind for kind in KINDS}
_Read = tuple[Float64[np.ndarray, "stimuli channels"], ResponseKind, Column, Int64[np.ndarray, " lines"]]
"""Values, their kind, the channels, and for each line the first line of its stimulus."""
TRIAL = "trial"


def _is_response_table(table: TextTable) -> bool:
    """Whether text is a response table, by its header and the file's name."""
    names, stem = {folded(head) for head in table.header}, text_stem(table.path.name).lower()
    # Spike files may have columns of counts and rates too.
    if names & SPIKE_COLUMNS.keys() or stem.endswith("_spikes"):
        return False
    if stem.endswith("_responses") and not names & {"time", "time_s"}:
        # By its name it is a response table, even if columns are missing.
        return True
    is_long = "channel" in names and bool(names & set(KINDS))
    return is_long or any(name.startswith(f"{kind}_") for name in names for kind in KINDS)


def read_response_npz(path: Path) -> ResponseTable | None:
    """Read a response table from a numpy archive, None if it holds none; nothing in it is ever unpickled."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile, NotImplementedError):
        return None
    # If there are spikes too, they are more informative.
    if not any(f"{key}.npy" in names for key in NPZ_KEYS) or "spike_time_s.npy" in names:
        return None
    of_stimuli = (key for key in KEYS if not key.startswith("spike_"))
    arrays, _, left_out = load_columns(path, (*NPZ_KEYS, "response_window_ms", *of_stimuli))
    keys = [key for key in NPZ_KEYS if key in arrays]
    if len(keys) != 1:
        raise InvalidFile(f"{path}: expected one of {' or '.join(NPZ_KEYS)}, got {' and '.join(keys) or 'neither'}")
    key, values = keys[0], np.asarray(arrays.pop(keys[0]))
    if values.ndim != 2 or values.dtype.kind not in "iufb":
        raise UnusableData(f"{key}: expected numbers of shape (stimuli, channels), got {values.dtype} {values.shape}")
    n, n_channels = values.shape
    per_stimulus = {len(array) for name, array in arrays.items() if name.startswith("stimulus_") and np.ndim(array)}
    if per_stimulus == {n_channels} and n != n_channels:
        raise UnusableData(f"{key}: expected a row for each of {n_channels} stimuli, got {values.shape}: transpose it")
    window = arrays.pop("response_window_ms", None)
    if window is not None and (window.shape != (2,) or window.dtype.kind not in "iuf"):
        raise UnusableData(f"response_window_ms: expected start and end in ms, got {window.dtype} {window.shape}")
    window_ms = None if window is None else (float(window[0]), float(window[1]))
    columns = {"channel_label": np.arange(n_channels), **arrays}
    provenance = {"source": path.name, "format": "NPZ of responses"}
    return _to_table(values, NPZ_KEYS[key], columns, window_ms, provenance, left_out_findings("keys", left_out))


def read_response_table(table: TextTable) -> ResponseTable | None:
    """Make a response table from text, wide or long; None if it is something else."""
    if not _is_response_table(table):
        return None
    is_long = table.place(("channel",)) is not None
    as_written, table = table, _by_trial(table) if is_long else table
    values, kind, labels, first_of = _read_long(table) if is_long else _read_wide(table)
    columns: dict[str, Any] = {"channel_label": labels}
    for name, names in TABLE_COLUMNS.items():
        if (place := table.place(names)) is not None:
            columns[name] = _per_stimulus(table, place, name, first_of)
    start_ms, end_ms, start_min = (_constant(table, name) for name in ("window_start_ms", "window_end_ms", "start_min"))
    if (start_ms is None) != (end_ms is None):
        raise InvalidFile(f"{table.path}, line 1: expected window_start_ms and window_end_ms, or neither; got one")
    if start_min is not None:
        columns["start_min"] = start_min
    table.note_left_out([alias for name, names in TABLE_COLUMNS.items() if name not in columns for alias in names])
    window_ms = None if start_ms is None or end_ms is None else (start_ms, end_ms)
    provenance = {"source": table.path.name, "format": "CSV of responses"}
    in_order = "its rows are" if table is as_written else "its trials, sorted by their numbers, are"
    return _to_table(values, kind, columns, window_ms, provenance, tuple(table.findings), in_order)


def _read_wide(table: TextTable) -> _Read:
    """Read a table with one line per stimulus."""
    places = {kind: [i for i, h in enumerate(table.header) if folded(h).startswith(f"{kind}_")] for kind in KINDS}
    kinds = [kind for kind in KINDS if places[kind]]
    if len(kinds) != 1:
        expected = "expected a column count_CHANNEL or rate_hz_CHANNEL for each channel"
        raise InvalidFile(f"{table.path}, line 1: {expected}, got {'both' if kinds else 'neither'}")
    kind = kinds[0]
    labels = np.array([_label(table.header[i], kind) for i in places[kind]], dtype=np.str_)
    values = np.column_stack([table.numbers(i, table.header[i], required=True) for i in places[kind]])
    table.used.update(places[kind])
    # Mark the trial column as used, so that it is not reported as unknown.
    table.place((TRIAL,))
    return values, kind, labels, np.arange(len(table.rows))


def _label(head: str, kind: ResponseKind) -> str:
    """The part of a header after the kind, such as 12 in `Rate (Hz) 12`."""
    return next(head[i:].strip() for i in range(len(head) + 1) if folded(f"{head[:i]}x") == f"{kind}_x")


def _by_trial(table: TextTable) -> TextTable:
    """A long table without times in the order of its trials if they are numbered; notes numbers without a line."""
    place = table.place((TRIAL,))
    try:
        numbers = np.empty(0) if place is None else as_numbers(table.text(place))
    except ValueError:
        return table
    if not len(numbers) or not np.array_equal(numbers, np.floor(numbers)) or np.any(np.abs(numbers) >= 2**53):
        return table
    first, last, present = numbers.min(), numbers.max(), len(np.unique(numbers))
    # Where most are missing, the numbers do not count trials: times of day, or blocks and trials in one number.
    if 0 < (missing := int(last - first) + 1 - present) <= present:
        numbered = f"{missing:,} of the trials {first:.0f} to {last:.0f} have no line"
        remedy = "if these are trials without a spike, add a line with 0 for each"
        message = f"{numbered}, and are left out: {remedy}"
        table.findings.append(Finding("trials-missing", "warning", message, float(missing)))
    if table.place(TABLE_COLUMNS["stimulus_time_s"]) is not None:
        return table
    order = np.argsort(numbers, kind="stable").tolist()
    return replace(table, rows=[table.rows[row] for row in order], lines=[table.lines[row] for row in order])


def _read_long(table: TextTable) -> _Read:
    """Read a table with one line per stimulus and channel."""
    places = {kind: place for kind in KINDS if (place := table.place((kind,))) is not None}
    trial, channel = table.place((TRIAL, *TABLE_COLUMNS["stimulus_time_s"])), table.place(("channel",))
    if len(places) != 1 or trial is None or channel is None:
        near = nearest(table, (TRIAL, *TABLE_COLUMNS["stimulus_time_s"], "channel", *KINDS))
        expected = "trial (or stimulus_time_s), channel, and count or rate_hz"
        raise InvalidFile(f"{table.path}, line 1: expected {expected}, found {some_of(table.header, 12)}{near}")
    ((kind, place),) = places.items()
    numbers = table.numbers(place, kind, required=True)
    _, first, trial_of = np.unique(table.text(trial), return_index=True, return_inverse=True)
    first_of = first[trial_of]
    trials, row_of = np.unique(first_of, return_inverse=True)
    labels, column_of = np.unique(table.text(channel), return_inverse=True)
    cells = row_of * len(labels) + column_of
    distinct, counts = np.unique(cells, return_counts=True)
    if np.any(counts > 1):
        again = int(np.flatnonzero(cells == distinct[counts > 1][0])[1])
        raise table.wrong(again, "expected one line per stimulus and channel, got this one again")
    values = np.zeros(len(trials) * len(labels))
    values[cells] = numbers
    if missing := len(values) - len(distinct):
        message = f"{missing:,} of {len(values):,} pairs of a stimulus and a channel have no line and count as 0"
        table.findings.append(Finding("pairs-missing", "note", message, float(missing)))
    return values.reshape(len(trials), len(labels)), kind, labels, first_of


def _per_stimulus(table: TextTable, place: int, name: str, first_of: Int64[np.ndarray, " lines"]) -> Column:
    """The value for each stimulus of a column that must be the same in all of its lines."""
    column = plain_column(table, place, name)
    first = column[first_of]
    same = column == first
    if column.dtype.kind == "f":
        same |= np.isnan(column) & np.isnan(first)
    if not np.all(same):
        row = int(np.argwhere(~same)[0, 0])
        cells, line = table.text(place), table.lines[first_of[row]]
        expected = f"expected {cells[first_of[row]]!r} as in line {line}, of the same stimulus"
        raise table.wrong(row, f"{name}: {expected}, got {cells[row]!r}")
    return np.asarray(column[np.unique(first_of)])


def _constant(table: TextTable, name: str) -> float | None:
    """The single number of a column, None if there is no such column."""
    place = table.place((name,))
    if place is None or not table.rows:
        return None
    values = table.numbers(place, name, required=True)
    if np.any(values != values[0]):
        row = int(np.flatnonzero(values != values[0])[0])
        expected = f"the same in all lines, {values[0]:g} as in the first"
        raise table.wrong(row, f"{name}: expected {expected}, got {values[row]:g}")
    return float(values[0])


def _to_table(
    values: Column,
    kind: ResponseKind,
    columns: dict[str, Any],
    window_ms: tuple[float, float] | None,
    provenance: dict[str, str],
    findings: tuple[Finding, ...],
    in_order: str = "its rows are",
) -> ResponseTable:
    """The table, with stimuli and channels checked like plain columns; `in_order` is in order of presentation."""
    has_times = "stimulus_time_s" in columns
    times = np.asarray(columns.pop("stimulus_time_s", np.arange(len(values), dtype=np.float64)))
    plain = PlainColumns(np.empty(0), np.empty(0, np.int64), times, **columns)
    # Times in another shape are refused below.
    if times.ndim == 1 and len(values) != len(times):
        raise UnusableData(f"responses: expected a row for each of {len(times)} stimuli, got {len(values)}")
    if not has_times:
        order = f"the table has no stimulus times: {in_order} assumed to be in order of presentation"
        findings = (Finding("stimulus-times-unknown", "note", order), *findings)
    recording = plain.to_recording(provenance, findings)
    taken = ("channels", "stimuli", "start_min", "presentation", "provenance", "findings")
    return ResponseTable(
        values=np.asarray(values, dtype=np.float64)[np.argsort(times, kind="stable")],
        kind=kind,
        has_times=has_times,
        window_ms=window_ms,
        **{name: getattr(recording, name) for name in taken},
    )
