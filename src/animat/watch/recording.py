"""The view of recordings: raster, rates, responses and findings of the one in progress or the newest."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from animat.errors import AnimatError, InvalidFile, counted
from animat.plain_file import expect_plain_file
from animat.recordings.formats.npz import UNDER_WAY
from animat.recordings.reading import read_recording
from animat.recordings.recording import Recording
from animat.report.array import rates_of_sites
from animat.responses.inspection import Inspection, inspect_recording
from animat.watch.discovery import MOST_RECORDINGS, is_locked, recordings_in
from animat.watch.files import packed, text
from animat.watch.view import View, chart, curve, facts, in_blocks, table

_Content = tuple[Recording | None, Inspection | None, str]
"""A recording and its inspection, or why there is none."""
_Shares = tuple[float, dict[str, float]]
"""A recording's start, and the share of each condition's responses above the median."""


class RecordingView(View):
    """A folder of recordings, of which the last changed is read again."""

    kind = "recording"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._key: tuple[Path, float] | None = None
        self._content: _Content = None, None, ""
        self._shares: dict[Path, tuple[float, _Shares]] = {}
        """When each file last changed, and its shares."""

    def _title(self) -> str:
        return "recordings"

    def _view(self, to_s: float | None, span_s: float) -> dict[str, Any]:
        # Before the files are listed: a program removes the recording in progress before it unlocks the folder.
        running = is_locked(self.folder)
        times_s = recordings_in(self.folder)
        if not times_s:
            raise InvalidFile(f"{self.folder}: expected recordings, but they are gone")
        newest = max(times_s, key=lambda file: (times_s[file], file.name))
        recording, inspection, error = self._newest_inspection(times_s, newest)
        in_progress = self.folder / UNDER_WAY in times_s
        n_whole = len(times_s) - in_progress
        complete = n_whole if len(times_s) < MOST_RECORDINGS else f"{n_whole:,} or more: only the newest are watched"
        blocks = [facts("Recordings", _facts(inspection, complete, newest))]
        span: dict[str, Any] = {"from_s": 0.0, "to_s": 0.0, "end_s": 0.0}
        if recording is not None:
            raster, span = _raster(recording, to_s, span_s)
            blocks += [raster, _rates(recording)]
        blocks += [
            _shares_table([shares for _, shares in self._shares.values()], len(times_s)),
            *_inspected(inspection),
        ]
        state, message = "ended", counted(n_whole, "recording")
        if running is False and in_progress:
            state = "silent"
            message = "the recording in progress was interrupted: its data so far are shown, but are not a recording"
        elif running:
            state, message = "running", ""
            if newest.name != UNDER_WAY:
                message = (
                    "nothing is known of the next recording yet: stimulation is being set up, or its first block is "
                    "running"
                )
            elif recording is not None:
                message = f"{recording.duration_s:.0f} s of the one in progress are shown"
        return in_blocks({"state": state, "message": message, **span}, blocks, error)

    def _newest_inspection(self, times_s: dict[Path, float], newest: Path) -> _Content:
        """The newest, read again if it changed; else one of the others is inspected, as each takes a second or two."""
        self._shares = {file: each for file, each in self._shares.items() if times_s.get(file) == each[0]}
        if self._key != (newest, times_s[newest]):
            self._key, self._content = (newest, times_s[newest]), _read(newest)
            self._shares[newest] = times_s[newest], _shares_of(self._content[1])
        elif (other := next((file for file in times_s if file not in self._shares), None)) is not None:
            self._shares[other] = times_s[other], _shares_of(_read(other)[1])
        return self._content


def _facts(inspection: Inspection | None, complete: int | str, newest: Path) -> list[tuple[str, Any]]:
    shown = "the one in progress, as far as it has come" if newest.name == UNDER_WAY else newest.name
    rows: list[tuple[str, Any]] = [("complete", complete), ("shown", shown)]
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


def _read(file: Path) -> _Content:
    try:
        recording = read_recording(expect_plain_file(file, most_bytes=2**31))
        return recording, inspect_recording(recording, name=file.name), ""
    except AnimatError as error:
        return None, None, text(" ".join(str(error).split()))


def _shares_of(inspection: Inspection | None) -> _Shares:
    if inspection is None:
        return math.nan, {}
    return inspection.responses.start_min, {text(c.label): c.share_above_median for c in inspection.conditions}


def _raster(recording: Recording, to_s: float | None, span_s: float) -> tuple[dict[str, Any], dict[str, Any]]:
    start_s, stop_s = recording.start_s, recording.stop_s
    to_s = stop_s if to_s is None else min(max(to_s + start_s, start_s), stop_s)
    from_s = max(to_s - span_s, start_s)
    first, last = np.searchsorted(recording.spike_times_s, (from_s, to_s))
    times_s, channels = recording.spike_times_s[first:last], recording.spike_channels[first:last]
    spikes, _ = packed(times_s, channels, from_s, to_s, len(recording.channels))
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
    rates_hz = np.sort(rates_of_sites(recording))[::-1]
    line = curve("", np.arange(1, len(rates_hz) + 1).tolist(), rates_hz.tolist(), "line", "blue")
    median = float(np.median(rates_hz)) if len(rates_hz) else 0.0
    note = f"Firing rate, the most active channel first; median {median:.2f} Hz, {int((rates_hz == 0).sum())} silent"
    return chart("Rates of channels", "channels, by rate", "Hz", [line], note, width="half")


def _shares_table(shares: list[_Shares], files: int) -> dict[str, Any]:
    """The share of responses above the median for each condition, in each recording inspected so far."""
    columns = sorted(((minute, column) for minute, column in shares if column), key=lambda pair: pair[0])
    labels = list(dict.fromkeys(label for _, column in columns for label in column))
    rows = [[label, *(f"{of[label]:.2f}" if label in of else None for _, of in columns)] for label in labels]
    note = (
        "The share of responses at or above the median of all: the more it differs between conditions, the better "
        f"a robot can be driven. {len(shares)} of {files} recordings have been inspected so far."
    )
    head = ["condition", *(f"{minute:g} min" for minute, _ in columns)]
    return table("P(x >= P50) of each condition", head, rows, note)


def _inspected(inspection: Inspection | None) -> list[dict[str, Any]]:
    if inspection is None:
        return [table("Findings", ["severity", "message"], [], "the newest recording could not be inspected")]
    conditions = [
        [c.label, c.n_responses, c.n_non_burst, f"{c.median_rate_hz:.2f}" if c.n_non_burst else None]
        for c in inspection.conditions[:200]
    ]
    findings = [[finding.severity, finding.message] for finding in inspection.findings]
    head = ["condition", "responses", "without bursts", "median (Hz)"]
    return [
        table("Responses", head, conditions, width="third"),
        table("Findings", ["severity", "message"], findings, "" if findings else "none", width="two-thirds"),
    ]
