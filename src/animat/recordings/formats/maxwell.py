"""Reads spikes, stimuli and electrodes of MaxWell MaxOne and MaxTwo files, new and old layout. Raw traces: `traces`.

    new    wells/wellNNN/recNNNN (also as recordings/recNNNN/wellNNN or data_store/dataNNNN), with
             settings/mapping(channel, electrode, x, y), settings/sampling, settings/lsb
             spikes(frameno, channel, amplitude)
             events(frameno, eventtype, eventid, eventmessage)                        stimuli
             groups/NAME/{raw, channels, frame_nos}; start_time, stop_time (ms since 1970)
    old    (version 20160704) mapping, settings/lsb, proc0/spikeTimes(frameno, channel, amplitude), sig,
             bits(frameno, bits)                                                      stimuli

Frames count from the start of the system: the first of `frame_nos` (old: from the last two rows of `sig`) is time 0. A
channel can occur twice in `mapping`; the recorded channels are in `groups/NAME/channels`. `spikes` and `events` are
plain tables: they are read without the vendor's compression filter, which the raw traces may need.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import InvalidFile
from animat.recordings.columns import Column, PlainColumns, recorded_span
from animat.recordings.findings import Finding
from animat.recordings.formats.hdf5 import Hdf5File, choose, hdf5_file, unavailable_filters
from animat.recordings.formats.stimulus_text import stimulus_columns
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN

OLD_VERSION = 20160704
USUAL_RATE_HZ = 20_000.0
ROOTS = ("wells", "recordings", "data_store")
OLD_CHANNELS = 1024
"""Rows of `sig` that are channels; its last two rows hold the frame number, low half first."""


def is_maxwell(file: Hdf5File) -> bool:
    """Whether a file has MaxWell's layout."""
    return is_old(file) or any(file.names(root) for root in ROOTS)


def is_old(file: Hdf5File) -> bool:
    """Whether a file is in the layout of version 20160704."""
    return "channel" in file.fields("mapping") and (file.has("sig") or file.has("proc0/spikeTimes"))


def read_maxwell(
    path: str | os.PathLike[str], *, part: str | None = None, stimuli: str | None = None, spikes: bool = True
) -> Recording:
    """Read spikes, stimuli and electrodes of one recording of a MaxWell file.

    Args:
        part: which recording, such as `well000/rec0000`, if the file has several.
        stimuli: the type of the events that are stimuli, as a number, if there are several types.
        spikes: whether to read spikes, which must exist; otherwise only channels and stimuli, for raw traces.

    Raises:
        InvalidFile: if the file is missing, damaged, lacks spikes, or holds several recordings and none is chosen.
        UnusableData: if a column is invalid.
    """
    path = Path(path)
    with hdf5_file(path, "MaxWell recording") as file:
        contents = _old(file) if is_old(file) else _new(file, part)
        contents.read(file, stimuli, spikes)
    return contents.recording(path)


def parts(file: Hdf5File) -> dict[str, str]:
    """The path of each recording in a file of the new layout, by its name."""
    for root in ROOTS:
        outer = file.names(root)
        if root == "data_store" and outer:
            return {name: f"{root}/{name}" for name in outer}
        recordings = {f"{a}/{b}": f"{root}/{a}/{b}" for a in outer for b in file.names(f"{root}/{a}")}
        if recordings:
            return recordings
    return {}


@dataclass
class _Contents:
    """The paths of data in one layout, and the data read from there."""

    spikes_at: str
    events_at: str
    event_kind: str
    mapping_at: str
    rate_hz: float
    first_frame: int | None
    frames: int | None = None
    recorded_channels: Column | None = None
    provenance: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    columns: dict[str, Any] = field(default_factory=dict)

    def read(self, file: Hdf5File, stimuli: str | None, spikes: bool) -> None:
        """Fill `columns`."""
        if spikes and not file.has(self.spikes_at):
            raise InvalidFile(
                f"{file.path}: expected spikes at /{self.spikes_at}, found none: the rig kept raw traces only, or "
                "nothing; detect spikes in them with animat convert --raw"
            )
        spike_frame = file.read(self.spikes_at, "frameno") if spikes else np.empty(0, np.int64)
        spike_channel = file.read(self.spikes_at, "channel") if spikes else np.empty(0, np.int64)
        event_frame, event_columns = self._events(file, stimuli)
        if self.first_frame is None:
            frames = [int(np.min(f)) for f in (spike_frame, event_frame) if len(f)]
            self.first_frame = min(frames, default=0)
            message = (
                "the number of the first frame is not in the file: the clock starts at the first spike or stimulus"
            )
            self._note("clock-from-first-event", message, "note")
        labels, electrode, xy_um = self._channels(file, spike_channel)
        routed = np.isin(spike_channel, labels)
        if not np.all(routed):
            lost = int(np.count_nonzero(~routed))
            message = f"{lost:,} of {len(routed):,} spikes are on channels without a routed electrode and are left out"
            self._note("spikes-not-routed", message, "note" if lost < 0.01 * len(routed) else "warning", float(lost))
        self.columns |= {
            "spike_time_s": self._seconds(spike_frame[routed]),
            "spike_channel": spike_channel[routed],
            "stimulus_time_s": self._seconds(event_frame),
            "channel_label": labels,
            "channel_electrode": electrode,
            "channel_xy_um": xy_um,
            "sampling_rate_hz": self.rate_hz,
            **event_columns,
        }
        if self.frames is not None:
            times_s = self.columns["spike_time_s"], self.columns["stimulus_time_s"]
            self.columns |= recorded_span(self.frames, self.rate_hz, *times_s)

    def recording(self, path: Path) -> Recording:
        """The recording made from the data."""
        provenance = {"source": path.name, "format": "MaxWell", **self.provenance}
        return PlainColumns(**self.columns).to_recording(provenance, tuple(self.findings))

    def _events(self, file: Hdf5File, stimuli: str | None) -> tuple[Column, dict[str, Any]]:
        if not file.has(self.events_at):
            return np.empty(0, np.int64), {}
        frame = file.read(self.events_at, "frameno")
        if self.event_kind == "bits":
            bits = file.read(self.events_at, "bits").astype(np.int64)
            rises = (bits != 0) & (bits != np.concatenate([[0], bits[:-1]]))
            chosen = frame[rises]
            if n_falls := int(np.count_nonzero(~rises)):
                message = f"{n_falls:,} of {len(bits):,} entries of /bits end a pulse and are not stimuli"
                self._note("bits-not-rising", message, "note", float(n_falls))
            columns = {"stimulus_pattern": bits[rises]} if len(np.unique(bits[rises])) > 1 else {}
            return chosen, columns
        names = file.fields(self.events_at)
        is_stimulus = np.ones(len(frame), dtype=bool)
        if "eventtype" in names and len(frame):
            types = file.read(self.events_at, "eventtype")
            counts = {str(t): int(np.count_nonzero(types == t)) for t in np.unique(types)}
            which = choose(
                f"{file.path}: stimuli", "--stimuli", counts, stimuli, lambda name: f"{name} ({counts[name]:,} events)"
            )
            is_stimulus = types.astype(np.str_) == which
            if len(counts) > 1:
                left = int(np.count_nonzero(~is_stimulus))
                message = f"{left:,} events of other types than {which} are left out"
                self._note("events-left-out", message, "note", float(left))
        columns = {}
        if "eventmessage" in names:
            columns = stimulus_columns(file.read(self.events_at, "eventmessage")[is_stimulus].tolist())
        if "eventid" in names and "stimulus_pattern" not in columns:
            identity = file.read(self.events_at, "eventid")[is_stimulus].astype(np.int64)
            if len(np.unique(identity)) > 1 and np.all(identity >= 0):
                columns["stimulus_pattern"] = identity
                self.provenance["stimulus_pattern"] = "the events' eventid"
        return frame[is_stimulus], columns

    def _channels(self, file: Hdf5File, spike_channel: Column) -> tuple[Column, Column, Column]:
        """Label, electrode and position of every channel that was recorded."""
        if not file.has(self.mapping_at):
            labels = np.unique(spike_channel if self.recorded_channels is None else self.recorded_channels)
            severity = "warning" if self.recorded_channels is None else "note"
            message = (
                f"the file has no /{self.mapping_at}: the electrodes of channels are not known; {len(labels):,} "
                "channels are " + ("those that fired" if self.recorded_channels is None else "taken from its groups")
            )
            self._note("mapping-missing", message, severity)
            return labels, np.full(len(labels), UNKNOWN), np.full((len(labels), 2), np.nan)
        channel = file.read(self.mapping_at, "channel").astype(np.int64)
        electrode = file.read(self.mapping_at, "electrode").astype(np.int64)
        xy_um = np.column_stack([file.read(self.mapping_at, axis).astype(np.float64) for axis in ("x", "y")])
        used = (channel >= 0) & (electrode >= 0)
        if self.recorded_channels is not None:
            used &= np.isin(channel, self.recorded_channels)
        labels, first = np.unique(channel[used], return_index=True)
        if repeated := int(np.count_nonzero(used)) - len(labels):
            rows = np.unique(np.column_stack([channel[used], electrode[used]]), axis=0)
            twice = len(rows) - len(labels)
            message = f"the file's mapping repeats {repeated:,} channels; each counts once" + (
                f", and where it lists another electrode ({twice:,} times) the first one is used" if twice else ""
            )
            self._note("duplicate-channels", message, "note", float(repeated))
        if self.recorded_channels is not None:
            unmapped = np.setdiff1d(self.recorded_channels, labels)
            if len(unmapped):
                message = f"{len(unmapped):,} recorded channels have no electrode in the mapping and are left out"
                self._note("channels-not-routed", message, "note", float(len(unmapped)))
        return labels, electrode[used][first], xy_um[used][first]

    def _seconds(self, frame: Column) -> Column:
        return np.asarray((frame.astype(np.int64) - int(self.first_frame or 0)) / self.rate_hz)

    def _note(self, name: str, message: str, severity: Any, value: float | None = None) -> None:
        self.findings.append(Finding(name, severity, message, value))


def _new(file: Hdf5File, part: str | None) -> _Contents:
    recordings = parts(file)
    if not recordings:
        raise InvalidFile(f"{file.path}: expected a MaxWell recording in one of {', '.join(ROOTS)}, found none")
    name = choose(f"{file.path}: part", "--part", recordings, part)
    at = recordings[name]
    findings = []
    rate = file.first(f"{at}/settings/sampling")
    if not isinstance(rate, int | float) or not rate > 0:
        findings.append(
            Finding("sampling-missing", "warning", "the sampling rate is not in the file: assumed to be 20 kHz")
        )
        rate = USUAL_RATE_HZ
    groups = file.names(f"{at}/groups")
    recorded = [file.read(f"{at}/groups/{g}/channels") for g in groups if file.has(f"{at}/groups/{g}/channels")]
    ends = [e for g in groups if (e := file.ends(f"{at}/groups/{g}/frame_nos")) is not None]
    contents = _Contents(
        f"{at}/spikes",
        f"{at}/events",
        "events",
        f"{at}/settings/mapping",
        float(rate),
        first_frame=min((e[0] for e in ends), default=None),
        frames=max((e[1] - min(x[0] for x in ends) + 1 for e in ends), default=None),
        recorded_channels=np.unique(np.concatenate(recorded).astype(np.int64)) if recorded else None,
        findings=findings,
    )
    lost = max((e[1] - e[0] + 1 - e[2] for e in ends), default=0)
    if lost > 0:
        contents.findings.append(
            Finding(
                "frames-lost",
                "warning" if lost > 0.001 * max(e[2] for e in ends) else "note",
                f"{lost:,} frames ({lost / float(rate):.3g} s) are missing from the recording",
                float(lost),
            )
        )
    if contents.frames is not None and contents.frames <= 0:
        contents.frames = None
    if len(recordings) > 1:
        contents.provenance["part"] = name
    started = file.first(f"{at}/start_time")
    if isinstance(started, int | float) and 0 < started < 4e12:
        date = datetime.fromtimestamp(started / 1e3, UTC)
        contents.provenance["recorded_at"] = date.isoformat(timespec="milliseconds")
    return contents


def _old(file: Hdf5File) -> _Contents:
    contents = _Contents("proc0/spikeTimes", "bits", "bits", "mapping", USUAL_RATE_HZ, first_frame=None)
    sig = file.node("sig")
    if sig is not None and len(getattr(sig, "shape", ())) == 2 and sig.shape[0] > OLD_CHANNELS and sig.shape[1]:
        dataset = file.dataset("sig")
        if not unavailable_filters(dataset):
            low, high = (int(value) for value in dataset[-2:, 0])
            contents.first_frame = high << 16 | low
        contents.frames = int(dataset.shape[1])
    contents.provenance["layout"] = f"version {OLD_VERSION}"
    return contents
