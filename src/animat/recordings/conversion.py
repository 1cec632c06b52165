"""Converts any recording to animat's own NWB, with its origin, and detects spikes in raw traces on the way."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from animat.arguments import checked_arguments
from animat.errors import InvalidArgument, InvalidFile, in_file
from animat.progress import Progress
from animat.recordings.detection.settings import Detection
from animat.recordings.findings import Finding, merged
from animat.recordings.formats.hdf5_formats import open_traces
from animat.recordings.formats.nwb import write_nwb
from animat.recordings.formats.nwb_layout import expect_hdf5_text
from animat.recordings.formats.with_spikeinterface import open_with_spikeinterface
from animat.recordings.metadata import LIKE_A_DATE, culture_of, date_of
from animat.recordings.raw import RawTraces
from animat.recordings.reading import HDF5, TEXT_NAMES, ZIP, first_bytes, read_recording
from animat.recordings.recording import Recording
from animat.writing import clear_leftovers

_DATE, _TIME = ("".join(rf"(?:(\d+(?:\.\d+)?){unit})?" for unit in units) for units in ("YMWD", "HMS"))
DURATION = re.compile(rf"P(?=.){_DATE}(?:T(?=\d){_TIME})?", re.ASCII)
"""ISO 8601: P, years, months, weeks and days, and after a T hours, minutes and seconds; at least one of them."""
DAY_S = 86_400.0
UNITS_S = (365.25 * DAY_S, 365.25 / 12 * DAY_S, 7 * DAY_S, DAY_S, 3600.0, 60.0, 1.0)
"""The length of each of these, with mean years and months."""
PERSONS = re.compile(r"\s*[^,;]+,\s*[^,;]+(?:;\s*[^,;]+,\s*[^,;]+)*")
SPECIES = re.compile(r"[A-Z][a-z]*\.?( [a-z]+){1,2}|https?://\S+/NCBITaxon_\d+")
"""Genus, species and optionally subspecies, or an address in NCBI's taxonomy."""


@dataclass(frozen=True)
class Origin:
    """Who recorded what, in NWB's format; None keeps what the file states.

    Attributes:
        subject_id: name of the culture.
        species: in Latin, such as `Mus musculus`.
        sex: `U` for unknown, as for most cultures.
        age: ISO 8601 duration, such as `P42D`, or a range of two separated by a slash.
        subject_description: such as `dissociated cortical culture`.
        experimenter: `Last, First`; several separated by semicolons.
        institution, lab: where it was recorded.
        keywords: separated by commas.
        recorded_at: ISO 8601 date.
        experiment_description: what the experiment was for.

    Raises:
        InvalidArgument: for text that HDF5 cannot hold, a `species` that is not in Latin, an `age` that is not a
            duration, an `experimenter` without a comma, or a `recorded_at` that is not a date.
    """

    subject_id: str | None = None
    species: str | None = None
    sex: str | None = None
    age: str | None = None
    subject_description: str | None = None
    experimenter: str | None = None
    institution: str | None = None
    lab: str | None = None
    keywords: str | None = None
    recorded_at: str | None = None
    experiment_description: str | None = None

    def __post_init__(self) -> None:
        # Checked here rather than when the file is written, as spike detection takes minutes.
        for name, text in vars(self).items():
            expect_hdf5_text(name, text)
        checks: tuple[tuple[str, Callable[[str], object], str], ...] = (
            (
                "species",
                SPECIES.fullmatch,
                "the name in Latin, such as Mus musculus, or its address in NCBI's taxonomy",
            ),
            ("age", _lengths_s, "an ISO 8601 duration such as P42D (days), P6W or P3M"),
            ("experimenter", PERSONS.fullmatch, "Last, First, several separated by semicolons"),
            ("recorded_at", lambda text: date_of({"recorded_at": text}), LIKE_A_DATE),
        )
        for name, read, expected in checks:
            if (text := getattr(self, name)) is not None and not read(text):
                raise InvalidArgument(f"{name}: expected {expected}, got {text!r}")
        if self.age is not None and (lengths_s := _lengths_s(self.age)) != sorted(lengths_s):
            raise InvalidArgument(f"age: expected a range with the younger age first, got {self.age!r}")


@checked_arguments
def convert_recording(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    origin: Origin | None = None,
    *,
    detection: Detection | None = None,
    reader: str | None = None,
    stimuli_path: str | os.PathLike[str] | None = None,
    stimuli: str | None = None,
    part: str | None = None,
    start_min: float | None = None,
    start_s: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Read a recording in any format and write it as NWB; returns what was written.

    Args:
        path: of the recording.
        out: the NWB file, complete or absent.
        origin: who recorded what; None: as the file states.
        detection: detect spikes in raw traces with these settings; None: use the file's own spikes.
        reader: SpikeInterface's name of the format; spikes are then detected in its traces.
        stimuli_path, stimuli, part, start_min, start_s: as in `read_recording`.
        progress: of spike detection.

    Raises:
        InvalidFile: if the file cannot be read, or the new one cannot be written.
        InvalidArgument: for a choice that the format does not offer, or an `out` that exists or does not end in .nwb.
    """
    path, out = Path(path), Path(out)
    _expect_new(out)
    if out.suffix != ".nwb":
        raise InvalidArgument(f"--out: expected a name ending in .nwb, as NWB is written, got {out}")
    if reader is not None and (stimuli is not None or part is not None):
        raise InvalidArgument(f"stimuli, part: expected none for traces read with a reader, got {stimuli or part!r}")
    if (detection is not None or reader is not None) and start_s is not None:
        raise InvalidArgument(f"start_s: expected none for raw traces, which state their start, got {start_s:g}")
    if reader is None and detection is not None and stimuli_path is not None:
        raise InvalidArgument(f"stimuli_path: expected only with CSV or a reader; {path} holds its own stimuli")
    if reader is not None:
        traces, base = open_with_spikeinterface(path, reader, stimuli_path=stimuli_path)
        recording = _with_detected_spikes(traces, base, detection, progress)
    elif detection is not None:
        recording = read_traces(path, detection, part=part, stimuli=stimuli, progress=progress)
    else:
        recording = read_recording(path, stimuli_path=stimuli_path, stimuli=stimuli, part=part, start_s=start_s)
    given = {name: text for name, text in vars(origin or Origin()).items() if text is not None}
    # The sex of a subject is unknown unless stated.
    default = {"sex": "U"} if "subject_id" in given else {}
    start_min = recording.start_min if start_min is None else start_min
    provenance = {**default, **recording.provenance, **given}
    read: dict[str, Any] = {"culture": culture_of(provenance), "recorded_at": date_of(provenance)}
    findings = recording.findings
    date, is_noted = provenance.get("recorded_at"), any(finding.name == "zone-unknown" for finding in findings)
    if date and read["recorded_at"] and datetime.fromisoformat(date).tzinfo is None and not is_noted:
        message = f"recorded_at {date} has no time zone and is taken as UTC; add one, such as +09:00"
        findings += (Finding("zone-unknown", "note", message),)
    recording = replace(recording, provenance=provenance, start_min=float(start_min), findings=findings, **read)
    clear_leftovers(out.parent, glob.escape(out.name))
    # Another program may have written it in the meantime, or do so while it is written.
    _expect_new(out)
    # It may hold what NWB cannot.
    with in_file(path):
        write_nwb(recording, out, replaces=False)
    return recording


def _expect_new(out: Path) -> None:
    if out.exists() or out.is_symlink():
        # It may be the recording itself or its stimuli, and is someone's work in any case.
        raise InvalidArgument(f"--out: expected a new file, got {out}, which exists; choose another name")


def _lengths_s(age: str) -> list[float]:
    """The length of an ISO 8601 duration, or of the two of a range, whose end may be open; empty for other text."""
    lengths_s = []
    for part in age.removesuffix("/").split("/", 1):
        if (match := DURATION.fullmatch(part)) is None:
            return []
        lengths_s.append(sum(float(n or 0) * unit_s for n, unit_s in zip(match.groups(), UNITS_S, strict=True)))
    return lengths_s


def read_traces(
    path: str | os.PathLike[str],
    settings: Detection | None = None,
    *,
    part: str | None = None,
    stimuli: str | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Detect the spikes in a file's raw traces (MaxWell, CL1, NWB) and make a recording from them.

    Arguments and errors are those of `convert_recording`, whose `detection` the settings are.
    """
    path = Path(path)
    magic = first_bytes(path)
    if not magic.startswith(HDF5):
        kind = "another file"
        if magic.startswith(ZIP) or path.name.endswith(TEXT_NAMES):
            kind = f"{'NPZ' if magic.startswith(ZIP) else 'CSV'}, which holds spikes (leave out --raw to convert these)"
        remedy = "for traces in another format name it with --reader, such as intan"
        raise InvalidFile(f"{path}: expected HDF5 with raw traces (MaxWell, CL1, NWB), got {kind}; {remedy}")
    traces, base = open_traces(path, part=part, stimuli=stimuli)
    return _with_detected_spikes(traces, base, settings, progress)


def _with_detected_spikes(
    traces: RawTraces, base: Recording, settings: Detection | None, progress: Progress | None
) -> Recording:
    """The recording with spikes detected in its raw traces instead of its own, and the settings in its provenance."""
    from animat.recordings.detection.spikes import detect_spikes

    settings = settings or Detection()
    detected = detect_spikes(traces, base.stimuli.time_s, settings, progress=progress)
    band = "as recorded" if settings.band_hz is None else f"{settings.band_hz[0]:g}-{settings.band_hz[1]:g} Hz"
    blanked = f"blanked {settings.blank_ms[0]:g} ms before to {settings.blank_ms[1]:g} ms after stimuli"
    how = f"{band}, {settings.threshold:g} x median noise, dead time {settings.dead_time_ms:g} ms, {blanked}"
    n, stop_s = len(base.stimuli), traces.start_s + traces.samples / traces.sampling_rate_hz
    findings = [*base.findings, *detected.findings]
    if outside := n - np.count_nonzero((base.stimuli.time_s >= traces.start_s) & (base.stimuli.time_s < stop_s)):
        where = f"the traces, from {traces.start_s:g} to {stop_s:g} s: their responses are counted as empty"
        message = f"{outside:,} of {n:,} stimuli are outside {where}; remove them, or correct their times"
        findings.append(Finding("stimuli-outside", "warning", message, float(outside)))
    # Rounding may put a spike's sample an ulp outside the span.
    time_s = np.clip(detected.time_s, base.start_s, base.stop_s)
    spikes = {"spike_times_s": time_s, "spike_channels": detected.channel, "sampling_rate_hz": traces.sampling_rate_hz}
    return replace(base, **spikes, provenance={**base.provenance, "spikes": how}, findings=merged(findings))
