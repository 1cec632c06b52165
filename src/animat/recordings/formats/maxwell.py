"""Reads spikes, stimuli and electrodes of MaxWell MaxOne and MaxTwo files, in the layouts of docs/recordings.md."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from animat.errors import InvalidFile
from animat.recordings.columns import Column, PlainColumns, recorded_span
from animat.recordings.findings import Finding
from animat.recordings.formats.hdf5 import Hdf5File, choose, is_positive, unavailable_filters
from animat.recordings.formats.stimulus_text import stimulus_columns
from animat.recordings.recording import Recording
from animat.tables import UNKNOWN

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
class _Layout:
    """The paths of a recording's tables, what states its clock and channels, and what is noted on reading them."""

    spikes: str
    stimuli: str
    mapping: str
    rate_hz: float
    first_frame: int | None = None
    frames: int | None = None
    recorded_channels: Column | None = None
    provenance: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def read_maxwell(
    file: Hdf5File, part: str | None = None, stimuli: str | None = None, *, spikes: bool = True
) -> Recording:
    """Read spikes, which must exist, stimuli and electrodes of an open MaxWell file; or no spikes, for raw traces.

    `part` and `stimuli` are those of `read_recording`.
    """
    layout = _old(file) if is_old(file) else _new(file, part)
    findings, rate_hz = layout.findings, layout.rate_hz
    if spikes and not file.has(layout.spikes):
        remedy = "the rig kept raw traces only, or nothing; detect spikes in them with animat convert --raw"
        raise InvalidFile(f"{file.path}: expected spikes at /{layout.spikes}, found none: {remedy}")
    spike_frame, spike_channel = file.columns(layout.spikes, "frameno", "channel") if spikes else np.empty((2, 0), int)
    stimulus_frame, columns = np.empty(0, np.int64), dict[str, Any]()
    if file.has(layout.stimuli):
        stimulus_frame, columns = _bits(file, layout) if is_old(file) else _events(file, layout, stimuli)
    first_frame = layout.first_frame
    if first_frame is None:
        first_frame = min((int(np.min(frame)) for frame in (spike_frame, stimulus_frame) if len(frame)), default=0)
        message = "the number of the first frame is not in the file: the clock starts at the first spike or stimulus"
        findings.append(Finding("clock-from-first-event", "note", message))
    columns |= _channels(file, layout, spike_channel)
    routed = np.isin(spike_channel, columns["channel_label"])
    if lost := int(np.count_nonzero(~routed)):
        message = f"{lost:,} of {len(routed):,} spikes are on channels without a routed electrode and are left out"
        is_few = lost < 0.01 * len(routed)
        findings.append(Finding("spikes-not-routed", "note" if is_few else "warning", message, float(lost)))
    spike_time_s = (spike_frame[routed].astype(np.int64) - first_frame) / rate_hz
    stimulus_time_s = (stimulus_frame.astype(np.int64) - first_frame) / rate_hz
    if layout.frames is not None:
        columns |= recorded_span(layout.frames, rate_hz, spike_time_s, stimulus_time_s)
    plain = PlainColumns(spike_time_s, spike_channel[routed], stimulus_time_s, sampling_rate_hz=rate_hz, **columns)
    provenance = {"source": file.path.name, "format": "MaxWell", **layout.provenance}
    return plain.to_recording(provenance, tuple(findings))


def _new(file: Hdf5File, part: str | None) -> _Layout:
    recordings = parts(file)
    if not recordings:
        raise InvalidFile(f"{file.path}: expected a MaxWell recording in one of {', '.join(ROOTS)}, found none")
    name = choose(f"{file.path}: part", "--part", recordings, part)
    at = recordings[name]
    layout = _Layout(f"{at}/spikes", f"{at}/events", f"{at}/settings/mapping", USUAL_RATE_HZ)
    rate_hz = file.first(f"{at}/settings/sampling")
    if is_positive(rate_hz):
        layout.rate_hz = float(rate_hz)
    else:
        message = "the sampling rate is not in the file: assumed to be 20 kHz"
        layout.findings.append(Finding("sampling-missing", "warning", message))
    groups = [f"{at}/groups/{group}" for group in file.names(f"{at}/groups")]
    if recorded := [file.read(f"{group}/channels") for group in groups if file.has(f"{group}/channels")]:
        layout.recorded_channels = np.unique(np.concatenate(recorded).astype(np.int64))
    if ends := [e for group in groups if (e := file.ends(f"{group}/frame_nos")) is not None]:
        _count_frames(layout, ends)
    if len(recordings) > 1:
        layout.provenance["part"] = name
    # Only the number of a well tells the cultures of one plate apart; it comes first or last.
    if well := next((each for each in name.split("/") if each.startswith("well")), None):
        layout.provenance["well"] = well
    chip = file.first("wellplate/id")
    if isinstance(chip, str) and chip and chip.isprintable():
        layout.provenance["chip_id"] = chip
    started_ms = file.first(f"{at}/start_time")
    if is_positive(started_ms) and started_ms < 4e12:
        date = datetime.fromtimestamp(started_ms / 1e3, UTC)
        layout.provenance["recorded_at"] = date.isoformat(timespec="milliseconds")
    return layout


def _old(file: Hdf5File) -> _Layout:
    layout = _Layout("proc0/spikeTimes", "bits", "mapping", USUAL_RATE_HZ, provenance={"layout": "version 20160704"})
    sig = file.node("sig")
    if sig is not None and len(getattr(sig, "shape", ())) == 2 and sig.shape[0] > OLD_CHANNELS and sig.shape[1]:
        dataset = file.dataset("sig")
        layout.frames = n = int(dataset.shape[1])
        if not unavailable_filters(dataset):
            first, last = (int(high) << 16 | int(low) for low, high in (dataset[-2:, 0], dataset[-2:, n - 1]))
            _count_frames(layout, [(first, max(last, first + n - 1), n)])
    return layout


def _count_frames(layout: _Layout, ends: list[tuple[int, int, int]]) -> None:
    """State the first frame and how many there are, from those of each group: its first, its last and how many."""
    layout.first_frame = min(first for first, _, _ in ends)
    frames = max(last for _, last, _ in ends) - layout.first_frame + 1
    layout.frames = frames if frames > 0 else None
    lost = max(last - first + 1 - n for first, last, n in ends)
    if lost > 0:
        message = f"{lost:,} frames ({lost / layout.rate_hz:.3g} s) are missing from the recording"
        is_few = lost <= 0.001 * max(n for _, _, n in ends)
        layout.findings.append(Finding("frames-lost", "note" if is_few else "warning", message, float(lost)))


def _bits(file: Hdf5File, layout: _Layout) -> tuple[Column, dict[str, Any]]:
    """Frames and patterns of the stimuli of the old layout: bits that rise from 0 or change."""
    frame, bits = file.read(layout.stimuli, "frameno"), file.read(layout.stimuli, "bits").astype(np.int64)
    rises = (bits != 0) & (np.diff(bits, prepend=0) != 0)
    if n_falls := int(np.count_nonzero(~rises)):
        message = f"{n_falls:,} of {len(bits):,} entries of /bits end a pulse and are not stimuli"
        layout.findings.append(Finding("bits-not-rising", "note", message, float(n_falls)))
    return frame[rises], {"stimulus_pattern": bits[rises]} if len(np.unique(bits[rises])) > 1 else {}


def _events(file: Hdf5File, layout: _Layout, stimuli: str | None) -> tuple[Column, dict[str, Any]]:
    """Frames and parameters of the stimuli of the new layout: events of one type."""
    at, names = layout.stimuli, file.fields(layout.stimuli)
    frame = file.read(at, "frameno")
    is_stimulus = np.ones(len(frame), dtype=bool)
    if "eventtype" in names and len(frame):
        types = file.read(at, "eventtype")
        counts = {str(t): int(np.count_nonzero(types == t)) for t in np.unique(types)}
        which = choose(f"{file.path}: stimuli", "--stimuli", counts, stimuli, lambda t: f"{t} ({counts[t]:,} events)")
        is_stimulus = types.astype(np.str_) == which
        if left := int(np.count_nonzero(~is_stimulus)):
            message = f"{left:,} events of other types than {which} are left out"
            layout.findings.append(Finding("events-left-out", "note", message, float(left)))
    texts = file.read(at, "eventmessage")[is_stimulus].tolist() if "eventmessage" in names else []
    columns = stimulus_columns(texts)
    if "eventid" in names and "stimulus_pattern" not in columns:
        identity = file.read(at, "eventid")[is_stimulus].astype(np.int64)
        # If no number occurs twice, they only count the events, and are no patterns.
        if 1 < len(np.unique(identity)) < len(identity) and np.all(identity >= 0):
            columns["stimulus_pattern"] = identity
            layout.provenance["stimulus_pattern"] = "the events' eventid"
    return frame[is_stimulus], columns


def _channels(file: Hdf5File, layout: _Layout, spike_channel: Column) -> dict[str, Column]:
    """Label, electrode and position of every channel that was recorded."""
    recorded, findings = layout.recorded_channels, layout.findings
    if not file.has(layout.mapping):
        labels = np.unique(spike_channel if recorded is None else recorded)
        which = f"{len(labels):,} channels are {'those that fired' if recorded is None else 'taken from its groups'}"
        message = f"the file has no /{layout.mapping}: the electrodes of channels are not known; {which}"
        findings.append(Finding("mapping-missing", "warning" if recorded is None else "note", message))
        return {"channel_label": labels, "channel_electrode": np.full(len(labels), UNKNOWN)}
    channel, electrode = (file.read(layout.mapping, name).astype(np.int64) for name in ("channel", "electrode"))
    xy_um = np.column_stack([file.read(layout.mapping, axis).astype(np.float64) for axis in ("x", "y")])
    used = (channel >= 0) & (electrode >= 0)
    if recorded is not None:
        used &= np.isin(channel, recorded)
    labels, first = np.unique(channel[used], return_index=True)
    if repeated := int(np.count_nonzero(used)) - len(labels):
        message = f"the file's mapping repeats {repeated:,} channels; each counts once"
        if twice := len(np.unique(np.column_stack([channel, electrode])[used], axis=0)) - len(labels):
            message += f", and where it lists another electrode ({twice:,} times) the first one is used"
        findings.append(Finding("duplicate-channels", "note", message, float(repeated)))
    if recorded is not None and (unmapped := len(np.setdiff1d(recorded, labels))):
        message = f"{unmapped:,} recorded channels have no electrode in the mapping and are left out"
        findings.append(Finding("channels-not-routed", "note", message, float(unmapped)))
    return {"channel_label": labels, "channel_electrode": electrode[used][first], "channel_xy_um": xy_um[used][first]}
