"""CSV: spikes in `NAME_spikes.csv[.gz]`, stimuli beside them in `NAME_stimuli.csv[.gz]`.

Both have a header line and columns separated by commas, semicolons or tabs; a stimulus file may also be one bare
column of times. Column names are those of `animat.recordings.columns.PlainColumns`, or short ones:

    spikes     spike_time_s, time_s or time (seconds); spike_channel, channel or unit (a number or a name)
    stimuli    stimulus_time_s, time_s or time (seconds); and, if known, stimulus_frequency_hz or frequency_hz,
               stimulus_pattern or pattern, stimulus_presentation or presentation,
               stimulus_electrodes or electrodes (several separated by spaces)

Other columns are left out, which is noted. There is no table of channels: those that fired are the channels.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import InvalidFile
from animat.recordings.columns import Column, PlainColumns
from animat.recordings.findings import Finding
from animat.recordings.recording import UNKNOWN, Recording

SPIKE_COLUMNS = {
    "spike_time_s": ("spike_time_s", "time_s", "time"),
    "spike_channel": ("spike_channel", "channel", "unit"),
}
STIMULUS_COLUMNS = {
    "stimulus_time_s": ("stimulus_time_s", "stim_time_s", "time_s", "time"),
    "stimulus_frequency_hz": ("stimulus_frequency_hz", "stim_frequency_hz", "frequency_hz"),
    "stimulus_pattern": ("stimulus_pattern", "stim_pattern", "pattern"),
    "stimulus_presentation": ("stimulus_presentation", "stim_presentation", "presentation"),
    "stimulus_electrodes": ("stimulus_electrodes", "stim_electrodes", "electrodes"),
}
MOST_ELECTRODES = 50_000_000
REQUIRED = ("spike_time_s", "spike_channel", "stimulus_time_s")
UNPACKED_BYTES, UNPACKED_RATIO = 2**22, 20
SUFFIXES = (".csv", ".csv.gz")


def read_csv(path: str | os.PathLike[str], *, stimuli_path: str | os.PathLike[str] | None = None) -> Recording:
    """Read a recording from a file of spikes and the file of stimuli beside it.

    Args:
        path: the spikes.
        stimuli_path: the stimuli; by default `NAME_stimuli.csv` or `NAME_stimuli.csv.gz` beside `NAME_spikes.csv`
            (or beside `NAME.csv`). Where there is none, the recording has no stimuli.

    Raises:
        InvalidFile: if a file is missing, damaged or lacks a required column.
        UnusableData: if a column is not what it should be.
    """
    path = Path(path)
    if stimuli_path is None:
        if _stem(path).endswith("_stimuli"):
            raise InvalidFile(f"{path}: expected a file of spikes, got the stimuli beside it; name the file of spikes")
        stimuli = stimuli_beside(path)
    else:
        stimuli = Path(stimuli_path)
    provenance = {"source": path.name, "format": "CSV"}
    columns, findings = _table(path, SPIKE_COLUMNS)
    if stimuli is None:
        columns["stimulus_time_s"] = np.empty(0)
    else:
        stimulus_columns, stimulus_findings = _table(stimuli, STIMULUS_COLUMNS)
        columns |= stimulus_columns
        findings += stimulus_findings
        provenance["stimuli"] = stimuli.name
    return PlainColumns(**columns).to_recording(provenance, tuple(findings))


def read_stimuli_csv(path: Path) -> dict[str, Any]:
    """The stimulus columns of `PlainColumns` in a file of stimuli, whatever else is not known left out.

    Raises:
        InvalidFile: if the file is missing, damaged or lacks the times.
    """
    return _table(path, STIMULUS_COLUMNS)[0]


def stimuli_beside(path: Path) -> Path | None:
    """The file of stimuli that belongs to a file of spikes, if there is one."""
    name = _stem(path).removesuffix("_spikes")
    found = [path.with_name(f"{name}_stimuli{suffix}") for suffix in SUFFIXES]
    return next((file for file in found if file.exists()), None)


def _stem(path: Path) -> str:
    return path.name.removesuffix(".gz").removesuffix(".csv")


def _table(path: Path, known: Mapping[str, tuple[str, ...]]) -> tuple[dict[str, Any], list[Finding]]:
    """The known columns of a file under our names, and what was left out."""
    text = _text(path)
    first_line = text[: text.find("\n")] if "\n" in text else text
    rows = csv.reader(io.StringIO(text), delimiter=max(",;\t", key=first_line.count))
    try:
        lines = [row for row in rows if row]
    except csv.Error as error:
        raise InvalidFile(f"{path}: expected CSV (text in columns), got something else ({error})") from error
    if not lines:
        raise InvalidFile(f"{path}: expected a header line and a line an event, got an empty file")
    header = [name.strip() for name in lines[0]]
    if len(header) == 1 and _is_number(header[0]) and "stimulus_time_s" in known:
        header = ["stimulus_time_s"]
    else:
        del lines[0]
    place = {}
    for name, names in known.items():
        found = [header.index(n) for n in names if n in header]
        if found:
            place[name] = found[0]
        elif name in REQUIRED:
            found_names = ", ".join(repr(h)[1:-1][:40] for h in header[:12]) + (", ..." if len(header) > 12 else "")
            raise InvalidFile(f"{path}: expected a column named {' or '.join(names)}, found {found_names}")
    left_out = [name for i, name in enumerate(header) if i not in place.values()]
    findings = []
    if left_out:
        sentence = f"columns of {path.name} that are not known were left out: {', '.join(left_out)}"
        findings.append(Finding("columns-left-out", "note", sentence, float(len(left_out))))
    try:
        cells = {name: [line[i] for line in lines] for name, i in place.items()}
    except IndexError as error:
        short, line = next((n, line) for n, line in enumerate(lines, 1) if len(line) < len(header))
        raise InvalidFile(
            f"{path}: expected {len(header)} columns in each line, got {len(line)} in data line {short}; "
            "is the file cut off?"
        ) from error
    return {name: _column(path, name, column) for name, column in cells.items()}, findings


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = _unpacked(path, content)
        return content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InvalidFile(f"{path}: no such file") from error
    except UnicodeDecodeError as error:
        raise InvalidFile(f"{path}: expected CSV (text in UTF-8), got something else ({error.reason})") from error
    except (OSError, EOFError, zlib.error) as error:
        raise InvalidFile(
            f"{path}: expected a whole file, but it cannot be read or is cut off ({error}); copy it again"
        ) from error


def _unpacked(path: Path, content: bytes) -> bytes:
    """What is in a gzipped file, unless it is far more than text of that size packs."""
    limit = UNPACKED_BYTES + UNPACKED_RATIO * len(content)
    with gzip.open(io.BytesIO(content)) as packed:
        unpacked = packed.read(limit + 1)
    if len(unpacked) > limit:
        raise InvalidFile(f"{path}: unpacks to more than {limit:,} bytes, more than text of its size: it is damaged")
    return unpacked


def _column(path: Path, name: str, cells: list[str]) -> Column:
    """One column of text as numbers, or as text where it may be names."""
    if name == "stimulus_electrodes":
        return _electrodes(path, cells)
    try:
        return np.array([cell or "nan" for cell in cells], dtype=np.str_).astype(np.float64)
    except ValueError as error:
        if name in ("spike_channel", "stimulus_pattern"):
            return np.array(cells, dtype=np.str_)
        line, cell = next((n, cell) for n, cell in enumerate(cells, 1) if cell and not _is_number(cell))
        raise InvalidFile(f"{path}: {name}: expected a number in data line {line}, got {cell!r}") from error


def _electrodes(path: Path, cells: list[str]) -> Column:
    try:
        lists = [[int(electrode) for electrode in cell.split()] for cell in cells]
    except (ValueError, OverflowError) as error:
        raise InvalidFile(
            f"{path}: stimulus_electrodes: expected whole numbers separated by spaces ({error})"
        ) from error
    width = max([1, *map(len, lists)])
    if width * len(lists) > MOST_ELECTRODES or any(abs(e) >= 2**53 for electrodes in lists for e in electrodes):
        raise InvalidFile(f"{path}: stimulus_electrodes: expected a few electrodes a stimulus, got {width} in one line")
    table = np.full((len(lists), width), UNKNOWN)
    for row, electrodes in zip(table, lists, strict=True):
        row[: len(electrodes)] = electrodes
    return table


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
