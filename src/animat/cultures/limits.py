"""Limits on stimulation, as data: what a culture and its device tolerate."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import fields, replace
from math import copysign, floor
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from animat.errors import InvalidArgument, UnsafeStimulus
from animat.records import Flag, FromZero, Positive, Whole, record
from animat.stimulation.pulse import Pulse, PulseKind

Count = Annotated[Whole, Field(ge=0)]


@record
class Limits:
    """What a culture and its device tolerate. Amplitudes are in mV and charges in mV ms where `kind` is `"voltage"`, in
    uA and nC where it is `"current"` (see `Phase.charge`).

    Attributes:
        kind: what the device controls during a phase.
        amplitude: largest magnitude of a phase.
        phase_us: shortest and longest phase.
        charge_per_phase: largest magnitude of a phase's charge.
        net_charge: largest magnitude of the sum of a pulse's charges: its imbalance.
        net_charge_per_session: largest magnitude of the net charge on any one electrode, from `open` to `close`.
        electrodes_at_once: most electrodes of one stimulus.
        stimuli_per_electrode_s: most stimuli on one electrode in any second.
        stimuli_per_s: most stimuli on all electrodes in any second.
        stimuli_per_session: most stimuli from `open` to `close`.
        phases_per_pulse: most phases of a pulse.
        alternates: whether successive phases must differ in sign.
        phase_step_us: phases last whole multiples of it; 0: any duration.
        amplitude_step: the step to which the device rounds amplitudes, 0 if it does not: limits on amplitudes and
            charges apply to the *rounded* phases. It belongs to the device; limits that a user sets have the same or 0.
        interval_us: shortest time from the start of a stimulus to the start of the next on the same electrode.
        gap_us: shortest time from the end of a stimulus to the start of the next on any electrodes.

    Raises:
        InvalidArgument: for a limit that is not a number, not finite or below 0, or a count that is not whole.
    """

    kind: PulseKind
    amplitude: FromZero
    phase_us: tuple[Positive, Positive]
    charge_per_phase: FromZero
    net_charge: FromZero
    net_charge_per_session: FromZero
    electrodes_at_once: Count
    stimuli_per_electrode_s: Count
    stimuli_per_s: Count
    stimuli_per_session: Count
    phases_per_pulse: Count = 1000
    alternates: Flag = False
    phase_step_us: FromZero = 0.0
    amplitude_step: FromZero = 0.0
    interval_us: FromZero = 0.0
    gap_us: FromZero = 0.0

    def __post_init__(self) -> None:
        if self.phase_us[0] > self.phase_us[1]:
            raise InvalidArgument(f"phase_us: expected (shortest, longest), got {self.phase_us}")

    @property
    def units(self) -> tuple[str, str]:
        """The units of amplitude and of charge."""
        return ("mV", "mV ms") if self.kind == "voltage" else ("uA", "nC")

    def check_within(self, device: Limits) -> None:
        """Raise InvalidArgument, naming the limit, unless these are at least as tight as the device's."""
        for field in fields(Limits):
            ours, theirs = getattr(self, field.name), getattr(device, field.name)
            if not _IS_AS_TIGHT[field.name](ours, theirs):
                expected = f"limits.{field.name}: expected no looser than the device's {theirs}"
                raise InvalidArgument(f"{expected}, got {ours}: limits can be tightened, never loosened")

    def check_pulse(self, pulse: Pulse) -> float:
        """The net charge of a pulse as the device rounds it; UnsafeStimulus if it, or the request, exceeds a limit."""
        if pulse.kind != self.kind:
            expected = f"expected a {self.kind} pulse, which this kind of culture takes"
            raise UnsafeStimulus("kind", f"{expected}, got a {pulse.kind} pulse ({pulse})", argument="pulse")
        n, most, (shortest, longest), step = len(pulse.phases), self.phases_per_pulse, self.phase_us, self.phase_step_us
        _expect("phases_per_pulse", n <= most, f"at most {most} phases in a pulse", f"{n} ({pulse})")
        for us in (phase.duration_us for phase in pulse.phases):
            _expect("phase_us", shortest <= us <= longest, f"phases of {shortest:g} to {longest:g} us", f"{us:g}")
            _expect("phase_step_us", is_multiple(us, step), f"phases in steps of {step:g} us", f"{us:g}: round it")
        self._check_shape(pulse)
        made, unit = delivered_pulse(pulse, self.amplitude_step), self.units[1]
        rounding = "" if made == pulse else f", which the device makes of {pulse}"
        self._check_shape(made, rounding)
        for charge in (phase.charge for phase in made.phases):
            expected = f"-{self.charge_per_phase:g} to {self.charge_per_phase:g} {unit} per phase"
            got = f"{charge:g}{rounding}: lower the amplitude or shorten the phase"
            _expect("charge_per_phase", abs(charge) <= self.charge_per_phase, expected, got)
        expected = f"phases that balance to within {self.net_charge:g} {unit}"
        got = f"{made.net_charge:g} ({made}{rounding}): give the phases equal and opposite charge"
        _expect("net_charge", abs(made.net_charge) <= self.net_charge, expected, got)
        return made.net_charge

    def _check_shape(self, pulse: Pulse, rounding: str = "") -> None:
        """Check the limits on amplitudes and signs."""
        expected = f"-{self.amplitude:g} to {self.amplitude:g} {self.units[0]}"
        for amplitude in (phase.amplitude for phase in pulse.phases):
            got = f"{amplitude:g}{rounding}: give the pulse a smaller amplitude"
            _expect("amplitude", abs(amplitude) <= self.amplitude, expected, got)
        signs = np.sign([phase.amplitude for phase in pulse.phases])
        is_alternating = not self.alternates or bool(np.all(signs[1:] != signs[:-1]))
        _expect("alternates", is_alternating, "successive phases of different signs", f"{pulse}{rounding}")


def _expect(limit: str, is_kept: bool, expected: str, got: str) -> None:
    if not is_kept:
        raise UnsafeStimulus(limit, f"expected {expected}, got {got}")


def plain_limits(limits: Limits) -> Limits:
    """A copy of limits as plain `Limits`, even from a subclass."""
    if not isinstance(limits, Limits):
        raise InvalidArgument(f"limits: expected Limits, got {type(limits).__name__}")
    return Limits(**{field.name: getattr(limits, field.name) for field in fields(Limits)})


def is_multiple(value: float, step: float) -> bool:
    """Whether a value is a positive whole multiple of a step; any value is for step 0."""
    return step == 0 or (value > 0 and abs(value / step - round(value / step)) < 1e-9)


_IS_AS_TIGHT: dict[str, Callable[[Any, Any], bool]] = {
    "kind": operator.eq,
    "phase_us": lambda ours, device: device[0] <= ours[0] and ours[1] <= device[1],
    **dict.fromkeys(("amplitude", "charge_per_phase", "net_charge", "net_charge_per_session"), operator.le),
    **dict.fromkeys(("electrodes_at_once", "phases_per_pulse", "stimuli_per_session"), operator.le),
    **dict.fromkeys(("stimuli_per_electrode_s", "stimuli_per_s"), operator.le),
    **dict.fromkeys(("alternates", "interval_us", "gap_us"), operator.ge),
    "phase_step_us": is_multiple,
    # Only the device's own step, or 0 for it: with another, the checked pulse would not be the delivered one.
    "amplitude_step": lambda ours, device: ours in (0.0, device),
}
"""For each limit, whether a requested value is at least as tight as the device's; a limit missing here is an error."""


SIMULATED_LIMITS = Limits(
    kind="voltage",
    amplitude=400.0,
    phase_us=(50.0, 1000.0),
    charge_per_phase=200.0,
    net_charge=25.0,
    net_charge_per_session=1e7,
    electrodes_at_once=32,
    stimuli_per_electrode_s=100,
    stimuli_per_s=200,
    stimuli_per_session=10_000_000,
)
"""A simulation cannot be harmed, so these are wide. Even the paper's pulse passes, whose net charge as printed is
-20 mV ms, 500,000 times on one electrode in a session; the limits of a living culture must not allow that."""


def delivered_pulse(pulse: Pulse, amplitude_step: float) -> Pulse:
    """The pulse that a device delivers, with amplitudes rounded to whole steps, half away from 0; step 0: unchanged."""
    if amplitude_step == 0:
        return pulse
    unit = "amplitude_mv" if pulse.kind == "voltage" else "amplitude_ua"
    rounded = [steps_of(phase.amplitude, amplitude_step) * amplitude_step for phase in pulse.phases]
    return Pulse(tuple(replace(p, **{unit: value}) for p, value in zip(pulse.phases, rounded, strict=True)))


def steps_of(amplitude: float, amplitude_step: float) -> int:
    """An amplitude in whole steps, rounded half away from 0: opposite amplitudes stay opposite."""
    return int(copysign(floor(abs(amplitude) / amplitude_step + 0.5), amplitude))
