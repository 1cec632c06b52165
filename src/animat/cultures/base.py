"""The contract of everything that can be stimulated and recorded, simulated or alive."""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from inspect import getattr_static
from itertools import chain, pairwise
from types import FunctionType
from typing import Any, ClassVar, final

import numpy as np
from jaxtyping import Int64

from animat.arguments import check_argument
from animat.cultures.failures import as_device_failure
from animat.cultures.limits import Limits
from animat.cultures.observed import Observed, Spikes, assemble, following, with_rests
from animat.cultures.openable import Openable
from animat.cultures.safety import SIMULATED_LIMITS, Admitted
from animat.cultures.shortfalls import shortfall_findings
from animat.errors import AnimatError, InvalidArgument, expect_kind, some_of
from animat.progress import Progress, Silent
from animat.recordings.recorded_culture import RecordedCulture
from animat.recordings.recording import Channels, Recording
from animat.stimulation.places import electrodes_of
from animat.stimulation.plain import number, seconds
from animat.stimulation.protocol import Protocol
from animat.stimulation.pulse import Pulse
from animat.stimulation.schedule import SHORTEST_GAP_S, Block, Schedule, make_schedule
from animat.stimulation.stimulus import Stimulus, plain_stimuli
from animat.tables import UNKNOWN

_BEFORE_ALL = ("__getattribute__", "__setattr__", "__delattr__", "__copy__", "__deepcopy__")
"""Python calls these before, or instead of, the base class's attributes."""
_REPLACEABLE = ("__init__", "left_out", "device", "recorded_as", "stretch_s")
"""What a backend may override although it is not abstract."""
_GAP_ON_DEVICE_S = 0.1
"""Gap between two pulses in which a block is cut on a device, whose clock runs on meanwhile, if there are any."""


class Culture(Openable):
    """A culture on an array: open it, stimulate it, record it, let time pass, close it.

    Users call final methods, which check their arguments, consult the guard, and then call the backend's methods, whose
    names begin with an underscore. A culture has its own state and clock; everything takes time on it. Threads may
    share one: their calls wait for each other, except for `stop`. It cannot be copied.

    A backend implements `name` and all that is abstract, and passes `animat.cultures.contract.CultureContract`.

    Args:
        limits: tighter limits than the device's; None: the device's.
    """

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # Refuse one that replaces anything else of `Culture`, even through another base class.
        own = {
            name: member
            for kind in reversed(Culture.__mro__)
            for name, member in vars(kind).items()
            if kind.__module__.startswith(f"{__package__}.")
            and isinstance(member, FunctionType | property | classmethod)
            and not getattr(member, "__isabstractmethod__", False)
            and name not in _REPLACEABLE
        } | {name: getattr_static(Culture, name, None) for name in _BEFORE_ALL}
        for name, member in own.items():
            if getattr_static(cls, name, None) is not member:
                raise TypeError(f"{cls.__name__}.{name}: final in Culture; implement only what is abstract")
        # A device's limits are for all of its kind; its users can set tighter ones.
        for kind in cls.__mro__:
            is_of_device = kind.__module__.startswith(f"{__package__}.devices.") and "device_limits" in vars(kind)
            if is_of_device and getattr_static(cls, "device_limits") is not vars(kind)["device_limits"]:
                raise TypeError(f"{cls.__name__}.device_limits: final in {kind.__name__}; for tighter ones: limits=")

    @property
    @abc.abstractmethod
    def channels(self) -> Channels:
        """The recording electrodes."""

    @property
    @abc.abstractmethod
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        """Electrodes of each stimulation pattern, padded with -1."""

    @property
    @abc.abstractmethod
    def sampling_rate_hz(self) -> float:
        """Sampling rate of the raw signal in which spikes are detected."""

    @property
    @abc.abstractmethod
    def provenance(self) -> dict[str, str]:
        """The origin of recordings of this culture, by key; like all of a backend's data, valid once it is open."""

    @property
    def recorded_as(self) -> RecordedCulture | None:
        """Which culture its recordings are of; None for one that cannot be recognised."""
        return None

    @property
    def left_out(self) -> dict[str, int]:
        """Counts since `open`, by description, of what recordings lack but the device reported or should have."""
        return {}

    @property
    def stretch_s(self) -> float | None:
        """How much of a block `record` requests at a time, at least; None: all of it."""
        return None

    @abc.abstractmethod
    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        """Deliver stimuli at their times after `admitted.now_s`, let `duration_s` pass, and return the observation."""

    @final
    def deliver(self, stimuli: Iterable[Stimulus], duration_s: float, *, since_s: float | None = None) -> Observed:
        """Deliver stimuli within the next `duration_s` and observe all channels meanwhile.

        Args:
            stimuli: in order of time, counted from now, or from `since_s`. For a rest (`Stimulus.is_rest`) nothing is
                delivered.
            duration_s: how long, zero or more; all stimuli begin within it. All times are float64.
            since_s: a reading of `now_s`, as a living culture's clock runs on while a program decides what to request;
                None: now. If the first stimulus is overdue, it comes now, and the others keep their intervals after it.

        Raises:
            UnsafeStimulus: naming the limit that one of them exceeds; nothing is then delivered, and no time passes.
            InvalidArgument: for a culture that is not open, stimuli outside this stretch of time, a time less precise
                than float64, or a `since_s` that the clock has not reached.
            DeviceFailed: if the device fails meanwhile; with `is_admitted` true, the request may have been delivered.
        """
        turns, admitted = self._opened(), None
        stimuli, duration_s = _plain_request(stimuli, duration_s)
        try:
            with as_device_failure(self.name, "deliver"), turns as guard:
                now_s = seconds("now_s", self.now_s)
                if since_s is not None and since_s != now_s:
                    stimuli, duration_s = _from_now(stimuli, duration_s, seconds("since_s", since_s), now_s)
                # Rests go neither to the guard nor to the backend.
                pulses = [stimulus for stimulus in stimuli if not stimulus.is_rest]
                if stimuli and not pulses:
                    guard.expect_not_stopped()
                admitted = guard.admit(pulses, now_s)
                try:
                    observed = self._deliver(admitted, duration_s)
                except BaseException:
                    if isinstance(self, ComputedCulture):
                        # A computed culture delivers nothing more; a device may still deliver the rest.
                        guard.interrupt(self.now_s)
                    raise
                return with_rests(observed, stimuli, now_s)
        except AnimatError as error:
            error.is_admitted = admitted is not None and len(admitted.stimuli) > 0
            raise

    @final
    def advance(self, duration_s: float) -> Spikes:
        """Let time pass without stimuli; spike times are counted from its start."""
        return self.deliver((), duration_s).spikes

    @final
    def rest(self, duration_s: float) -> None:
        """Let time pass unobserved; raises as `deliver` does."""
        turns, duration_s = self._opened(), _plain_duration(duration_s)
        with as_device_failure(self.name, "rest"), turns:
            self._rest(duration_s)

    @final
    def stimulate(
        self, electrodes: Sequence[int], pulse: Pulse, window_ms: tuple[float, float] = (2.0, 10.0)
    ) -> Spikes:
        """Deliver one pulse now and return the spikes of a window after it; time passes to the window's end.

        Args:
            electrodes: pulsed together.
            window_ms: start and end; spikes have start <= time < end, counted from the pulse.

        Raises:
            UnsafeStimulus, InvalidArgument, DeviceFailed: as `deliver` does.
        """
        expect_kind("electrodes", electrodes, Iterable, "a list of electrodes")
        edges_ms = tuple(window_ms) if isinstance(window_ms, Iterable) else ()
        if len(edges_ms) != 2:
            raise InvalidArgument(f"window_ms: expected a start and an end, such as (2.0, 10.0), got {window_ms!r}")
        start_ms, end_ms = (number("window_ms", edge_ms) for edge_ms in edges_ms)
        if not 0 <= start_ms < end_ms < float("inf"):
            raise InvalidArgument(f"window_ms: expected a start from 0 and an end after it, got {window_ms}")
        observed = self.deliver([Stimulus(0.0, tuple(electrodes), pulse)], end_ms * 1e-3)
        since_s = observed.spikes.time_s - observed.stimulus_time_s[0]
        # Spikes lie on samples: one within half a nanosecond of an edge is on it.
        inside = (since_s >= start_ms * 1e-3 - 5e-10) & (since_s < end_ms * 1e-3 - 5e-10)
        return Spikes(since_s[inside], observed.spikes.channel[inside])

    @final
    def schedule(self, protocol: Protocol, seed: int = 0) -> Schedule:
        """The stimuli that `record` would deliver.

        Raises:
            InvalidArgument: for anything that is not a protocol, places with electrodes that do not stimulate the
                culture, or more patterns than it has.
        """
        expect_kind("protocol", protocol, Protocol, "a Protocol, such as Protocol(trials=5)")
        check_argument("seed", seed, int)
        table, sites = self.channels, self.stimulation_electrodes
        row_of = {electrode: row for row, electrode in enumerate(table.electrode.tolist())}
        rows = [row_of.get(electrode, UNKNOWN) for electrode in sites]
        # An electrode that is not recorded has no known position.
        x_um, y_um = (np.append(positions, np.nan)[rows] for positions in (table.x_um, table.y_um))
        places = electrodes_of(protocol.places, np.array(sites, np.int64), x_um, y_um)
        if strange := sorted({*chain(*places)} - {*sites}):
            them = f"the {len(sites)} that stimulate this culture ({some_of(sorted(sites))})"
            raise InvalidArgument(f"places: expected electrodes among {them}, got {some_of(strange)}")
        return make_schedule(protocol, self.patterns, seed, places=places)

    @final
    def record(
        self,
        protocol: Protocol,
        seed: int = 0,
        progress: Progress | None = None,
        follow: Callable[[Callable[[], Recording]], None] | None = None,
    ) -> Recording:
        """Stimulate by a protocol and record.

        The whole schedule is checked before anything is delivered. Set-up times pass unobserved and are left out of the
        recording's clock, on which blocks follow one another directly. The clock of a device runs on between two
        stretches of a block: the next one makes up for it as far as it can, and a finding of the recording (`left-out`)
        has the time in which nothing was observed.

        Args:
            protocol: what to do; it is kept with the recording.
            seed: decides the order of conditions and patterns.
            progress: updated after each block, or stretch of one (`stretch_s`).
            follow: then called, except at the end, with a function that returns the recording so far, also later, if
                an error or Ctrl-C ends it. The time it takes is subtracted from the next set-up time.

        Raises:
            UnsafeStimulus, InvalidArgument, DeviceFailed: as `deliver` does.
        """
        schedule, progress = self.schedule(protocol, seed), progress or Silent()
        provenance = {**self.provenance, "protocol_seed": str(seed)}
        # Recordings of computed cultures have no date, as they do not depend on when they are made.
        date = None if self.device is None else datetime.now(UTC).replace(microsecond=0)
        if date is not None:
            provenance["recorded_at"] = date.isoformat()
        self._rehearse(schedule)
        about = {"channels": self.channels, "culture": self.recorded_as, "recorded_at": date}
        start_min, rate_hz, before = self.now_s / 60, self.sampling_rate_hz, self.left_out
        parts = list[tuple[Block, Observed]]()
        followed_s = unobserved_s = 0.0
        gap_s = SHORTEST_GAP_S
        # A clock that stands still between calls needs no gap to make up for.
        if self.device is not None:
            gap_s = max(gap_s, min(_GAP_ON_DEVICE_S, max(1 / hz for hz in protocol.frequencies_hz)))

        def so_far() -> Recording:
            blocks, observed = zip(*parts, strict=True)
            left_out = Counter(self.left_out) - Counter(before)
            findings = tuple(shortfall_findings(parts, left_out, unobserved_s, rate_hz))
            lacks = {"left_out": ", ".join(f"{n} {what}" for what, n in left_out.items())} if left_out else {}
            recorded = assemble(
                replace(schedule, blocks=blocks), observed, sampling_rate_hz=rate_hz, start_min=start_min, **about
            )
            return replace(recorded, provenance={**provenance, **lacks}, findings=findings)

        for done, block in enumerate(schedule.blocks):
            self.rest(max(0.0, block.setup_s - followed_s))
            stretches = (block,) if self.stretch_s is None else block.stretches(self.stretch_s, gap_s)
            for i, stretch in enumerate(stretches, 1):
                ended_s = None
                if i > 1 and self.device is not None:
                    ended_s = min(self.now_s, _ended_s(*parts[-1]))
                observed = self.deliver(schedule.deliveries(stretch), stretch.duration_s, since_s=ended_s)
                if ended_s is not None:
                    observed, missed_s = following(parts[-1][1], observed)
                    unobserved_s += missed_s
                parts.append((stretch, observed))
                progress.update(done + i / len(stretches), len(schedule.blocks))
                if follow is not None and (i < len(stretches) or done + 1 < len(schedule.blocks)):
                    seen_s = self.now_s
                    follow(so_far)
                    followed_s = self.now_s - seen_s
        return so_far()

    def _rehearse(self, schedule: Schedule) -> None:
        """Have the guard check the whole schedule, each block at its time, and deliver nothing."""
        offset_s, pulses = 0.0, list[Stimulus]()
        for block in schedule.blocks:
            offset_s += block.setup_s
            stimuli = schedule.deliveries(block)
            pulses += [replace(each, time_s=offset_s + each.time_s) for each in stimuli if not each.is_rest]
            offset_s += block.duration_s
        with self._opened() as guard:
            guard.check(pulses, self.now_s)


def _ended_s(stretch: Block, observed: Observed) -> float:
    """When a delivered stretch ended on the culture's clock: as long after its last stimulus as it was meant to."""
    return float(observed.start_s + observed.stimulus_time_s[-1] + stretch.duration_s - stretch.stimuli.time_s[-1])


def _plain_request(stimuli: Iterable[Stimulus], duration_s: float) -> tuple[Sequence[Stimulus], float]:
    """The arguments of a delivery as immutable plain values; refuses anything else, and a stimulus after the end."""
    stimuli, duration_s = plain_stimuli(stimuli), _plain_duration(duration_s)
    times_s = [stimulus.time_s for stimulus in stimuli]
    if late_s := [time_s for time_s in times_s if not time_s < duration_s]:
        expected = f"times before the delivery ends ({duration_s:g} s)"
        raise InvalidArgument(f"stimuli: expected {expected}, got {late_s[0]:g} s")
    # The guard checks the times of pulses, and does not see rests.
    has_rests = any(stimulus.is_rest for stimulus in stimuli)
    if has_rests and not all(before <= after for before, after in pairwise([0.0, *times_s])):
        raise InvalidArgument(f"stimuli: expected times from 0 s in ascending order, got {times_s[:5]}")
    return stimuli, duration_s


def _from_now(
    stimuli: Sequence[Stimulus], duration_s: float, since_s: float, now_s: float
) -> tuple[Sequence[Stimulus], float]:
    """A request whose times count from `since_s`, as one from now; InvalidArgument if that is later.

    All stimuli are moved equally, so that intervals stay as requested; what is overdue begins now. Times below 0 are
    left to the guard.
    """
    if not since_s <= now_s:
        expected = f"a reading of the clock, which is at {now_s:g} s"
        raise InvalidArgument(f"since_s: expected {expected}, got {since_s}")
    passed_s = min(now_s - since_s, max(0.0, stimuli[0].time_s) if stimuli else duration_s)
    return [replace(stimulus, time_s=stimulus.time_s - passed_s) for stimulus in stimuli], duration_s - passed_s


def _plain_duration(duration_s: float) -> float:
    duration_s = seconds("duration_s", duration_s)
    if not 0 <= duration_s < float("inf"):
        raise InvalidArgument(f"duration_s: expected a finite number of seconds from 0, got {duration_s}")
    return duration_s


class ComputedCulture(Culture):
    """A culture that a program computes: a delivery ends within its call; reopened, it continues where it was."""

    ends_within_s: ClassVar[float] = -1

    @property
    def device_limits(self) -> Limits:
        return SIMULATED_LIMITS

    def _halt(self) -> None:
        """Do nothing: the guard refuses the next delivery."""

    def _close(self) -> None:
        """Do nothing: it stays in memory."""
