"""What may be delivered to a culture: limits as data, and the guard that every stimulus passes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from math import floor, isfinite
from typing import Final

from animat.cultures.history import NS, Event, History
from animat.errors import InvalidArgument, UnsafeStimulus
from animat.recordings.stimulus import Kind, Phase, Pulse, Stimulus

_MAY_ADMIT: Final = object()
_REMEMBERED_PULSES = 1000


@dataclass(frozen=True)
class Limits:
    """What a culture and its device stand. Amplitudes are in mV and charges in mV ms where `kind` is `"voltage"`, in uA
    and nC where it is `"current"` (see `Phase.charge`).

    Attributes:
        kind: what the device holds during a phase.
        amplitude: largest magnitude of a phase.
        phase_us: shortest and longest phase.
        charge_per_phase: largest magnitude of a phase's charge.
        net_charge: largest magnitude of the sum of a pulse's charges: what balance leaves over.
        electrodes_at_once: most electrodes of one stimulus.
        stimuli_per_electrode_s: most stimuli on one electrode in any second.
        stimuli_per_s: most stimuli, on whatever electrodes, in any second.
        stimuli_per_session: most stimuli from `open` to `close`.
        phases_per_pulse: most phases of a pulse.
        alternates: whether phases that follow each other must differ in sign.
        phase_step_us: phases last whole multiples of it; 0: any time.
        amplitude_step: what the device rounds amplitudes to, 0 where it does not: the charges of the *rounded* phases
            are what `charge_per_phase` and `net_charge` hold for. It is the device's, whatever is asked for.
        interval_us: least time from the start of a stimulus to the start of the next one on the same electrode.
        gap_us: least time from the end of a stimulus to the start of the next one, on whatever electrodes.

    Raises:
        InvalidArgument: for a limit that is no number or below 0.
    """

    kind: Kind
    amplitude: float
    phase_us: tuple[float, float]
    charge_per_phase: float
    net_charge: float
    electrodes_at_once: int
    stimuli_per_electrode_s: int
    stimuli_per_s: int
    stimuli_per_session: int
    phases_per_pulse: int = 1000
    alternates: bool = False
    phase_step_us: float = 0.0
    amplitude_step: float = 0.0
    interval_us: float = 0.0
    gap_us: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("voltage", "current"):
            raise InvalidArgument(f"kind: expected 'voltage' or 'current', got {self.kind!r}")
        shortest, longest = self.phase_us
        if not (0 < shortest <= longest and isfinite(longest)):
            raise InvalidArgument(f"phase_us: expected (shortest, longest), above 0 and finite, got {self.phase_us}")
        for name in (*_NUMBERS, *_LEAST, "phase_step_us", "amplitude_step"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InvalidArgument(f"{name}: expected a finite number from 0, got {getattr(self, name)}")

    @property
    def units(self) -> tuple[str, str]:
        """Of amplitude and of charge."""
        return ("mV", "mV ms") if self.kind == "voltage" else ("uA", "nC")

    def check_within(self, device: Limits) -> None:
        """Raise unless these limits are as tight as the device's or tighter.

        Raises:
            InvalidArgument: naming the limit that is looser.
        """
        if self.kind != device.kind:
            raise InvalidArgument(f"limits.kind: expected {device.kind!r}, the device's, got {self.kind!r}")
        looser = [name for name in _NUMBERS if getattr(self, name) > getattr(device, name)]
        if self.phase_us[0] < device.phase_us[0] or self.phase_us[1] > device.phase_us[1]:
            looser.append("phase_us")
        looser += [name for name in _LEAST if getattr(self, name) < getattr(device, name)]
        looser += ["alternates"] * (device.alternates and not self.alternates)
        looser += ["phase_step_us"] * (not _is_multiple(self.phase_step_us, device.phase_step_us))
        if looser:
            raise InvalidArgument(
                f"limits.{looser[0]}: expected no looser than the device's {getattr(device, looser[0])}, got "
                f"{getattr(self, looser[0])}: limits can be tightened, never loosened"
            )


_LEAST = ("interval_us", "gap_us")
_NUMBERS = tuple(
    each.name
    for each in fields(Limits)
    if each.name not in ("kind", "phase_us", "alternates", "phase_step_us", "amplitude_step", *_LEAST)
)


def _is_multiple(value: float, step: float) -> bool:
    """Whether a value is a whole multiple of a step, above 0; of step 0 everything is."""
    return step == 0 or (value > 0 and abs(value / step - round(value / step)) < 1e-9)


SIMULATED_LIMITS = Limits(
    kind="voltage",
    amplitude=400.0,
    phase_us=(50.0, 1000.0),
    charge_per_phase=200.0,
    net_charge=25.0,
    electrodes_at_once=32,
    stimuli_per_electrode_s=100,
    stimuli_per_s=200,
    stimuli_per_session=10_000_000,
)
"""A simulation comes to no harm, so these are wide. `net_charge` lets even the paper's pulse pass, which as printed
leaves 20 mV ms over; the limits of a living culture must not."""


def delivered_pulse(pulse: Pulse, amplitude_step: float) -> Pulse:
    """A pulse as a device delivers it that rounds amplitudes to whole steps, half away from 0; step 0: as it is."""
    if amplitude_step == 0:
        return pulse
    rounded = [steps_of(phase.amplitude, amplitude_step) * amplitude_step for phase in pulse.phases]
    if pulse.kind == "voltage":
        return Pulse(tuple(Phase(p.duration_us, amplitude_mv=a) for p, a in zip(pulse.phases, rounded, strict=True)))
    return Pulse(tuple(Phase(p.duration_us, amplitude_ua=a) for p, a in zip(pulse.phases, rounded, strict=True)))


def steps_of(amplitude: float, amplitude_step: float) -> int:
    """An amplitude in whole steps, half away from 0: opposite amplitudes stay opposite."""
    return _sign(amplitude) * floor(abs(amplitude) / amplitude_step + 0.5)


def _sign(amplitude: float) -> int:
    return (amplitude > 0) - (amplitude < 0)


class Admitted:
    """Stimuli that passed a guard: the only thing a backend is given to deliver, and only a guard makes them.

    Attributes:
        stimuli: in the order of time, counted from `now_s`.
        now_s: the culture's clock when they were admitted; a clock that runs is past that when a backend sees them.
    """

    __slots__ = ("now_s", "stimuli")

    def __init__(self, stimuli: Sequence[Stimulus], now_s: float, *, by: object) -> None:
        if by is not _MAY_ADMIT:
            raise InvalidArgument("Admitted: expected to be made by a Guard, which checks stimuli; use Culture.deliver")
        self.stimuli, self.now_s = tuple(stimuli), now_s


class Guard:
    """Checks every stimulus of one session against limits, remembering what was delivered before.

    A request passes as a whole or not at all. Times are compared in whole nanoseconds, so that pulses exactly a second
    apart are a second apart.

    Args:
        limits: what may be delivered.
        sites: electrodes that can stimulate.
        history: of the sessions before on the same culture: limits on pace look back on it too. None: there were none.
        now_s: the culture's clock, where there is a history.
    """

    def __init__(
        self, limits: Limits, sites: Iterable[int], history: History | None = None, now_s: float = 0.0
    ) -> None:
        self.limits = limits
        self._sites = frozenset(sites)
        self._safe_pulses: dict[Pulse, None] = {}
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
    def is_stopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return self._stopped is not None

    def stop(self, reason: str) -> None:
        """Refuse everything from now on, for the first reason given; a new session has a guard of its own."""
        self._stopped = reason if self._stopped is None else self._stopped

    def check(self, stimuli: Sequence[Stimulus], now_s: float) -> None:
        """Raise unless the request as a whole is within the limits; nothing is remembered.

        Args:
            stimuli: in the order of time, counted from now.
            now_s: the culture's clock.

        Raises:
            UnsafeStimulus: naming the limit, the value, and what to do.
        """
        self._examine(stimuli, now_s)

    def admit(self, stimuli: Sequence[Stimulus], now_s: float) -> Admitted:
        """Check a request and remember it as delivered.

        Raises:
            UnsafeStimulus: as `check` does; nothing is then remembered.
        """
        events = self._examine(stimuli, now_s)
        self._history.add(events, round(now_s * NS))
        self._delivered += len(events)
        return Admitted(stimuli, now_s, by=_MAY_ADMIT)

    def _examine(self, stimuli: Sequence[Stimulus], now_s: float) -> list[Event]:
        limits = self.limits
        if not stimuli:
            return []
        if self._stopped is not None:
            raise UnsafeStimulus("stopped", f"an emergency stop is in force ({self._stopped}): close and open again")
        if self._delivered + len(stimuli) > limits.stimuli_per_session:
            raise UnsafeStimulus(
                "stimuli_per_session",
                f"expected at most {limits.stimuli_per_session} stimuli in a session, got {len(stimuli)} more after "
                f"{self._delivered}: ask for fewer, or begin a new session after a rest",
            )
        events: list[Event] = []
        # What was asked for so far goes into a history of its own: a request that fails must leave no trace.
        asked, busy_until_ns = History(), self._history.busy_until_ns
        for stimulus in stimuli:
            self._check_one(stimulus)
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
        return events

    def _check_one(self, stimulus: Stimulus) -> None:
        """The limits that hold for a stimulus by itself."""
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
        if stimulus.pulse not in self._safe_pulses:
            self._check_pulse(stimulus.pulse)
            if len(self._safe_pulses) >= _REMEMBERED_PULSES:
                self._safe_pulses.clear()
            self._safe_pulses[stimulus.pulse] = None

    def _check_pulse(self, pulse: Pulse) -> None:
        limits = self.limits
        amplitude_unit, _ = limits.units
        if pulse.kind != limits.kind:
            raise UnsafeStimulus("kind", f"expected {limits.kind} pulses, got a {pulse.kind} pulse ({pulse})")
        if len(pulse.phases) > limits.phases_per_pulse:
            raise UnsafeStimulus(
                "phases_per_pulse",
                f"expected at most {limits.phases_per_pulse} phases in a pulse, got {len(pulse.phases)} ({pulse})",
            )
        for phase in pulse.phases:
            if abs(phase.amplitude) > limits.amplitude:
                raise UnsafeStimulus(
                    "amplitude",
                    f"expected at most {limits.amplitude:g} {amplitude_unit}, got {phase.amplitude:g}: lower it",
                )
            shortest, longest = limits.phase_us
            if not shortest <= phase.duration_us <= longest:
                raise UnsafeStimulus(
                    "phase_us", f"expected phases of {shortest:g} to {longest:g} us, got {phase.duration_us:g}"
                )
            if not _is_multiple(phase.duration_us, limits.phase_step_us):
                raise UnsafeStimulus(
                    "phase_step_us",
                    f"expected phases in steps of {limits.phase_step_us:g} us, got {phase.duration_us:g}: round it",
                )
        if limits.alternates:
            for before, after in pairwise(pulse.phases):
                if _sign(before.amplitude) == _sign(after.amplitude):
                    raise UnsafeStimulus("alternates", f"expected neighbouring phases of different signs, got {pulse}")
        self._check_charge(pulse)

    def _check_charge(self, pulse: Pulse) -> None:
        """The limits on charge, of the pulse as the device rounds it."""
        limits, charge_unit = self.limits, self.limits.units[1]
        pulse, as_asked = delivered_pulse(pulse, limits.amplitude_step), pulse
        is_rounded = "" if pulse == as_asked else f", which the device makes of {as_asked}"
        for phase in pulse.phases:
            if abs(phase.charge) > limits.charge_per_phase:
                raise UnsafeStimulus(
                    "charge_per_phase",
                    f"expected at most {limits.charge_per_phase:g} {charge_unit} a phase, got {phase.charge:g}"
                    f"{is_rounded}: lower the amplitude or shorten the phase",
                )
        if abs(pulse.net_charge) > limits.net_charge:
            raise UnsafeStimulus(
                "net_charge",
                f"expected phases that balance to {limits.net_charge:g} {charge_unit}, got {pulse.net_charge:g} "
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
