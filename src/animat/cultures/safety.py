"""The guard that every stimulus passes before it is delivered to a culture, and its memory of earlier ones."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import lru_cache
from math import isfinite
from typing import Final, NamedTuple, NoReturn

from animat.cultures.limits import SIMULATED_LIMITS, Limits, plain_limits
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.stimulation.plain import seconds
from animat.stimulation.stimulus import Stimulus, plain_stimuli

__all__ = ["SIMULATED_LIMITS", "Admitted", "Guard", "Limits"]

NS = 1_000_000_000
_MAY_ADMIT: Final = object()
_PACE = frozenset({"overlap", "gap_us", "interval_us", "stimuli_per_electrode_s", "stimuli_per_s"})
_DELAY_STEP_S = 0.001
_PATIENCE_S = 2.0
"""Rates cover a second: what does not fit after two is not due to a late start."""


class Admitted:
    """Stimuli that passed a guard. A backend delivers nothing else, and only a guard makes them.

    Attributes:
        stimuli: in order of time, counted from `now_s`.
        now_s: the culture's clock when they were admitted; a running clock is later when the backend gets them.
    """

    __slots__ = ("now_s", "stimuli")
    stimuli: tuple[Stimulus, ...]
    now_s: float

    def __init__(self, stimuli: tuple[Stimulus, ...], now_s: float, *, by: object) -> None:
        if by is not _MAY_ADMIT:
            raise InvalidArgument("Admitted: expected to be made by a Guard, which checks stimuli; use Culture.deliver")
        object.__setattr__(self, "stimuli", stimuli)
        object.__setattr__(self, "now_s", now_s)

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise InvalidArgument(f"Admitted.{name}: expected to stay unchanged after admission; request other stimuli")

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InvalidArgument("Admitted: expected to be delivered once, by the culture that admitted it, got a copy")


class Event(NamedTuple):
    """A stimulus on the culture's clock."""

    start_ns: int
    end_ns: int
    electrodes: tuple[int, ...]


class History:
    """The stimuli of the last second, and the last one on each electrode, in whole nanoseconds of the culture's clock.

    Starts are in order of time. A guard consults it and adds what it admits. Reopening a culture continues the same
    history, because a living culture does not forget its stimuli when a program closes it.
    """

    def __init__(self) -> None:
        # Of pulses on each electrode; the key None has those of all electrodes.
        self._starts_on: dict[int | None, list[int]] = defaultdict(list)
        self._seen_ns = 0
        self.busy_until_ns = -(2**63)
        """When the last stimulus ends; before any, too long ago for every gap."""

    def in_second_to(self, time_ns: int, electrode: int | None = None) -> int:
        """How many stimuli, on one electrode or on any, began in the second before a time not before the last."""
        starts = self._starts_on.get(electrode, ())
        return len(starts) - bisect_right(starts, time_ns - NS)

    def last_on(self, electrode: int | None) -> int | None:
        """When the last stimulus on an electrode (None: on any) began; None if there was none."""
        starts = self._starts_on.get(electrode)
        return starts[-1] if starts else None

    def add(self, events: Sequence[Event], now_ns: int) -> None:
        """Add stimuli in order of time, and forget those more than a second old."""
        self._seen_ns = now_ns
        for start_ns, end_ns, electrodes in events:
            for electrode in (None, *electrodes):
                starts = self._starts_on[electrode]
                del starts[: bisect_right(starts, now_ns - NS)]
                starts.append(start_ns)
            self.busy_until_ns = end_ns

    def delay_last(self, electrodes: Sequence[int], by_ns: int) -> None:
        """Count the last stimulus, which was on these electrodes, as begun this much later."""
        for electrode in (None, *electrodes):
            self._starts_on[electrode][-1] += by_ns
        self.busy_until_ns += by_ns

    def resume(self, now_ns: int) -> None:
        """Continue in a new session whose clock is at `now_ns`.

        A clock behind its last reading was restarted: no time is assumed to have passed. Stimuli admitted for later
        than now were interrupted; it is not known how many were delivered, so all count as if they had begun just now.
        Either way stimuli may seem more recent than they were, never less recent.
        """
        behind_ns = max(0, self._seen_ns - now_ns)
        self._seen_ns = now_ns
        before_ns = self.last_on(None)
        for starts in self._starts_on.values():
            starts[:] = [min(start_ns - behind_ns, now_ns) for start_ns in starts]
        if before_ns is not None:
            self.busy_until_ns += self._starts_on[None][-1] - before_ns


class Guard:
    """Checks every stimulus of one session against limits, and remembers what was delivered before.

    A request passes as a whole or not at all. Times are compared in whole nanoseconds, so pulses meant to be exactly a
    second apart are. Only one thread at a time may use it, except for `stop`.

    Args:
        sites: electrodes that can stimulate.
        history: of earlier sessions, which limits on pace also cover; None: there were none.
        now_s: the culture's clock, if there is a history.
    """

    def __init__(
        self, limits: Limits, sites: Iterable[int], history: History | None = None, now_s: float = 0.0
    ) -> None:
        self.limits = plain_limits(limits)
        self._sites = frozenset(sites)
        self._net_charge_of = lru_cache(1000)(self.limits.check_pulse)
        self._left_on: dict[int, float] = {}
        self.stopped: str | None = None
        """Why nothing more may be delivered; None: delivery is allowed."""
        self.delivered = 0
        """Number of stimuli admitted in this session."""
        self._history = History() if history is None else history
        self._history.resume(round(now_s * NS))

    def stop(self, reason: str) -> None:
        """Refuse everything from now on; the first reason passed counts."""
        self.stopped = reason if self.stopped is None else self.stopped

    def check(self, stimuli: Iterable[Stimulus], now_s: float) -> None:
        """Raise unless a request as a whole is within the limits; nothing is remembered.

        Times ascend and count from `now_s` on the culture's clock, a float64. Raises UnsafeStimulus, naming the limit,
        the value, and what to do, and InvalidArgument for anything that is not a stimulus or a time.
        """
        self._examine(plain_stimuli(stimuli), seconds("now_s", now_s))

    def admit(self, stimuli: Iterable[Stimulus], now_s: float) -> Admitted:
        """Check a request, raising as `check` does, and remember it as delivered."""
        now_s = seconds("now_s", now_s)
        # A new tuple of immutable values: what was checked is what is delivered.
        admitted = Admitted(plain_stimuli(stimuli), now_s, by=_MAY_ADMIT)
        events, left_on = self._examine(admitted.stimuli, now_s)
        self._history.add(events, round(now_s * NS))
        self._left_on |= left_on
        self.delivered += len(events)
        return admitted

    def earliest(self, stimuli: Sequence[Stimulus], from_s: float) -> float:
        """The earliest time from `from_s` on at which stimuli may begin without breaking a limit on pace.

        For a second guard, on the device's own clock: a request that begins late comes closer to the next one than
        intended, so two that each keep a limit may break it together. Times count from the first stimulus. Raises
        UnsafeStimulus for stimuli that no delay makes safe.
        """
        waited_s = 0.0
        while True:
            try:
                self.check(stimuli, from_s + waited_s)
            except UnsafeStimulus as error:
                if error.limit not in _PACE or waited_s >= _PATIENCE_S:
                    raise
                waited_s += _DELAY_STEP_S
            else:
                return from_s + waited_s

    def delay_last(self, stimulus: Stimulus, by_s: float) -> None:
        """Note that the stimulus admitted last may have come later than it was admitted for."""
        self._history.delay_last(stimulus.electrodes, round(by_s * NS))

    def interrupt(self, now_s: float) -> None:
        """Note that a delivery has ended at `now_s`: what it had not delivered counts as delivered just now."""
        self._history.resume(round(now_s * NS))

    def expect_not_stopped(self) -> None:
        """Raise UnsafeStimulus after an emergency stop."""
        if self.stopped is not None:
            raise UnsafeStimulus("stopped", f"an emergency stop is in force ({self.stopped}): close and open again")

    def _examine(self, stimuli: Sequence[Stimulus], now_s: float) -> tuple[list[Event], dict[int, float]]:
        """The stimuli on the culture's clock, and the net charge on each electrode after them."""
        limits = self.limits
        if not stimuli:
            return [], {}
        if not isfinite(now_s):
            raise InvalidArgument(f"now_s: expected a finite time on the culture's clock, got {now_s}")
        self.expect_not_stopped()
        if self.delivered + len(stimuli) > limits.stimuli_per_session:
            got = f"{len(stimuli)} more after {self.delivered}: request fewer, or begin a new session after a rest"
            expected = f"expected at most {limits.stimuli_per_session} stimuli in a session"
            raise UnsafeStimulus("stimuli_per_session", f"{expected}, got {got}")
        events: list[Event] = []
        left_on: dict[int, float] = {}
        # Stimuli requested so far go into a separate history: a request that fails must leave no trace.
        requested, busy_until_ns = History(), self._history.busy_until_ns
        for stimulus in stimuli:
            if net_charge := self._check_one(stimulus):
                self._add_charge(left_on, stimulus.electrodes, net_charge)
            if not (isfinite(stimulus.time_s) and stimulus.time_s >= 0):
                raise UnsafeStimulus("overlap", f"expected finite times from 0 s on, got {stimulus.time_s}")
            start_ns = round((now_s + stimulus.time_s) * NS)
            if start_ns < busy_until_ns:
                early = f"{stimulus.time_s:g} s from now, {(busy_until_ns - start_ns) / 1000:g} us too early"
                expected = "expected each stimulus to begin after the previous one ends"
                raise UnsafeStimulus("overlap", f"{expected}, got one {early}: put them in order, further apart")
            if start_ns < busy_until_ns + round(limits.gap_us * 1000):
                got = f"{(start_ns - busy_until_ns) / 1000:g}: put them further apart"
                expected = f"{limits.gap_us:g} us or more from the end of a stimulus to the start of the next"
                raise UnsafeStimulus("gap_us", f"expected {expected}, got {got}")
            event = Event(start_ns, start_ns + round(stimulus.pulse.duration_us * 1000), stimulus.electrodes)
            self._check_pace(event, requested)
            requested.add([event], start_ns)
            busy_until_ns = event.end_ns
            events.append(event)
        return events, left_on

    def _check_one(self, stimulus: Stimulus) -> float:
        """Check the limits on a single stimulus; returns the net charge that its pulse leaves on an electrode."""
        limits, electrodes = self.limits, stimulus.electrodes
        if not 1 <= len(electrodes) <= limits.electrodes_at_once:
            most = limits.electrodes_at_once
            raise UnsafeStimulus("electrodes_at_once", f"expected 1 to {most} electrodes, got {len(electrodes)}")
        if len(set(electrodes)) < len(electrodes):
            raise UnsafeStimulus("sites", f"expected each electrode once in a stimulus, got {electrodes}")
        if strange := [electrode for electrode in electrodes if electrode not in self._sites]:
            raise UnsafeStimulus("sites", f"expected sites that stimulate this culture, got electrode {strange[0]}")
        return self._net_charge_of(stimulus.pulse)

    def _add_charge(self, left_on: dict[int, float], electrodes: Sequence[int], net_charge: float) -> None:
        """Add the net charge of a pulse to that of all before it, on each electrode."""
        most = self.limits.net_charge_per_session
        for electrode in electrodes:
            left = left_on.get(electrode, self._left_on.get(electrode, 0.0)) + net_charge
            left_on[electrode] = left
            if not abs(left) <= most:
                expected = f"pulses that leave -{most:g} to {most:g} {self.limits.units[1]} on an electrode"
                got = f"{left:g} on electrode {electrode}: use a balanced pulse, or a new session after a rest"
                raise UnsafeStimulus("net_charge_per_session", f"expected {expected}, got {got}")

    def _check_pace(self, event: Event, requested: History) -> None:
        """Check the limits on pace, after stimuli delivered and those `requested` before it."""
        limits, start_ns = self.limits, event.start_ns
        count = 1 + self._history.in_second_to(start_ns) + requested.in_second_to(start_ns)
        if count > limits.stimuli_per_s:
            expected = f"at most {limits.stimuli_per_s} stimuli in any second"
            raise UnsafeStimulus("stimuli_per_s", f"expected {expected}, got {count}: slow down")
        for electrode in event.electrodes:
            last_ns = requested.last_on(electrode)
            last_ns = self._history.last_on(electrode) if last_ns is None else last_ns
            if last_ns is not None and start_ns - last_ns < round(limits.interval_us * 1000):
                got = f"{(start_ns - last_ns) / 1000:g} on electrode {electrode}: slow down"
                expected = f"{limits.interval_us:g} us or more between stimulus starts on an electrode"
                raise UnsafeStimulus("interval_us", f"expected {expected}, got {got}")
            count = 1 + sum(history.in_second_to(start_ns, electrode) for history in (self._history, requested))
            if count > limits.stimuli_per_electrode_s:
                got = f"{count} on electrode {electrode}: slow down, or use more patterns"
                expected = f"at most {limits.stimuli_per_electrode_s} stimuli on an electrode in any second"
                raise UnsafeStimulus("stimuli_per_electrode_s", f"expected {expected}, got {got}")
