"""NPZ: one numpy archive of plain columns, the simplest way to provide a recording; keys as in docs/recordings.md."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import InvalidFile, UnusableData, did_you_mean, first_line, some_of
from animat.recordings.columns import REQUIRED, Column, PlainColumns
from animat.recordings.findings import left_out_findings
from animat.recordings.metadata import from_metadata
from animat.recordings.recording import Recording
from animat.records import json_data, read_record
from animat.tables import UNKNOWN

KEYS = tuple(field.name for field in fields(PlainColumns))
UNPACKED_BYTES, UNPACKED_RATIO = 2**26, 20
SINGLE = ("sampling_rate_hz", "start_min", "start_s", "duration_s", "presentation_pulses", "presentation_order")
OTHER_NAMES = {
    "stim_tag": "stimulus_pattern",
    "spike_unit": "spike_channel",
    **{key.replace("stimulus_", "stim_"): key for key in KEYS if key.startswith("stimulus_")},
    **{key.replace("channel_", "unit_"): key for key in KEYS if key.startswith("channel_")},
}
SPREADSHEET = "[Content_Types].xml"
"""Present in the zip archives of spreadsheets."""
ROUTING = ("mapping_electrode", "mapping_xy_um")
UNDER_WAY = ".under-way.npz"
"""The recording in progress, in the folder of the others; hidden, so that no reader takes it for one of them."""
METADATA = "animat_metadata"
"""What else a recording in progress states, as JSON."""


def read_npz(path: Path) -> Recording:
    """Read a recording from a numpy archive of plain columns; nothing in it is ever unpickled."""
    columns, keys, left_out = load_columns(path, (*KEYS, *ROUTING, METADATA))
    if missing := [key for key in REQUIRED if key not in columns]:
        if any(key.startswith("state_") for key in keys):
            raise InvalidFile(f"{path}: expected a recording, got the state of a virtual culture")
        counts = [key for key in left_out if "spike" in key]
        if counts and "spike_time_s" in missing and "stimulus_time_s" in missing:
            expected = "times of spikes and of stimuli (spike_time_s, spike_channel, stimulus_time_s)"
            remedy = "provide the times, or counts per stimulus and channel as a response table (response_count)"
            raise InvalidFile(f"{path}: expected {expected}, found only counts ({', '.join(counts[:4])}); {remedy}")
        near = next(filter(None, (did_you_mean(key, missing) for key in left_out)), "")
        found = f"missing {', '.join(missing)}; found {some_of([*columns, *left_out], 12) or 'none'}{near}"
        raise InvalidFile(f"{path}: expected the keys {', '.join(REQUIRED)}; {found}")
    provenance = {"source": path.name, "format": "NPZ"}
    if "spike_unit" in keys:
        provenance["channels"] = "sorted units"
    metadata = columns.pop(METADATA, None)
    routing = [columns.pop(key) for key in ROUTING if key in columns]
    if "channel_xy_um" in columns and "channel_electrode" not in columns and len(routing) == len(ROUTING):
        columns["channel_electrode"] = _electrodes_at(columns["channel_xy_um"], *routing)
        provenance["channel_electrode"] = "by position, from mapping_electrode and mapping_xy_um"
    findings = left_out_findings("keys", left_out, missing=[key for key in KEYS if key not in columns])
    recording = PlainColumns(**columns).to_recording(provenance, findings)
    if metadata is None:
        return recording
    texts = read_record(dict[str, str], json_data(str(metadata), METADATA), METADATA)
    return replace(recording, **from_metadata(texts))


def load_columns(path: Path, known: tuple[str, ...]) -> tuple[dict[str, Any], list[str], list[str]]:
    """The known columns of an archive under our names, all of its keys, and those that were left out."""
    columns: dict[str, Any] = {}
    left_out = []
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            _check_size(path, archive.zip)
            if SPREADSHEET in archive.zip.namelist():
                raise InvalidFile(f"{path}: expected NPZ, got a spreadsheet; save its tables as CSV")
            keys = archive.files
            for key in keys:
                name = OTHER_NAMES.get(key, key)
                if name in columns:
                    raise InvalidFile(f"{path}: expected {name} once, got it under two names (one is {key})")
                if name in known:
                    array = _array(archive, key)
                    columns[name] = _single(f"{path}: {key}", name, array) if name in SINGLE else array
                else:
                    left_out.append(key)
    except ValueError as error:
        # Any other ValueError of numpy is about a damaged header.
        pickled = "Object arrays" in str(error)
        what = "pickled objects, which are never read" if pickled else f"a damaged array ({first_line(error)})"
        raise InvalidFile(f"{path}: expected plain arrays of numbers or text, got {what}; save it again") from error
    except (OSError, EOFError, KeyError, MemoryError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        what = f"it is cut off or damaged ({first_line(error)}); copy or save it again"
        raise InvalidFile(f"{path}: expected a complete NPZ archive, but {what}") from error
    return columns, keys, left_out


def _check_size(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse a file that unpacks to far more than a recording of its size."""
    # Spikes compress to about a fifth.
    limit = UNPACKED_BYTES + UNPACKED_RATIO * path.stat().st_size
    unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > limit:
        raise InvalidFile(f"{path}: unpacks to {unpacked:,} bytes, too many for its size ({limit:,}): it is damaged")


def _array(archive: Mapping[str, Column], key: str) -> Column:
    array = archive[key]
    if array.size and not array.dtype.itemsize:
        raise ValueError(f"{key} claims {array.size:,} values of no size")
    return np.char.decode(array, "utf-8", "replace") if array.dtype.kind == "S" else array


def _single(what: str, name: str, array: Column) -> str | float:
    """The single value of an array, a number or text."""
    if array.size != 1:
        raise InvalidFile(f"{what}: expected one value, got shape {array.shape}")
    value: str | float = array.item()
    is_text, is_whole = name == "presentation_order", name == "presentation_pulses"
    if isinstance(value, str) != is_text or not isinstance(value, str | int | float):
        raise InvalidFile(f"{what}: expected {'text' if is_text else 'a number'}, got {value!r}")
    if is_whole and not float(value).is_integer():
        raise InvalidFile(f"{what}: expected a whole number, got {value!r}")
    return int(value) if is_whole else value


def _electrodes_at(xy_um: Column, electrode: Column, electrode_xy_um: Column) -> Column:
    """The electrode routed at each position, `UNKNOWN` if there is none."""
    n = len(electrode) if electrode.ndim == 1 else -1
    if electrode_xy_um.shape != (n, 2):
        shapes = f"{electrode.shape} and {electrode_xy_um.shape}"
        expected = "expected shapes (electrodes,) and (electrodes, 2)"
        raise UnusableData(f"mapping_electrode, mapping_xy_um: {expected}, got {shapes}")
    if xy_um.ndim != 2:
        raise UnusableData(f"channel_xy_um: expected shape (channels, 2) in micrometres, got {xy_um.shape}")
    at = {tuple(xy): e for xy, e in zip(electrode_xy_um.tolist(), electrode.tolist(), strict=True)}
    return np.array([at.get(tuple(xy), UNKNOWN) for xy in xy_um.tolist()])
