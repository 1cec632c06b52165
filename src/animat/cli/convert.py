"""The command that converts any recording to NWB."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from animat.cli.command import Command
from animat.errors import InvalidArgument, InvalidFile
from animat.writing import expect_writable

DETECTION_OPTIONS = ("band_hz", "threshold", "dead_time_ms", "blank_ms")


@dataclass(frozen=True)
class Convert(Command):
    """Write a recording of any rig as NWB, with its metadata; optionally find the spikes in raw traces."""

    recording: Positional[Path]
    """The recording: NWB, MaxWell, CL1, NPZ, CSV; with --reader any format that SpikeInterface reads"""
    out: Path
    """The NWB file to write"""
    subject_id: str | None = None
    """The culture's identifier"""
    species: str | None = None
    """Latin name, such as "Mus musculus\""""
    sex: Literal["M", "F", "U", "O"] | None = None
    """Of the subject; default: U, unknown"""
    age: str | None = None
    """ISO 8601 duration, such as P42D"""
    subject_description: str | None = None
    """Such as "dissociated cortical culture\""""
    experimenter: str | None = None
    """"Last, First"; several separated by semicolons"""
    institution: str | None = None
    """Institution of the recording"""
    lab: str | None = None
    """Laboratory of the recording"""
    keywords: str | None = None
    """Separated by commas"""
    recorded_at: str | None = None
    """ISO 8601 date, such as 2024-05-31T14:00:00+09:00"""
    experiment_description: str | None = None
    """Description of the experiment"""
    start_min: float | None = None
    """Start on the culture's clock, in minutes"""
    start_s: float | None = None
    """Start of the recording on the clock of its time stamps, in seconds, if the file does not state it"""
    stimuli: str | None = None
    """Which of several series or events in the file are the stimuli (NWB: the name; MaxWell: the events' type)"""
    stimuli_path: Path | None = None
    """File of stimuli that belong to CSV spikes or traces"""
    part: str | None = None
    """Which of several recordings in the file, such as well000/rec0000"""
    raw: bool = False
    """Find the spikes in the raw traces, instead of using those that the rig found"""
    reader: str | None = None
    """Find the spikes in traces of another format, by its name in SpikeInterface, such as intan; needs animat[raw]"""
    band_hz: tuple[float, float] = (100.0, 3000.0)
    """Pass band of the filter for finding spikes; 0 0: the traces are already filtered"""
    threshold: float = 5.0
    """Depth of a spike, in standard deviations of its channel's noise"""
    dead_time_ms: float = 1.0
    """Of two negative peaks within this time, the deeper one is the spike"""
    blank_ms: tuple[float, float] = (0.5, 1.5)
    """Time before and after each stimulus in which no spikes are sought"""

    def run(self) -> dict[str, Any]:
        from animat.progress import Bar
        from animat.recordings.conversion import Origin, convert_recording
        from animat.recordings.detection.settings import Detection
        from animat.recordings.quality import recording_findings

        if self.recording.is_dir() and self.reader is None:
            raise InvalidFile(
                f"{self.recording}: expected one recording, got a folder; convert its files one by one, or name the "
                "format with --reader where the folder is one recording"
            )
        finds_spikes = self.raw or self.reader is not None
        changed = [name for name in DETECTION_OPTIONS if getattr(self, name) != getattr(Convert, name)]
        if changed and not finds_spikes:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in changed)
            raise InvalidArgument(
                f"{options}: expected only where spikes are found in raw traces; add --raw or --reader, or leave it out"
            )
        expect_writable(self.out.parent)
        detection = Detection(
            band_hz=None if self.band_hz == (0, 0) else self.band_hz,
            threshold=self.threshold,
            dead_time_ms=self.dead_time_ms,
            blank_ms=self.blank_ms,
            recovery_ms=max(20.0, self.blank_ms[1]),
        )
        origin = Origin(**{field.name: getattr(self, field.name) for field in fields(Origin)})
        reading = ("reader", "stimuli_path", "stimuli", "part", "start_min", "start_s")
        with Bar("converting") as progress:
            recording = convert_recording(
                self.recording,
                self.out,
                origin,
                detection=detection if finds_spikes else None,
                progress=progress,
                **{name: getattr(self, name) for name in reading},
            )
        counts = len(recording.spike_times_s), len(recording.channels), len(recording.stimuli)
        n = dict(zip(("spikes", "channels", "stimuli"), counts, strict=True))
        print(f"{self.out}: {n['spikes']:,} spikes on {n['channels']:,} channels, {n['stimuli']:,} stimuli")
        findings = recording_findings(recording)
        for finding in findings:
            print(f"  {finding.severity}: {finding.message}")
        return {"recording": str(self.out), **n, "findings": [finding.name for finding in findings]}
