"""The contract of everything that can be stimulated and recorded, simulated or alive."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import getattr_static
from types import TracebackType
from typing import Any, ClassVar, Self, final

import numpy as np
from jaxtyping import Int64

from animat.cultures.failing import as_device_failure
from animat.cultures.history import History
from animat.cultures.observed import Observed, Spikes, assembled, stimulus_table
from animat.cultures.safety import Admitted, Guard, Limits
from animat.errors import InvalidArgument
from animat.progress import Progress, Silent
from animat.recordings.protocol import Presentation, Protocol
from animat.recordings.recording import Channels, Recording
from animat.recordings.schedule import Schedule, make_schedule
from animat.recordings.stimulus import Pulse, Stimulus


class Culture(abc.ABC):
    """A culture on an array: open it, stimulate it, record it, let time pass, close it.

    What a user calls is final; it checks, asks the guard, and then calls what a backend implements, whose names begin
    with an underscore. Nothing is delivered but what the guard admitted: `_deliver` takes `Admitted` stimuli, which
    nothing else can make. A culture has a state and a clock of its own; everything takes time on it.

    A backend implements `name`, the data (`channels`, `stimulation_electrodes`, `patterns`, `device_limits`, `now_s`,
    `sampling_rate_hz`, `provenance`) and `_open`, `_deliver`, `_rest`, `_halt` and `_close`; it passes
    `animat.cultures.contract.CultureContract`.

    Args:
        limits: tighter limits than the device's; None: the device's.
    """

    name: ClassVar[str]

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # Wherever it comes from: what stands before Culture among the bases would be called in its place.
        overridden = [name for name in _FINAL if getattr_static(cls, name) is not vars(Culture)[name]]
        if overridden:
            raise TypeError(
                f"{cls.__name__}.{overridden[0]}: final in Culture; implement the methods that begin with _"
            )

    def __init__(self, limits: Limits | None = None) -> None:
        self._asked_limits = limits
        self._guard: Guard | None = None
        # Of all sessions: a rate limit must not be passed by closing and opening again.
        self._history = History()

    # What a backend is: data. Valid once it is open.

    @property
    @abc.abstractmethod
    def channels(self) -> Channels:
        """The recording electrodes."""

    @property
    @abc.abstractmethod
    def stimulation_electrodes(self) -> tuple[int, ...]:
        """The electrodes that can stimulate."""

    @property
    @abc.abstractmethod
    def patterns(self) -> Int64[np.ndarray, "patterns size"]:
        """Electrodes of each stimulation pattern, padded with -1."""

    @property
    @abc.abstractmethod
    def device_limits(self) -> Limits:
        """What the device and the culture stand."""

    @property
    @abc.abstractmethod
    def now_s(self) -> float:
        """The culture's clock; where it can, it goes on while the culture is closed."""

    @property
    @abc.abstractmethod
    def sampling_rate_hz(self) -> float:
        """Of the raw signal that spikes are detected in."""

    @property
    @abc.abstractmethod
    def provenance(self) -> dict[str, str]:
        """What a recording says about where it came from."""

    @property
    def left_out(self) -> dict[str, int]:
        """What the device reported, or should have, and no recording has, counted since `open`, by what it is."""
        return {}

    # What a backend does.

    @abc.abstractmethod
    def _open(self) -> None:
        """Get ready: connect, route, scan."""

    @abc.abstractmethod
    def _deliver(self, admitted: Admitted, duration_s: float) -> Observed:
        """Deliver stimuli at their times after `admitted.now_s`, let `duration_s` pass, and say what was seen."""

    @abc.abstractmethod
    def _rest(self, duration_s: float) -> None:
        """Let time pass unobserved."""

    @abc.abstractmethod
    def _halt(self) -> None:
        """Stop whatever is being delivered, at once; may be called from another thread, and when nothing is."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Leave the device safe and let go of it; also called where `_open` failed half way."""

    # What a user calls.

    @final
    def open(self) -> Self:
        """Get ready, and begin a session: stimuli are counted anew and an emergency stop is lifted.

        What was delivered in the second before is remembered from session to session. Where the last delivery was
        broken off, or the clock began anew, all of its last second counts as delivered just now.

        Raises:
            InvalidArgument: if it is open already, or its limits are looser than the device's.
            DeviceFailed: if it cannot be opened; it is then closed.
        """
        if self._guard is not None:
            raise InvalidArgument("culture: expected a closed one to open, got one that is open")
        if self._asked_limits is not None:
            self._asked_limits.check_within(self.device_limits)
        try:
            with as_device_failure(self.name, "open"):
                self._open()
                self._guard = Guard(self.limits, self.stimulation_electrodes, self._history, self.now_s)
        except BaseException as error:
            self._close_after(error)
            raise
        return self

    @final
    def close(self) -> None:
        """Leave the device safe and let go of it; a closed culture stays closed.

        Raises:
            DeviceFailed: if the device does not say that it is safe; it is closed all the same.
        """
        if self._guard is not None:
            self._guard = None
            with as_device_failure(self.name, "close"):
                self._close()

    @final
    def __enter__(self) -> Self:
        return self.open()

    @final
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        elif self._guard is not None:
            self._guard = None
            self._close_after(error)

    @property
    @final
    def limits(self) -> Limits:
        """The limits in force."""
        return self._asked_limits or self.device_limits

    @property
    @final
    def is_open(self) -> bool:
        """Whether a session is under way."""
        return self._guard is not None

    @property
    @final
    def is_stopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return self._guard is not None and self._guard.is_stopped

    @property
    @final
    def delivered(self) -> int:
        """Stimuli delivered in this session."""
        return self._opened().delivered

    @final
    def stop(self, reason: str = "asked for") -> None:
        """Emergency stop: deliver nothing more until the culture is closed and opened again. Safe from any thread.

        Raises:
            DeviceFailed: if the device does not say that it stopped; whatever is asked for from now on is refused.
        """
        if self._guard is not None:
            self._guard.stop(reason)
        with as_device_failure(self.name, "stop"):
            self._halt()

    @final
    def deliver(self, stimuli: Sequence[Stimulus], duration_s: float, *, since_s: float | None = None) -> Observed:
        """Deliver stimuli within the next `duration_s` and observe all channels meanwhile.

        A living culture's clock goes on while a program decides what to ask for. Who counted times from a reading of it
        hands that over as `since_s`: what has passed since then is taken off, and stimuli come when they are due and
        not later by that. Where the first one's time is past, it comes now and the others as long after it as asked.

        Args:
            stimuli: in the order of time, counted from now, or from `since_s`.
            duration_s: how long, zero or more; all stimuli begin within.
            since_s: a reading of `now_s`; None: now.

        Raises:
            UnsafeStimulus: naming the limit that one of them exceeds; nothing is then delivered, and no time passes.
            InvalidArgument: for a culture that is not open, stimuli outside this stretch of time, or a `since_s` that
                the clock has not come to.
            DeviceFailed: if the device fails meanwhile; whether what was asked for was delivered is then not known.
        """
        guard = self._opened()
        _check_duration("duration_s", duration_s)
        outside = [stimulus for stimulus in stimuli if not stimulus.time_s < duration_s]
        if outside:
            raise InvalidArgument(
                f"stimuli: expected times before the delivery ends ({duration_s:g} s), got {outside[0].time_s:g} s"
            )
        with as_device_failure(self.name, "deliver"):
            now_s = self.now_s
            if since_s is not None and since_s != now_s:
                stimuli, duration_s = _counted_from(now_s, stimuli, duration_s, since_s)
            return self._deliver(guard.admit(stimuli, now_s), duration_s)

    @final
    def advance(self, duration_s: float) -> Spikes:
        """Let time pass without a stimulus; spikes are counted from its start."""
        return self.deliver((), duration_s).spikes

    @final
    def rest(self, duration_s: float) -> None:
        """Let time pass unobserved, in closed form where the culture knows how.

        Raises:
            InvalidArgument: for a culture that is not open, or a negative time.
            DeviceFailed: if the device fails meanwhile.
        """
        self._opened()
        _check_duration("duration_s", duration_s)
        with as_device_failure(self.name, "rest"):
            self._rest(duration_s)

    @final
    def stimulate(
        self, electrodes: Sequence[int], pulse: Pulse, window_ms: tuple[float, float] = (2.0, 10.0)
    ) -> Spikes:
        """Deliver one pulse now and return the spikes of a window after it; time passes to the window's end.

        Args:
            electrodes: that are pulsed together.
            pulse: what each delivers.
            window_ms: start and end of the window after the pulse.

        Returns:
            Spikes with start <= time < end, counted from the pulse.

        Raises:
            UnsafeStimulus, InvalidArgument, DeviceFailed: as `deliver` does.
        """
        start_ms, end_ms = window_ms
        if not 0 <= start_ms < end_ms < float("inf"):
            raise InvalidArgument(f"window_ms: expected a start from 0 and an end after it, got {window_ms}")
        observed = self.deliver([Stimulus(0.0, tuple(electrodes), pulse)], end_ms * 1e-3)
        since_s = observed.spikes.time_s - observed.stimulus_time_s[0]
        # Spikes lie on samples: half a nanosecond off an edge is on it.
        inside = (since_s >= start_ms * 1e-3 - 5e-10) & (since_s < end_ms * 1e-3 - 5e-10)
        return Spikes(since_s[inside], observed.spikes.channel[inside])

    @final
    def present(
        self, stimuli: Sequence[Stimulus], *, until_ms: float = 10.0, presentation: Presentation | None = None
    ) -> Recording:
        """Deliver the stimuli of a presentation and record up to `until_ms` after the last one.

        For trying out by hand: the short recording is read by the same extraction of responses as any other. A closed
        loop calls `deliver`, and its session is one recording.

        Args:
            stimuli: at least one, in the order of time, counted from now.
            until_ms: the end of the response window.
            presentation: how it is presented.

        Raises:
            UnsafeStimulus, InvalidArgument, DeviceFailed: as `deliver` does.
        """
        if not stimuli:
            raise InvalidArgument("stimuli: expected at least one in a presentation, got none")
        start_min = self.now_s / 60
        observed = self.deliver(stimuli, stimuli[-1].time_s + until_ms * 1e-3)
        return Recording(
            spike_times_s=observed.spikes.time_s,
            spike_channels=observed.spikes.channel,
            channels=self.channels,
            stimuli=stimulus_table(stimuli, observed.stimulus_time_s),
            sampling_rate_hz=self.sampling_rate_hz,
            start_s=0.0,
            duration_s=observed.duration_s,
            start_min=start_min,
            presentation=presentation,
        )

    @final
    def schedule(self, protocol: Protocol, seed: int = 0) -> Schedule:
        """The stimuli that `record` would deliver."""
        return make_schedule(protocol, self.patterns, seed)

    @final
    def record(self, protocol: Protocol, seed: int = 0, progress: Progress | None = None) -> Recording:
        """Stimulate by a protocol and record.

        The whole schedule is checked before anything is delivered. Set-up times pass unobserved and are left out of the
        recording's clock, block following block.

        Args:
            protocol: what to do; it is kept in the recording's provenance, as JSON.
            seed: decides the order of frequencies and patterns.
            progress: told after each block.

        Raises:
            UnsafeStimulus, InvalidArgument, DeviceFailed: as `deliver` does.
        """
        schedule = self.schedule(protocol, seed)
        progress = progress or Silent()
        provenance = {**self.provenance, "protocol": protocol.to_json(), "protocol_seed": str(seed)}
        self._rehearse(schedule)
        before = self.left_out
        start_min = self.now_s / 60
        observed = []
        for number, block in enumerate(schedule.blocks):
            self.rest(block.setup_s)
            observed.append(self.deliver(schedule.deliveries(block), block.duration_s))
            progress.update(number + 1, len(schedule.blocks))
        if more := more_left_out(before, self.left_out):
            provenance["left_out"] = ", ".join(f"{count} {what}" for what, count in more.items())
        return assembled(
            schedule,
            observed,
            channels=self.channels,
            sampling_rate_hz=self.sampling_rate_hz,
            start_min=start_min,
            provenance=provenance,
        )

    def _close_after(self, error: BaseException) -> None:
        """Close because of an error, which goes on; that closing failed too is a note of it."""
        try:
            with as_device_failure(self.name, "close"):
                self._close()
        except Exception as failed:
            error.add_note(f"and then: {failed}")

    def _rehearse(self, schedule: Schedule) -> None:
        """Put the whole schedule before the guard, blocks at their times, delivering nothing."""
        guard, offset_s, stimuli = self._opened(), 0.0, []
        for block in schedule.blocks:
            offset_s += block.setup_s
            for stimulus in schedule.deliveries(block):
                stimuli.append(Stimulus(offset_s + stimulus.time_s, stimulus.electrodes, stimulus.pulse))
            offset_s += block.duration_s
        guard.check(stimuli, self.now_s)

    def _opened(self) -> Guard:
        if self._guard is None:
            raise InvalidArgument("culture: expected an open one, got a closed one: use it as `with culture:`")
        return self._guard


def more_left_out(before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, int]:
    """What was left out between two times, where it was anything."""
    more = {what: count - before.get(what, 0) for what, count in after.items()}
    return {what: count for what, count in more.items() if count}


_FINAL = tuple(
    name
    for name, member in vars(Culture).items()
    if getattr(member.fget if isinstance(member, property) else member, "__final__", False)
)


def _check_duration(name: str, duration_s: float) -> None:
    if not 0 <= duration_s < float("inf"):
        raise InvalidArgument(f"{name}: expected finite seconds from 0, got {duration_s}")


def _counted_from(
    now_s: float, stimuli: Sequence[Stimulus], duration_s: float, since_s: float
) -> tuple[list[Stimulus], float]:
    """Stimuli and a duration that were counted from a time before, counted from now; what is past begins now."""
    if not since_s <= now_s:
        raise InvalidArgument(f"since_s: expected a reading of the clock, which is at {now_s:g} s, got {since_s}")
    # All by as much, so that times between stimuli are as they were asked for. What is before 0 is for the guard.
    passed_s = min(now_s - since_s, max(0.0, stimuli[0].time_s) if stimuli else duration_s)
    return [replace(each, time_s=each.time_s - passed_s) for each in stimuli], duration_s - passed_s
