"""Limits on stimulation, as data: what a culture and its device stand."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, fields
from math import floor, isfinite
from typing import Any

from animat.errors import InvalidArgument
from animat.stimulation.plain import number, whole_number
from animat.stimulation.pulse import Kind, Phase, Pulse


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
        net_charge_per_session: largest magnitude of the sum of what pulses leave on any one electrode from `open` to
            `close`.
        electrodes_at_once: most electrodes of one stimulus.
        stimuli_per_electrode_s: most stimuli on one electrode in any second.
        stimuli_per_s: most stimuli, on whatever electrodes, in any second.
        stimuli_per_session: most stimuli from `open` to `close`.
        phases_per_pulse: most phases of a pulse.
        alternates: whether phases that follow each other must differ in sign.
        phase_step_us: phases last whole multiples of it; 0: any time.
        amplitude_step: what the device rounds amplitudes to, 0 where it does not: limits on amplitudes and charges hold
            for the *rounded* phases. It is the device's; who asks for limits gives that or 0.
        interval_us: least time from the start of a stimulus to the start of the next one on the same electrode.
        gap_us: least time from the end of a stimulus to the start of the next one, on whatever electrodes.

    Numbers of any type are copied as Python's own.

    Raises:
        InvalidArgument: for a limit that is no number, not finite or below 0, or a count that is not whole.
    """

    kind: Kind
    amplitude: float
    phase_us: tuple[float, float]
    charge_per_phase: float
    net_charge: float
    net_charge_per_session: float
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
        try:
            shortest, longest = (number("phase_us", value) for value in self.phase_us)
        except (TypeError, ValueError):
            shortest = longest = 0.0
        if not (0 < shortest <= longest and isfinite(longest)):
            raise InvalidArgument(f"phase_us: expected (shortest, longest), above 0 and finite, got {self.phase_us}")
        object.__setattr__(self, "phase_us", (shortest, longest))
        alternates = getattr(self.alternates, "item", lambda: self.alternates)()
        if type(alternates) is not bool:
            raise InvalidArgument(f"alternates: expected True or False, got {self.alternates!r}")
        object.__setattr__(self, "alternates", alternates)
        for each in fields(Limits):
            if each.type in ("float", "int"):
                given = getattr(self, each.name)
                value = number(each.name, given) if each.type == "float" else whole_number(each.name, given)
                if not (isfinite(value) and value >= 0):
                    raise InvalidArgument(f"{each.name}: expected a finite number from 0, got {value}")
                object.__setattr__(self, each.name, value)

    @property
    def units(self) -> tuple[str, str]:
        """Of amplitude and of charge."""
        return ("mV", "mV ms") if self.kind == "voltage" else ("uA", "nC")

    def check_within(self, device: Limits) -> None:
        """Raise unless these limits are as tight as the device's or tighter.

        Raises:
            InvalidArgument: naming the limit that is looser.
        """
        for each in fields(Limits):
            ours, theirs = getattr(self, each.name), getattr(device, each.name)
            if not _IS_AS_TIGHT[each.name](ours, theirs):
                raise InvalidArgument(
                    f"limits.{each.name}: expected no looser than the device's {theirs}, got {ours}: limits can be "
                    "tightened, never loosened"
                )


def plain_limits(limits: Limits) -> Limits:
    """A copy of limits, those of a subclass as the `Limits` that their attributes make.

    Raises:
        InvalidArgument: for what is none.
    """
    if not isinstance(limits, Limits):
        raise InvalidArgument(f"limits: expected Limits, got {type(limits).__name__}")
    return Limits(**{each.name: getattr(limits, each.name) for each in fields(Limits)})


def is_multiple(value: float, step: float) -> bool:
    """Whether a value is a whole multiple of a step, above 0; of step 0 everything is."""
    return step == 0 or (value > 0 and abs(value / step - round(value / step)) < 1e-9)


_IS_AS_TIGHT: dict[str, Callable[[Any, Any], bool]] = {
    "kind": operator.eq,
    "phase_us": lambda ours, device: device[0] <= ours[0] and ours[1] <= device[1],
    **dict.fromkeys(("amplitude", "charge_per_phase", "net_charge", "net_charge_per_session"), operator.le),
    **dict.fromkeys(("stimuli_per_electrode_s", "stimuli_per_s", "stimuli_per_session"), operator.le),
    **dict.fromkeys(("electrodes_at_once", "phases_per_pulse"), operator.le),
    "alternates": operator.ge,
    "phase_step_us": is_multiple,
    # The device's own, for which 0 stands: another one would have the guard judge a pulse that nobody delivers.
    "amplitude_step": lambda ours, device: ours in (0.0, device),
    "interval_us": operator.ge,
    "gap_us": operator.ge,
}
"""Whether a value asked for is as tight as the device's, limit by limit; a limit that is missing here fails."""


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
"""A simulation comes to no harm, so these are wide. `net_charge` lets even the paper's pulse pass, which as printed
leaves 20 mV ms over, 500,000 times on one electrode in a session; the limits of a living culture must not."""


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
    return sign_of(amplitude) * floor(abs(amplitude) / amplitude_step + 0.5)


def sign_of(amplitude: float) -> int:
    """-1, 0 or 1."""
    return (amplitude > 0) - (amplitude < 0)
