"""What was measured: spikes on channels, or only their counts, and stimuli, as immutable arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float64, Int64

from animat.arguments import checked_arguments
from animat.errors import UnusableData
from animat.recordings.findings import Finding
from animat.recordings.recorded_culture import RecordedCulture
from animat.stimulation.array import ElectrodeArray
from animat.stimulation.protocol import Presentation, Protocol
from animat.stimulation.pulse import Pulse
from animat.stimulation.stimulus import Stimuli
from animat.tables import CENTURY_S, FASTEST_HZ, briefly, expect_rising_times, freeze, freeze_one, reduce_dataclass

ResponseKind = Literal["count", "rate_hz"]


@checked_arguments
@dataclass(frozen=True, eq=False)
class Channels:
    """The table of recording channels: row i states where channel i is.

    A *channel* is a row of this table; its `label` is its name on the rig (a channel number, a sorted unit's number),
    its `electrode` the site on the array that it records. The three are never interchangeable.

    Attributes:
        label: the rig's own name of each channel, unique, shape (channels,), strings.
        electrode: the electrode each channel records, `UNKNOWN` if not known, shape (channels,).
        x_um, y_um: the electrode's position in micrometres, NaN if not known, shape (channels,).
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    label: np.ndarray[Any, np.dtype[np.str_]]
    electrode: Int64[np.ndarray, " channels"]
    x_um: Float64[np.ndarray, " channels"]
    y_um: Float64[np.ndarray, " channels"]

    def __post_init__(self) -> None:
        freeze(self, "the channel table", label=np.str_, electrode=np.int64, x_um=np.float64, y_um=np.float64)
        labels, counts = np.unique(self.label, return_counts=True)
        if np.any(counts > 1):
            raise UnusableData(f"channels.label: expected each label once, got '{labels[counts > 1][0]}' twice or more")

    @staticmethod
    def on(array: ElectrodeArray, electrode: Int64[np.ndarray, " channels"], label: Any = None) -> Channels:
        """The channel table for electrodes, numbered unless labelled; InvalidArgument for one not on the array."""
        x_um, y_um = array.position_um(electrode)
        label = np.arange(len(electrode)) if label is None else np.asarray(label)
        return Channels(label=label.astype(np.str_), electrode=electrode, x_um=x_um, y_um=y_um)

    def __len__(self) -> int:
        return len(self.label)

    @property
    def has_positions(self) -> bool:
        """Whether every channel's position is known."""
        return bool(len(self)) and bool(np.all(np.isfinite(self.x_um)) and np.all(np.isfinite(self.y_um)))


@checked_arguments
@dataclass(frozen=True, eq=False)
class Recording:
    """One recording of a culture: its spikes, channels and stimuli. Arrays are read-only.

    All times are in seconds on the recording's own clock, which may start below zero; `start_min` places the
    recording on the culture's clock.

    Attributes:
        spike_times_s: times of all spikes, in ascending order, shape (spikes,).
        spike_channels: the row in `channels` of each spike, shape (spikes,). Simultaneous spikes are sorted by channel,
            so that a set of spikes has only one order.
        sampling_rate_hz: of the raw signal in which the spikes were detected, NaN if not known.
        start_s: start of the recording on its own clock.
        duration_s: from `start_s`; all spikes and stimuli lie within.
        start_min: start on the culture's clock, in minutes.
        presentation: how stimuli were presented, None if not known.
        provenance: where the recording came from, as text by keyword, for people.
        protocol: with which it was recorded, None if not known.
        culture: that was recorded, None if not known.
        findings: made when the recording was read or its spikes were detected.
        recorded_at: when it began, with a time zone; None if not known.
        loop_pulse: that a closed loop delivered, if this is the recording of one; else None.

    Raises:
        UnusableData: for times that are not finite or not in ascending order, or rows outside the tables.
    """

    __repr__, __reduce__ = briefly, reduce_dataclass

    spike_times_s: Float64[np.ndarray, " spikes"]
    spike_channels: Int64[np.ndarray, " spikes"]
    channels: Channels
    stimuli: Stimuli
    sampling_rate_hz: float
    start_s: float
    duration_s: float
    start_min: float = 0.0
    presentation: Presentation | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    protocol: Protocol | None = None
    culture: RecordedCulture | None = None
    findings: tuple[Finding, ...] = ()
    recorded_at: datetime | None = None
    loop_pulse: Pulse | None = None

    def __post_init__(self) -> None:
        freeze(self, "spikes", spike_times_s=np.float64, spike_channels=np.int64)
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        expect_rising_times("spike_times_s", self.spike_times_s)
        outside = (self.spike_channels < 0) | (self.spike_channels >= len(self.channels))
        if np.any(outside):
            got = f"{self.spike_channels[outside][0]} ({np.count_nonzero(outside)} spikes on unknown channels)"
            expected = f"rows of the channel table (0 to {len(self.channels) - 1})"
            raise UnusableData(f"spike_channels: expected {expected}, got {got}")
        # Files store spikes by channel: without a fixed order of ties, a recording would not read back equal.
        if np.any((np.diff(self.spike_times_s) == 0) & (np.diff(self.spike_channels) < 0)):
            order = np.lexsort((self.spike_channels, self.spike_times_s))
            object.__setattr__(self, "spike_channels", self.spike_channels[order])
            freeze_one(self, "spike_channels")
        # Events up to a century before and after 0 are up to two centuries apart.
        if not (abs(self.start_s) <= CENTURY_S and 0 <= self.duration_s <= 2 * CENTURY_S):
            length = ", the latter 0 or more" if self.duration_s < 0 else ""
            expected = f"start_s, duration_s: expected finite seconds within a century{length}"
            raise UnusableData(f"{expected}, got {self.start_s:g} and {self.duration_s:g}")
        if self.recorded_at is not None and self.recorded_at.tzinfo is None:
            raise UnusableData(f"recorded_at: expected a date with a time zone, got {self.recorded_at}")
        if not abs(self.start_min) <= CENTURY_S / 60:
            raise UnusableData(f"start_min: expected finite minutes within a century, got {self.start_min:g}")
        if self.sampling_rate_hz <= 0 or self.sampling_rate_hz > FASTEST_HZ:
            expected = f"a positive rate up to {FASTEST_HZ:g} Hz, or NaN if not known"
            raise UnusableData(f"sampling_rate_hz: expected {expected}, got {self.sampling_rate_hz:g}")
        for name, times in (("spike_times_s", self.spike_times_s), ("stimuli.time_s", self.stimuli.time_s)):
            if len(times) and (times[0] < self.start_s or times[-1] > self.stop_s):
                expected = f"times within the recording ({self.start_s:g} to {self.stop_s:g} s)"
                raise UnusableData(f"{name}: expected {expected}, got {times[0]:g} to {times[-1]:g} s")

    @property
    def stop_s(self) -> float:
        """End of the recording on its own clock, in seconds."""
        return self.start_s + self.duration_s

    @property
    def pulse(self) -> Pulse | None:
        """The pulse that was delivered; None if it is not known."""
        return self.loop_pulse if self.protocol is None else self.protocol.pulse

    def without_spikes(self) -> Recording:
        """The same without its spikes, which take by far the most room."""
        return replace(self, spike_times_s=np.empty(0), spike_channels=np.empty(0, np.int64))

    def equals(self, other: Recording) -> bool:
        """Whether all arrays and values of the two recordings are equal (NaN equals NaN)."""
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))


@dataclass(frozen=True, eq=False)
class ResponseTable:
    """A count or a rate for each stimulus and channel, which many laboratories publish instead of spikes.

    Attributes:
        values: spikes in the window, or their rate in Hz, one row per stimulus in order of presentation, shape
            (stimuli, channels).
        kind: which of the two.
        channels: the channel table, one row per column of `values`.
        stimuli: the stimulus table, one row per row of `values`.
        has_times: whether `stimuli.time_s` are times; otherwise they number the rows.
        window_ms: the window after the stimulus in which spikes were counted, None if not known.
        start_min, presentation, provenance, findings: as in `Recording`.
        protocol, culture, recorded_at: None, as files do not state them.

    Raises:
        UnusableData: for values that are negative or not finite, counts that are not whole, or tables of the wrong
            length.
    """

    values: Float64[np.ndarray, "stimuli channels"]
    kind: ResponseKind
    channels: Channels
    stimuli: Stimuli
    has_times: bool = True
    window_ms: tuple[float, float] | None = None
    start_min: float = 0.0
    presentation: Presentation | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    protocol: ClassVar[None] = None
    culture: ClassVar[None] = None
    recorded_at: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        values = freeze_one(self, "values", np.float64)
        shape = (len(self.stimuli), len(self.channels))
        if values.shape != shape:
            raise UnusableData(f"responses: expected rows of stimuli, columns of channels, {shape}, got {values.shape}")
        wrong, advice = ~np.isfinite(values) | (values < 0), ""
        expected = "counts of 0 or more" if self.kind == "count" else "rates in Hz of 0 or more"
        if self.kind == "count" and not np.any(wrong):
            wrong, expected = values != np.round(values), "whole spike counts"
            advice = "; if these are rates in Hz, name them rate_hz"
        if np.any(wrong):
            row, column = np.argwhere(wrong)[0]
            where = f"for stimulus {row + 1} on channel {self.channels.label[column]}"
            raise UnusableData(f"responses: expected {expected}, got {values[row, column]:g} {where}{advice}")
        if self.window_ms is not None and not 0 <= self.window_ms[0] < self.window_ms[1] < np.inf:
            raise UnusableData(f"window: expected 0 <= start < end in ms, got {self.window_ms}")


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
    if isinstance(a, Channels | Stimuli) and type(a) is type(b):
        return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (np.isnan(a) and np.isnan(b))
    return bool(a == b)
