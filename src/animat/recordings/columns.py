"""Makes a `Recording` from plain columns, as any laboratory has them; all plain file formats use this."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from animat.errors import InvalidArgument, UnusableData
from animat.recordings.findings import Finding, merged
from animat.recordings.metadata import culture_of, date_of
from animat.recordings.recording import Channels, Recording
from animat.recordings.time_quality import start_unknown
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import NOTHING, Stimuli
from animat.tables import UNKNOWN, expect_times

Column = np.ndarray[Any, Any]

REQUIRED = ("spike_time_s", "spike_channel", "stimulus_time_s")
_COLUMN_OF = {"spike_times_s:": "spike_time_s:", "channels.": "channel_", "stimuli.": "stimulus_"}
"""How messages begin that name an attribute of a recording, and the column that a user knows instead."""
LONGEST_TEXT = 1_000
"""Most characters of a name: an array reserves room for the longest name in every row."""


@dataclass(frozen=True, eq=False)
class PlainColumns:
    """Columns as read from a file: unsorted, unchecked, most of them optional. `to_recording` checks them all.

    Their shapes, units and defaults are those of the keys of NPZ in docs/recordings.md.
    """

    spike_time_s: Column
    spike_channel: Column
    stimulus_time_s: Column
    channel_label: Column | None = None
    channel_electrode: Column | None = None
    channel_xy_um: Column | None = None
    stimulus_frequency_hz: Column | None = None
    stimulus_pattern: Column | None = None
    stimulus_electrodes: Column | None = None
    stimulus_presentation: Column | None = None
    sampling_rate_hz: float = float("nan")
    start_min: float = 0.0
    start_s: float | None = None
    duration_s: float | None = None
    presentation_order: str | None = None
    presentation_pulses: int | None = None

    def to_recording(self, provenance: Mapping[str, str], findings: tuple[Finding, ...] = ()) -> Recording:
        """Check and sort the columns and make a recording from them, with the findings so far."""
        try:
            return self._to_recording(provenance, findings)
        except UnusableData as error:
            message = str(error)
            for name, column in _COLUMN_OF.items():
                message = column + message.removeprefix(name) if message.startswith(name) else message
            raise UnusableData(message) from error

    def _to_recording(self, provenance: Mapping[str, str], findings: tuple[Finding, ...]) -> Recording:
        for name in ("spike_channel", "channel_label", "stimulus_pattern"):
            dtype = np.asarray(getattr(self, name)).dtype
            # Characters for which every row of a text column has room.
            width = {"U": dtype.itemsize // 4, "S": dtype.itemsize}.get(dtype.kind, 0)
            if width > LONGEST_TEXT:
                raise UnusableData(f"{name}: expected names of at most {LONGEST_TEXT:,} characters, got {width:,}")
        noted = [*findings]
        spike_time_s, in_time = _sorted_times("spike_time_s", self.spike_time_s, "spikes", noted)
        stimulus_time_s, stimuli_in_time = _sorted_times("stimulus_time_s", self.stimulus_time_s, "stimuli", noted)
        noted += self._mixed_up()
        channels, rows = self._channels(len(spike_time_s), noted)
        if self.start_s is None:
            noted += start_unknown(spike_time_s, stimulus_time_s)
        stimuli, names = self._stimuli(stimulus_time_s, stimuli_in_time, noted)
        event_s = np.concatenate([spike_time_s, stimulus_time_s])
        start_s = float(event_s.min(initial=0.0) if self.start_s is None else self.start_s)
        stop_s = float(event_s.max(initial=start_s))
        presentation = self._presentation(stimuli)
        return Recording(
            spike_times_s=spike_time_s,
            spike_channels=rows[in_time],
            channels=channels,
            stimuli=stimuli,
            sampling_rate_hz=float(self.sampling_rate_hz),
            start_s=start_s,
            duration_s=duration_between(start_s, stop_s) if self.duration_s is None else float(self.duration_s),
            start_min=float(self.start_min),
            presentation=presentation,
            provenance={**provenance, **names},
            culture=culture_of(provenance),
            recorded_at=date_of(provenance),
            findings=merged(noted),
        )

    def _mixed_up(self) -> Iterator[Finding]:
        """A finding on times that go back in spikes and stimuli alike."""
        # By more than 1 s: events that were only written out of order are closer together.
        each = (np.asarray(times_s, np.float64) for times_s in (self.spike_time_s, self.stimulus_time_s))
        n, of_stimuli = (int(np.count_nonzero(np.diff(times_s) < -1.0)) for times_s in each)
        if 0 < n == of_stimuli:
            message = (
                f"times of spikes and of stimuli both go back by more than 1 s, {n:,} of each: if these are "
                "several recordings in one file, their events are mixed now; convert each by itself (--start-min)"
            )
            yield Finding("times-go-back", "warning", message, float(n))

    def _presentation(self, stimuli: Stimuli) -> Presentation | None:
        """How the stimuli were presented; if a trial's pulses are not stated, the most common number of them."""
        if self.presentation_order is None:
            if self.presentation_pulses is not None:
                expected = "'blocked' or 'mixed' with presentation_pulses"
                raise UnusableData(f"presentation_order: expected {expected}, got none")
            return None
        pulses = self.presentation_pulses
        if pulses is None:
            per_trial = np.unique(stimuli.presentation, return_counts=True)[1]
            pulses = max(1, int(np.bincount(per_trial, minlength=1).argmax()))
        try:
            return Presentation(self.presentation_order, pulses)  # type: ignore[arg-type]
        except InvalidArgument as error:
            raise UnusableData(f"presentation_{error}") from error

    def _channels(self, n_spikes: int, noted: list[Finding]) -> tuple[Channels, Int64[np.ndarray, " spikes"]]:
        """The channel table, and the row of each spike in it."""
        values = _column("spike_channel", self.spike_channel, n_spikes, "one channel per spike")
        if nameless := int(np.count_nonzero(values == "" if _is_text(values) else values != values)):
            raise UnusableData(f"spike_channel: expected a channel for each spike, got {nameless} without one")
        values = _as_names("spike_channel", values)
        lengths = {}
        for name in ("channel_label", "channel_electrode", "channel_xy_um"):
            if (column := getattr(self, name)) is not None:
                if np.ndim(column) == 0:
                    raise UnusableData(f"{name}: expected one value per channel, got a single value")
                lengths[name] = len(column)
        if not lengths:
            fired, rows = np.unique(values, return_inverse=True)
            only = f"only the channels that fired ({len(fired):,}) count"
            message = f"no channel table: {only}, so rates per channel may be too high"
            noted.append(Finding("silent-channels-unknown", "warning", message, float(len(fired))))
            return _channel_table(fired.astype(np.str_), None, None), rows.reshape(-1).astype(np.int64)
        if len(set(lengths.values())) > 1:
            got = ", ".join(f"{length} in {name}" for name, length in lengths.items())
            raise UnusableData(f"channel columns: expected one row per channel in each, got {got}")
        n_channels = next(iter(lengths.values()))
        given = np.arange(n_channels) if self.channel_label is None else np.asarray(self.channel_label)
        labels = _as_names("channel_label", given)
        table = _channel_table(labels.astype(np.str_), self.channel_electrode, self.channel_xy_um)
        if self.channel_label is not None and (_is_text(values) or not _is_text(labels)):
            return table, _rows_of(values.astype(np.str_), table.label)
        if _is_text(values):
            raise UnusableData("spike_channel: expected rows (whole numbers), as there is no channel_label; got text")
        outside = values[(values < 0) | (values >= n_channels)]
        if len(outside) and self.channel_label is not None:
            got = f"{outside[0]}: write labels as text in both, or as numbers in both"
            why = "as these are numbers and channel_label is text"
            raise UnusableData(f"spike_channel: expected rows from 0 to {n_channels - 1}, {why}, got {got}")
        return table, values.astype(np.int64)

    def _stimuli(self, time_s: Column, in_time: Column, noted: list[Finding]) -> tuple[Stimuli, dict[str, str]]:
        """The stimulus table, and the patterns' names for the provenance."""
        n = len(time_s)
        frequency_hz, pattern, names = np.full(n, np.nan), np.full(n, UNKNOWN), dict[str, str]()
        if self.stimulus_frequency_hz is not None:
            column = _column("stimulus_frequency_hz", self.stimulus_frequency_hz, n)
            frequency_hz = _numbers("stimulus_frequency_hz", column)
        if self.stimulus_pattern is not None:
            pattern = _as_names("stimulus_pattern", _column("stimulus_pattern", self.stimulus_pattern, n))
        if _is_text(pattern):
            # The empty name, of an unknown pattern, comes first.
            (_, *listed), number = np.unique(np.append("", pattern), return_inverse=True)
            pattern = number[1:] + UNKNOWN
            names["patterns"] = ", ".join(f"{i}: {name}" for i, name in enumerate(listed))
        electrodes = self._electrodes(n)[in_time]
        presentation = self._presentations(n, in_time, noted)
        return Stimuli(time_s, frequency_hz[in_time], pattern[in_time], electrodes, presentation), names

    def _electrodes(self, n: int) -> Int64[np.ndarray, "stimuli electrodes"]:
        given = np.full(n, UNKNOWN) if self.stimulus_electrodes is None else np.asarray(self.stimulus_electrodes)
        electrodes = given[:, None] if given.ndim == 1 else given
        if electrodes.ndim != 2 or len(electrodes) != n:
            expected = f"shape ({n}, electrodes), padded with {UNKNOWN}"
            raise UnusableData(f"stimulus_electrodes: expected {expected}, got {electrodes.shape}")
        whole = _as_whole_numbers("stimulus_electrodes", electrodes)
        expected = f"electrode numbers, or {UNKNOWN} for none (stimulus_pattern {NOTHING}: nothing was delivered)"
        _expect_electrodes("stimulus_electrodes", whole, expected)
        return whole

    def _presentations(self, n: int, in_time: Column, noted: list[Finding]) -> Column:
        if self.stimulus_presentation is not None:
            column = _column("stimulus_presentation", self.stimulus_presentation, n)
            presentations: Column = _as_whole_numbers("stimulus_presentation", column)[in_time]
            unknown = presentations == UNKNOWN
            # `Stimuli` refuses numbers that fall.
            if not np.any(unknown) or np.any(np.diff(presentations[~unknown]) < 0):
                return presentations
            before = np.maximum.accumulate(presentations)
            rising = np.where(unknown, np.iinfo(np.int64).max, presentations)
            within = unknown & (before == np.minimum.accumulate(rising[::-1])[::-1])
            message = f"{unknown.sum():,} of {n:,} stimuli have no trial number (-1): each is treated as one trial"
            message += f", but {within.sum():,} between two pulses of a trial as part of it" if np.any(within) else ""
            noted.append(Finding("trials-unknown", "note", message, float(unknown.sum())))
            presentations = np.where(within, before, presentations)
            return np.cumsum(np.append(True, np.diff(presentations) != 0) | (unknown & ~within)) - 1
        if (pulses := self.presentation_pulses or 1) > 1 and n:
            raise UnusableData(f"stimulus_presentation: required to know which {pulses} pulses are one trial, got none")
        return np.arange(n)


def pattern_names(provenance: Mapping[str, str]) -> dict[int, str]:
    """The names that a file had for patterns, by the numbers that they got (`PlainColumns`); empty without names."""
    listed = re.findall(r"(?:^|, )(\d+): (.*?)(?=, \d+: |$)", provenance.get("patterns", ""))
    return {int(number): name for number, name in listed}


def columns_of(recording: Recording) -> dict[str, Any]:
    """A recording as the arguments of `PlainColumns`, without those it does not state."""
    channels, stimuli, presentation = recording.channels, recording.stimuli, recording.presentation
    return {
        "spike_time_s": recording.spike_times_s,
        "spike_channel": recording.spike_channels,
        "channel_label": channels.label,
        "channel_electrode": channels.electrode,
        "channel_xy_um": np.column_stack([channels.x_um, channels.y_um]),
        **{f"stimulus_{each.name}": getattr(stimuli, each.name) for each in fields(stimuli)},
        **{name: getattr(recording, name) for name in ("sampling_rate_hz", "start_min", "start_s", "duration_s")},
        **({} if presentation is None else {f"presentation_{name}": of for name, of in vars(presentation).items()}),
    }


def with_start(recording: Recording, start_s: float) -> Recording:
    """The recording with a new start, reported as a finding if it differs, and the same end; refuses earlier events."""
    duration_s = duration_between(start_s, max(recording.stop_s, start_s))
    is_same = start_s == recording.start_s
    outdated = ("start-unknown",) if is_same else ("start-unknown", "start-given")
    findings = tuple(finding for finding in recording.findings if finding.name not in outdated)
    if not is_same:
        message = f"the recording starts at {start_s:.12g} s, as given, instead of {recording.start_s:.12g} s"
        findings += (Finding("start-given", "note", message, float(start_s)),)
    return replace(recording, start_s=float(start_s), duration_s=duration_s, findings=findings)


def duration_between(start_s: float, stop_s: float) -> float:
    """The duration such that start + duration does not round to before the end."""
    duration_s = stop_s - start_s
    while start_s + duration_s < stop_s:
        duration_s = float(np.nextafter(duration_s, np.inf))
    return duration_s


def recorded_span(frames: int, rate_hz: float, *times_s: Column) -> dict[str, float]:
    """`start_s` and `duration_s` that cover `frames` frames from 0 on and all events, which may lie outside them."""
    every_s = np.concatenate(times_s)
    start_s = float(every_s.min(initial=0.0))
    # Half a frame more than the last event, so that no rounding puts it outside.
    stop_s = max(frames / rate_hz, float(every_s.max(initial=0.0)) + 0.5 / rate_hz)
    return {"start_s": start_s, "duration_s": stop_s - start_s}


def _sorted_times(name: str, column: Column, events: str, noted: list[Finding]) -> tuple[Column, Column]:
    """The sorted times and the (stable) order that sorts them; reports times that were out of order."""
    times_s = _numbers(name, np.asarray(column))
    if times_s.ndim != 1:
        raise UnusableData(f"{name}: expected one column of times in seconds, got shape {times_s.shape}")
    expect_times(name, times_s)
    order = np.argsort(times_s, kind="stable")
    if early := count_out_of_order(times_s):
        noted.append(unsorted_finding(events, early, len(times_s)))
    return times_s[order], order


def count_out_of_order(times_s: Float64[np.ndarray, " events"]) -> int:
    """How many times are earlier than any time listed before them, not only the one just before."""
    return int(np.count_nonzero(times_s < np.maximum.accumulate(times_s)))


def unsorted_finding(events: str, early: int, n: int) -> Finding:
    """The note on events that were out of order in their file."""
    message = f"{events} that follow a later one in the file: {early:,} of {n:,}; they were sorted by time"
    return Finding(f"unsorted-{events}", "note", message, float(early))


def _channel_table(labels: Column, electrode: Column | None, xy_um: Column | None) -> Channels:
    n = len(labels)
    xy = np.full((n, 2), np.nan) if xy_um is None else _numbers("channel_xy_um", np.asarray(xy_um))
    if xy.shape != (n, 2):
        raise UnusableData(f"channel_xy_um: expected shape ({n}, 2) in micrometres, got {xy.shape}")
    electrodes = np.full(n, UNKNOWN)
    if electrode is not None:
        name = "channel_electrode"
        electrodes = _as_whole_numbers(name, _column(name, electrode, n, "one electrode per channel"))
        _expect_electrodes(name, electrodes, f"electrode numbers, or {UNKNOWN} if they are not known")
    return Channels(label=labels, electrode=electrodes, x_um=xy[:, 0], y_um=xy[:, 1])


def _expect_electrodes(name: str, electrodes: Column, expected: str) -> None:
    if (lowest := electrodes.min(initial=UNKNOWN)) < UNKNOWN:
        raise UnusableData(f"{name}: expected {expected}, got {lowest}")


def _rows_of(values: Column, labels: Column) -> Int64[np.ndarray, " spikes"]:
    """The row of each value in the labels."""
    distinct, which = np.unique(values, return_inverse=True)
    row_of = {str(label): row for row, label in enumerate(labels)}
    rows = np.array([row_of.get(str(value), UNKNOWN) for value in distinct], dtype=np.int64)
    unknown = distinct[rows == UNKNOWN]
    if len(unknown):
        n_spikes = np.count_nonzero(np.isin(values, unknown))
        got = f"{n_spikes} spikes on {len(unknown)} unknown channels (such as {str(unknown[0])!r})"
        raise UnusableData(f"spike_channel: expected labels listed in channel_label, got {got}")
    return rows[which.reshape(-1)]


def _column(name: str, column: Column, n: int, expected: str = "one value per stimulus") -> Column:
    column = np.asarray(column)
    if column.shape != (n,):
        raise UnusableData(f"{name}: expected {expected}, shape ({n},), got {column.shape}")
    return column


def _is_text(column: Column) -> bool:
    return column.dtype.kind in "US"


def _as_names(name: str, column: Column) -> Column:
    """The column as it is if it is text, otherwise as whole numbers."""
    return column if _is_text(column) else _as_whole_numbers(name, column)


def _numbers(name: str, column: Column) -> Float64[np.ndarray, "..."]:
    if column.dtype.kind not in "fiub" and column.size:
        raise UnusableData(f"{name}: expected numbers, got {column.dtype} (such as {str(column.flat[0])!r})")
    return column.astype(np.float64) if column.size else np.empty(column.shape)


def _as_whole_numbers(name: str, column: Column) -> Int64[np.ndarray, "..."]:
    """The column as whole numbers; NaN is `UNKNOWN`."""
    if column.dtype.kind in "iu":
        if column.dtype.kind == "u" and (largest := int(column.max(initial=0))) >= 2**63:
            raise UnusableData(f"{name}: expected whole numbers of at most 63 bits, got {largest}")
        return column.astype(np.int64)
    numbers = np.where(np.isnan(values := _numbers(name, column)), UNKNOWN, values)
    wrong = ~(np.abs(numbers) < 2**53) | (numbers != np.round(numbers))
    if np.any(wrong):
        raise UnusableData(f"{name}: expected whole numbers, got {numbers[wrong][0]:g}")
    return numbers.astype(np.int64)
