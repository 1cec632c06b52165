"""The view of recordings: raster, rates, responses and findings of the one in progress or the newest."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from animat.cultures.under_way import UNDER_WAY
from animat.errors import AnimatError, InvalidArgument, InvalidFile
from animat.recordings.recording import Recording
from animat.responses.inspection import Inspection, inspect_recording
from animat.watch.blocks import chart, curve, facts, table
from animat.watch.discovery import changed_s, recordings_in
from animat.watch.plain import text
from animat.watch.spikes import packed_spikes
from animat.watch.state import is_locked
from animat.watch.view import View, in_blocks, titled

_MOST_SPAN_S = 60.0
_LARGEST = 2**31
"""Most bytes of a file that is read."""


class RecordingView(View):
    """A folder of recordings, of which the last changed is read again."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._key: Any = None
        self._recording: Recording | None = None
        self._inspection: Inspection | None = None
        self._error = ""
        self._shares: dict[Path, tuple[float, dict[str, float]]] = {}

    def about(self) -> dict[str, Any]:
        """The title."""
        return titled("recordings")

    def view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        """The newest recording, and the seconds of it before a time."""
        if not 0 < span_s <= _MOST_SPAN_S:
            raise InvalidArgument(f"span: expected above 0 and at most {_MOST_SPAN_S:g} s, got {span_s:g}")
        # Before the files are listed: a program removes the recording in progress before it unlocks the folder.
        running = is_locked(self.folder)
        whole = recordings_in(self.folder)
        times = {file: time_s for file in (*whole, self.folder / UNDER_WAY) if (time_s := changed_s(file)) is not None}
        if not times:
            raise InvalidFile(f"{self.folder}: expected recordings, but they are gone")
        newest = max(times, key=lambda file: (times[file], file.name))
        self._look_at_another([*times], newest)
        recording = self._recording
        blocks = [facts("Recordings", self._facts(len(whole), newest))]
        span: dict[str, Any] = {"from_s": 0.0, "to_s": 0.0, "end_s": 0.0}
        if recording is not None:
            raster, span = _raster(recording, to_s, span_s)
            blocks += [raster, _rates(recording)]
        blocks += [_shares(self._shares, len(times)), *_inspected(self._inspection)]
        is_broken = running is False and self.folder / UNDER_WAY in times
        state = {
            "state": "running" if running else "silent" if is_broken else "ended",
            "message": _message(len(whole), newest, recording, running=bool(running), is_broken=is_broken),
        }
        return in_blocks({**state, **span}, blocks, self._error)

    def _facts(self, whole: int, newest: Path) -> list[tuple[str, Any]]:
        shown = "the one in progress, as far as it has come" if newest.name == UNDER_WAY else newest.name
        rows: list[tuple[str, Any]] = [("complete", whole), ("shown", shown)]
        inspection = self._inspection
        if inspection is not None:
            rows += [
                ("verdict", inspection.verdict),
                ("stimuli", inspection.n_stimuli),
                ("spikes", inspection.n_spikes),
                ("channels", inspection.responses.n_channels),
                ("seconds", inspection.duration_s),
                ("bursts", inspection.n_bursts),
                ("presented", str(inspection.responses.presentation or "not known")),
            ]
        return rows

    def _read(self, file: Path) -> None:
        """Read a file, if it differs from the last one read."""
        try:
            status = file.stat()
        except OSError:
            # The recording in progress is removed when it is complete.
            return
        key = file, status.st_mtime_ns, status.st_size
        if key == self._key:
            return
        self._key, self._recording, self._inspection, self._error = key, None, None, ""
        try:
            self._recording, self._inspection = _inspection_of(file)
        except AnimatError as error:
            self._error = text(" ".join(str(error).split()))
        self._keep(file, self._inspection)

    def _look_at_another(self, files: list[Path], newest: Path) -> None:
        """Read the newest, or one other that has not been inspected yet: each takes a second or two."""
        before = self._key
        self._shares = {file: row for file, row in self._shares.items() if file in files}
        self._read(newest)
        other = next((file for file in files if file not in self._shares), None)
        if before != self._key or other is None:
            return
        try:
            self._keep(other, _inspection_of(other)[1])
        except AnimatError:
            self._keep(other, None)

    def _keep(self, file: Path, inspection: Inspection | None) -> None:
        shares = {} if inspection is None else {text(c.label): c.share_above_median for c in inspection.conditions}
        self._shares[file] = (float("nan") if inspection is None else inspection.responses.start_min), shares


def _message(whole: int, newest: Path, recording: Recording | None, *, running: bool, is_broken: bool) -> str:
    """The state of the recordings in words."""
    if is_broken:
        return "the recording in progress was interrupted: its data so far are shown, but are not a recording"
    if not running:
        return "1 recording" if whole == 1 else f"{whole} recordings"
    if newest.name != UNDER_WAY:
        return "nothing is known of the next recording yet: stimulation is being set up, or its first block is running"
    return "" if recording is None else f"{recording.duration_s:.0f} s of the one in progress are shown"


def _inspection_of(file: Path) -> tuple[Recording, Inspection]:
    from animat.recordings.reading import read_recording

    if file.stat().st_size > _LARGEST:
        raise InvalidFile(f"{file.name}: expected at most {_LARGEST:,} bytes to show, got {file.stat().st_size:,}")
    recording = read_recording(file)
    return recording, inspect_recording(recording, name=file.name)


def _raster(recording: Recording, to_s: float | None, span_s: float) -> tuple[dict[str, Any], dict[str, Any]]:
    start_s, stop_s = recording.start_s, recording.stop_s
    to_s = stop_s if to_s is None else min(max(to_s + start_s, start_s), stop_s)
    from_s = max(to_s - span_s, start_s)
    first, last = np.searchsorted(recording.spike_times_s, (from_s, to_s))
    times_s, channels = recording.spike_times_s[first:last], recording.spike_channels[first:last]
    spikes, _ = packed_spikes(times_s, channels, from_s, to_s, len(recording.channels))
    pulses_s = recording.stimuli.time_s[~recording.stimuli.is_rest]
    pulses_s = pulses_s[(pulses_s >= from_s) & (pulses_s <= to_s)]
    every = f"; every {spikes['every']}th is drawn" if spikes["every"] > 1 else ""
    note = (
        f"{spikes['n']:,} spikes on {len(recording.channels):,} channels{every}; {len(pulses_s):,} pulses, marked above"
    )
    block = {
        "kind": "raster", "title": "Spikes by channel", "spikes": spikes, "from_s": from_s, "to_s": to_s,
        "n_channels": len(recording.channels), "pulses_s": pulses_s[:4000].tolist(), "words": note,
    }  # fmt: skip
    return block, {"from_s": from_s - start_s, "to_s": to_s - start_s, "end_s": stop_s - start_s}


def _rates(recording: Recording) -> dict[str, Any]:
    counts = np.bincount(recording.spike_channels, minlength=len(recording.channels))
    rates_hz = np.sort(counts / max(recording.duration_s, 1e-9))[::-1]
    line = curve("", np.arange(1, len(rates_hz) + 1).tolist(), rates_hz.tolist(), "line", "blue")
    median = float(np.median(rates_hz)) if len(rates_hz) else 0.0
    note = f"Firing rate, the most active channel first; median {median:.2f} Hz, {int((counts == 0).sum())} silent"
    return chart("Rates of channels", "channels, by rate", "Hz", [line], note, width="half")


def _shares(shares: dict[Path, tuple[float, dict[str, float]]], files: int) -> dict[str, Any]:
    """The share of responses above the median for each condition, in each recording inspected so far."""
    columns = sorted(((minute, column) for minute, column in shares.values() if column), key=lambda pair: pair[0])
    labels = list(dict.fromkeys(label for _, column in columns for label in column))
    rows = [[label, *(f"{of[label]:.2f}" if label in of else None for _, of in columns)] for label in labels]
    note = (
        "The share of responses at or above the median of all: the more it differs between conditions, the better "
        f"a robot can be driven. {len(shares)} of {files} recordings have been inspected so far."
    )
    head = ["condition", *(f"{minute:g} min" for minute, _ in columns)]
    return table("P(x >= P50) of each condition", head, rows, note)


def _median(rate_hz: float) -> str | None:
    return f"{rate_hz:.2f}" if math.isfinite(rate_hz) else None


def _inspected(inspection: Inspection | None) -> list[dict[str, Any]]:
    if inspection is None:
        return [table("Findings", ["severity", "message"], [], "the newest recording could not be inspected")]
    conditions = [[c.label, c.n_responses, c.n_non_burst, _median(c.median_rate_hz)] for c in inspection.conditions]
    findings = [[finding.severity, finding.message] for finding in inspection.findings]
    return [
        table(
            "Responses", ["condition", "responses", "without bursts", "median (Hz)"], conditions[:200], width="third"
        ),
        table("Findings", ["severity", "message"], findings, "" if findings else "none", width="two-thirds"),
    ]
