"""CSV: spikes in `NAME_spikes.csv[.gz]`, stimuli in `NAME_stimuli.csv[.gz]`, columns as in docs/recordings.md."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import InvalidArgument, InvalidFile, UnusableData, counted, did_you_mean, in_file, some_of
from animat.recordings.columns import REQUIRED, Column, PlainColumns
from animat.recordings.findings import Finding
from animat.recordings.formats.text_table import TextTable, as_numbers, folded, is_number, read_table, whole_numbers
from animat.recordings.recording import Recording
from animat.tables import padded

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
NAMES = ("spike_channel", "stimulus_pattern")
"""Columns that may be text."""


def read_csv(table: TextTable, stimuli_path: str | os.PathLike[str] | None = None) -> Recording:
    """Make a recording from a table of spikes and a file of stimuli.

    That is by default `NAME_stimuli.csv[.gz]` next to `NAME_spikes.csv` (or next to `NAME.csv`). If there is none, the
    recording has no stimuli, with a finding.
    """
    path = table.path
    if stimuli_path is None and text_stem(path.name).endswith("_stimuli"):
        raise InvalidFile(f"{path}: expected a spike file, got the stimuli that belong to one; name the spike file")
    stimuli = stimuli_beside(path) if stimuli_path is None else Path(stimuli_path)
    provenance = {"source": path.name, "format": "CSV"}
    columns, findings = _known_columns(table, SPIKE_COLUMNS), table.findings
    if not table.rows:
        raise InvalidFile(f"{path}: expected one line per spike, got only a header")
    if stimuli is None:
        columns["stimulus_time_s"] = np.empty(0)
        looked_for = " or ".join(file.name for file in _stimuli_beside(path))
        found = f"{counted(len(table.rows), 'spike')} but no stimuli, so there are no responses to learn from"
        message = f"{path.name} has {found}: {looked_for} was looked for; rename the stimulus file accordingly"
        findings = [*findings, Finding("no-stimuli", "refuse", message)]
    else:
        of_stimuli, found_there = read_stimuli_csv(stimuli)
        columns |= of_stimuli
        findings = [*findings, *found_there]
        provenance["stimuli"] = stimuli.name
    with in_stimulus_file(stimuli):
        return PlainColumns(**columns).to_recording(provenance, tuple(findings))


def read_stimuli_csv(path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """The stimulus columns of `PlainColumns` in a stimulus file, and findings, as on unknown columns."""
    table = read_table(path, "stimulus_time_s")
    return _known_columns(table, STIMULUS_COLUMNS), table.findings


@contextmanager
def in_stimulus_file(path: Path | None) -> Iterator[None]:
    """Name the stimulus file in errors on its columns, which become a recording together with another file's."""
    try:
        yield
    except (InvalidArgument, UnusableData) as error:
        if path is None or not str(error).startswith("stimulus_"):
            raise
        raise InvalidFile(f"{path}: {error}") from error


def stimuli_beside(path: Path) -> Path | None:
    """The stimulus file that belongs to a spike file, if there is one."""
    return next((file for file in _stimuli_beside(path) if file.exists()), None)


def _stimuli_beside(path: Path) -> list[Path]:
    name = text_stem(path.name).removesuffix("_spikes")
    # Its own suffix first, such as .tsv.
    suffixes = dict.fromkeys([path.name[len(text_stem(path.name)) :], ".csv", ".csv.gz"])
    return [path.with_name(f"{name}_stimuli{suffix}") for suffix in suffixes if suffix]


def text_stem(name: str) -> str:
    """A file's name without its ending, if that is one of text."""
    return re.sub(r"\.(csv|tsv|txt)(\.gz)?$", "", name, flags=re.IGNORECASE)


def _known_columns(table: TextTable, known: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    """The known columns of a table under our names."""
    places = {name: place for name, names in known.items() if (place := table.place(names)) is not None}
    for name, names in known.items():
        if name in REQUIRED and name not in places:
            # It may be a response table in which one of these is misspelt.
            others = ("channel", "count", "rate_hz") if name == "spike_time_s" else ()
            found = some_of([repr(head)[1:-1][:40] for head in table.header], 12)
            expected = f"expected a column named {' or '.join(names)}"
            advice = _advice(table, name) or nearest(table, (*names, *others))
            raise InvalidFile(f"{table.path}, line 1: {expected}, found {found}{advice}")
    heads = [head for head in table.header if folded(head) in known.get("spike_channel", ())]
    if len(heads) > 1:
        expected, got = " or ".join(known["spike_channel"]), " and ".join(heads)
        raise InvalidFile(f"{table.path}, line 1: expected one column of {expected}, got {got}: remove one")
    columns = {name: plain_column(table, place, name) for name, place in places.items()}
    table.note_left_out([alias for name, names in known.items() if name not in places for alias in names])
    return columns


def _advice(table: TextTable, missing: str) -> str:
    """What to do about a missing column, if the others show it."""
    heads = {folded(name) for name in table.header}
    if table.header[0].startswith("<"):
        return ": it is a web page, perhaps a server's error page instead of the file; download it again"
    if len(heads) == 1 and len(table.header[0].split()) > 1:
        return ": separate the columns by commas, semicolons or tabs"
    if table.header[0].startswith("sep="):
        return ": remove this first line"
    if any(is_number(name) for name in table.header):
        return ": add a line with the column names above"
    if missing == "spike_channel" and any(heads & set(names) for names in list(STIMULUS_COLUMNS.values())[1:]):
        return ": it looks like a stimulus file; are spikes and stimuli swapped?"
    other_unit = next((name for name in heads if name.endswith(("time_ms", "time_us", "sample", "frame"))), None)
    if missing != "spike_channel" and other_unit is not None:
        return f": convert the times in {other_unit} to seconds, and name them time_s"
    return ""


def nearest(table: TextTable, missing: Sequence[str]) -> str:
    """The end of a message on missing columns: the missing name that one of the table's columns is similar to."""
    heads = [folded(name) for name in table.header]
    return next(filter(None, (did_you_mean(head, missing) for head in heads if head not in missing)), "")


def plain_column(table: TextTable, place: int, name: str) -> Column:
    """One column of spikes or stimuli by its name in `PlainColumns`: numbers, or text if it may hold names."""
    if name == "stimulus_electrodes":
        return _electrodes(table, place)
    if name not in NAMES:
        numbers = table.numbers(place, name, required=name in REQUIRED)
        if name == "stimulus_frequency_hz" and np.any(numbers <= 0):
            row = int(np.flatnonzero(numbers <= 0)[0])
            raise table.wrong(row, f"{name}: expected positive frequencies in Hz, or nothing, got {numbers[row]:g}")
        if name == "stimulus_presentation" and np.any(wrong := numbers > np.floor(numbers)):
            row = int(np.argmax(wrong))
            raise table.wrong(row, f"{name}: expected whole numbers, got {numbers[row]:g}")
        return numbers
    cells = table.text(place)
    if name in REQUIRED and "" in cells:
        missing = "expected a channel for each spike"
        raise table.wrong(cells.index(""), f"{name}: {missing}, got {cells.count('')} without one, here the first")
    try:
        numbers = as_numbers(cells)
    except ValueError:
        return np.array(cells, dtype=np.str_)
    named = {cell for cell, number in zip(cells, numbers.tolist(), strict=True) if number == number}
    are_alike = len({*as_numbers([*named]).tolist()}) < len({re.sub(r"\.0*$", "", name.strip()) for name in named})
    if are_alike or (name == "spike_channel" and np.any(np.abs(numbers) >= 2**53)):
        # Names that look like numbers, such as 01 beside 1, inf, or serial numbers that floats do not represent.
        return np.array(cells, dtype=np.str_)
    if np.any(wrong := numbers > np.floor(numbers)):
        row = int(np.argmax(wrong))
        swapped = ": are the columns of times and channels swapped?" if name == "spike_channel" else ""
        raise table.wrong(row, f"{name}: expected whole numbers or names, got {cells[row]}{swapped}")
    return numbers


def _electrodes(table: TextTable, place: int) -> Column:
    lists: list[list[int]] = []
    for row, cell in enumerate(table.text(place)):
        try:
            lists.append(whole_numbers(cell))
        except (ValueError, OverflowError) as error:
            expected = "expected whole numbers separated by spaces, of at most 64 bits"
            raise table.wrong(row, f"stimulus_electrodes: {expected}, got {cell[:40]!r}") from error
    # Errors name the stimulus file, not the spike file that is being read.
    with in_file(table.path):
        return padded(lists)
