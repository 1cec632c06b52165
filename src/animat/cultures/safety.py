"""The guard that every stimulus passes before it is delivered to a culture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import isfinite
from typing import Final, NoReturn

from animat.cultures.history import NS, Event, History
from animat.cultures.limits import SIMULATED_LIMITS, Limits, delivered_pulse, is_multiple, plain_limits, sign_of
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.stimulation.plain import seconds
from animat.stimulation.pulse import Pulse
from animat.stimulation.stimulus import Stimulus, plain_stimuli

__all__ = ["SIMULATED_LIMITS", "Admitted", "Guard", "Limits"]

_MAY_ADMIT: Final = object()
_REMEMBERED_PULSES = 1000


class Admitted:
    """Stimuli that passed a guard: the only thing a backend is given to deliver, and only a guard makes them.

    Attributes:
        stimuli: in the order of time, counted from `now_s`.
        now_s: the culture's clock when they were admitted; a clock that runs is past that when a backend sees them.
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
        raise InvalidArgument(f"Admitted.{name}: expected to stay as it was admitted; ask for other stimuli")

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InvalidArgument("Admitted: expected to be delivered once, where it was admitted; it cannot be copied")


class Guard:
    """Checks every stimulus of one session against limits, remembering what was delivered before.

    A request passes as a whole or not at all. Times are compared in whole nanoseconds, so that pulses exactly a second
    apart are a second apart. One thread at a time may use it, but for `stop`.

    Args:
        limits: what may be delivered.
        sites: electrodes that can stimulate.
        history: of the sessions before on the same culture: limits on pace look back on it too. None: there were none.
        now_s: the culture's clock, where there is a history.
    """

    def __init__(
        self, limits: Limits, sites: Iterable[int], history: History | None = None, now_s: float = 0.0
    ) -> None:
        self.limits = plain_limits(limits)
        self._sites = frozenset(sites)
        self._safe_pulses: dict[Pulse, float] = {}
        self._left_on: dict[int, float] = {}
        self._stopped: str | None = None
        self._delivered = 0
        self._history = History()
        if history is not None:
            self._history = history
            history.go_on(round(now_s * NS))

    @property
    def delivered(self) -> int:
        """Stimuli that were admitted in this session."""
        return self._delivered

    @property
    def stopped(self) -> str | None:
        """Why nothing more may be delivered; None: it may."""
        return self._stopped

    def stop(self, reason: str) -> None:
        """Refuse everything from now on, for the first reason given; a new session has a guard of its own."""
        self._stopped = reason if self._stopped is None else self._stopped

    def check(self, stimuli: Iterable[Stimulus], now_s: float) -> None:
        """Raise unless the request as a whole is within the limits; nothing is remembered.

        Args:
            stimuli: in the order of time, counted from now.
            now_s: the culture's clock, float64.

        Raises:
            UnsafeStimulus: naming the limit, the value, and what to do.
            InvalidArgument: for what is no stimulus, or a clock that is less precise.
        """
        self._examine(plain_stimuli(stimuli), seconds("now_s", now_s))

    def admit(self, stimuli: Iterable[Stimulus], now_s: float) -> Admitted:
        """Check a request and remember it as delivered.

        Raises:
            UnsafeStimulus, InvalidArgument: as `check` does; nothing is then remembered.
        """
        now_s = seconds("now_s", now_s)
        # What was checked is what is delivered: a tuple of its own, of values that cannot change.
        admitted = Admitted(plain_stimuli(stimuli), now_s, by=_MAY_ADMIT)
        events, left_on = self._examine(admitted.stimuli, now_s)
        self._history.add(events, round(now_s * NS))
        self._left_on |= left_on
        self._delivered += len(events)
        return admitted

    def expect_not_stopped(self) -> None:
        """Refuse what goes on after an emergency stop (UnsafeStimulus)."""
        if self._stopped is not None:
            raise UnsafeStimulus("stopped", f"an emergency stop is in force ({self._stopped}): close and open again")

    def _examine(self, stimuli: Sequence[Stimulus], now_s: float) -> tuple[list[Event], dict[int, float]]:
        """What the stimuli are on the culture's clock, and the charge that is left on electrodes after them."""
        limits = self.limits
        if not stimuli:
            return [], {}
        if not isfinite(now_s):
            raise InvalidArgument(f"now_s: expected a finite time on the culture's clock, got {now_s}")
        self.expect_not_stopped()
        if self._delivered + len(stimuli) > limits.stimuli_per_session:
            raise UnsafeStimulus(
                "stimuli_per_session",
                f"expected at most {limits.stimuli_per_session} stimuli in a session, got {len(stimuli)} more after "
                f"{self._delivered}: ask for fewer, or begin a new session after a rest",
            )
        events: list[Event] = []
        left_on: dict[int, float] = {}
        # What was asked for so far goes into a history of its own: a request that fails must leave no trace.
        asked, busy_until_ns = History(), self._history.busy_until_ns
        for stimulus in stimuli:
            if net_charge := self._check_one(stimulus):
                self._add_charge(left_on, stimulus.electrodes, net_charge)
            if not (isfinite(stimulus.time_s) and stimulus.time_s >= 0):
                raise UnsafeStimulus("overlap", f"expected finite times from 0 s on, got {stimulus.time_s}")
            start_ns = round((now_s + stimulus.time_s) * NS)
            if start_ns < busy_until_ns:
                raise UnsafeStimulus(
                    "overlap",
                    f"expected each stimulus to begin after the one before has ended, got one {stimulus.time_s:g} s "
                    f"from now, {(busy_until_ns - start_ns) / 1000:g} us too early: put them in the order of time, "
                    "further apart",
                )
            if start_ns < busy_until_ns + round(limits.gap_us * 1000):
                raise UnsafeStimulus(
                    "gap_us",
                    f"expected {limits.gap_us:g} us or more from the end of a stimulus to the start of the next, got "
                    f"{(start_ns - busy_until_ns) / 1000:g}: put them further apart",
                )
            event = Event(start_ns, start_ns + round(stimulus.pulse.duration_us * 1000), stimulus.electrodes)
            self._check_pace(event, asked)
            asked.add([event], start_ns)
            busy_until_ns = event.end_ns
            events.append(event)
        return events, left_on

    def _check_one(self, stimulus: Stimulus) -> float:
        """The limits that hold for a stimulus by itself; returns what its pulse leaves on an electrode."""
        limits, electrodes = self.limits, stimulus.electrodes
        if not 1 <= len(electrodes) <= limits.electrodes_at_once:
            raise UnsafeStimulus(
                "electrodes_at_once", f"expected 1 to {limits.electrodes_at_once} electrodes, got {len(electrodes)}"
            )
        if len(set(electrodes)) < len(electrodes):
            raise UnsafeStimulus("sites", f"expected each electrode once in a stimulus, got {electrodes}")
        strange = [electrode for electrode in electrodes if electrode not in self._sites]
        if strange:
            raise UnsafeStimulus(
                "sites",
                f"expected stimulation sites of this culture, got electrode {strange[0]}: choose among them",
            )
        net_charge = self._safe_pulses.get(stimulus.pulse)
        if net_charge is None:
            net_charge = self.check_pulse(stimulus.pulse)
            if len(self._safe_pulses) >= _REMEMBERED_PULSES:
                self._safe_pulses.clear()
            self._safe_pulses[stimulus.pulse] = net_charge
        return net_charge

    def _add_charge(self, left_on: dict[int, float], electrodes: Sequence[int], net_charge: float) -> None:
        """Add what a pulse leaves to what all before it left, on each electrode."""
        most = self.limits.net_charge_per_session
        for electrode in electrodes:
            left = left_on.get(electrode)
            left_on[electrode] = left = (self._left_on.get(electrode, 0.0) if left is None else left) + net_charge
            if not abs(left) <= most:
                raise UnsafeStimulus(
                    "net_charge_per_session",
                    f"expected pulses of a session that leave -{most:g} to {most:g} {self.limits.units[1]} on an "
                    f"electrode, got {left:g} on electrode {electrode}: use a balanced pulse, or begin a new session "
                    "after a rest",
                )

    def check_pulse(self, pulse: Pulse) -> float:
        """The charge that a pulse leaves over; raises UnsafeStimulus unless it is within the limits.

        Both as it is asked for and as the device rounds it.
        """
        limits = self.limits
        if pulse.kind != limits.kind:
            raise UnsafeStimulus("kind", f"expected {limits.kind} pulses, got a {pulse.kind} pulse ({pulse})")
        if len(pulse.phases) > limits.phases_per_pulse:
            raise UnsafeStimulus(
                "phases_per_pulse",
                f"expected at most {limits.phases_per_pulse} phases in a pulse, got {len(pulse.phases)} ({pulse})",
            )
        for phase in pulse.phases:
            shortest, longest = limits.phase_us
            if not shortest <= phase.duration_us <= longest:
                raise UnsafeStimulus(
                    "phase_us", f"expected phases of {shortest:g} to {longest:g} us, got {phase.duration_us:g}"
                )
            if not is_multiple(phase.duration_us, limits.phase_step_us):
                raise UnsafeStimulus(
                    "phase_step_us",
                    f"expected phases in steps of {limits.phase_step_us:g} us, got {phase.duration_us:g}: round it",
                )
        self._check_shape(pulse, "")
        made = delivered_pulse(pulse, limits.amplitude_step)
        is_rounded = "" if made == pulse else f", which the device makes of {pulse}"
        if is_rounded:
            self._check_shape(made, is_rounded)
        self._check_charge(made, is_rounded)
        return made.net_charge

    def _check_shape(self, pulse: Pulse, is_rounded: str) -> None:
        """The limits on amplitudes and signs."""
        limits = self.limits
        for phase in pulse.phases:
            if not abs(phase.amplitude) <= limits.amplitude:
                raise UnsafeStimulus(
                    "amplitude",
                    f"expected -{limits.amplitude:g} to {limits.amplitude:g} {limits.units[0]}, got {phase.amplitude:g}"
                    f"{is_rounded}: lower it",
                )
        if limits.alternates:
            for before, after in pairwise(pulse.phases):
                if sign_of(before.amplitude) == sign_of(after.amplitude):
                    raise UnsafeStimulus(
                        "alternates", f"expected neighbouring phases of different signs, got {pulse}{is_rounded}"
                    )

    def _check_charge(self, pulse: Pulse, is_rounded: str) -> None:
        """The limits on charge."""
        limits, charge_unit = self.limits, self.limits.units[1]
        for phase in pulse.phases:
            if not abs(phase.charge) <= limits.charge_per_phase:
                raise UnsafeStimulus(
                    "charge_per_phase",
                    f"expected -{limits.charge_per_phase:g} to {limits.charge_per_phase:g} {charge_unit} a phase, got "
                    f"{phase.charge:g}{is_rounded}: lower the amplitude or shorten the phase",
                )
        if not abs(pulse.net_charge) <= limits.net_charge:
            raise UnsafeStimulus(
                "net_charge",
                f"expected phases that balance to within {limits.net_charge:g} {charge_unit}, got {pulse.net_charge:g} "
                f"({pulse}{is_rounded}): give the phases equal and opposite charge",
            )

    def _check_pace(self, event: Event, asked: History) -> None:
        """The limits that hold for a stimulus after those delivered and those `asked` for before it."""
        limits, start_ns = self.limits, event.start_ns
        count = 1 + self._history.in_second_to(start_ns) + asked.in_second_to(start_ns)
        if count > limits.stimuli_per_s:
            raise UnsafeStimulus(
                "stimuli_per_s",
                f"expected at most {limits.stimuli_per_s} stimuli in any second, got {count}: slow down",
            )
        for electrode in event.electrodes:
            last_ns = asked.last_on(electrode)
            last_ns = self._history.last_on(electrode) if last_ns is None else last_ns
            if last_ns is not None and start_ns - last_ns < round(limits.interval_us * 1000):
                raise UnsafeStimulus(
                    "interval_us",
                    f"expected {limits.interval_us:g} us or more from stimulus to stimulus on an electrode, got "
                    f"{(start_ns - last_ns) / 1000:g} on electrode {electrode}: slow down",
                )
            count = 1 + self._history.in_second_to(start_ns, electrode) + asked.in_second_to(start_ns, electrode)
            if count > limits.stimuli_per_electrode_s:
                raise UnsafeStimulus(
                    "stimuli_per_electrode_s",
                    f"expected at most {limits.stimuli_per_electrode_s} stimuli on an electrode in any second, got "
                    f"{count} on electrode {electrode}: slow down, or use more patterns",
                )
