"""What is delivered to a culture: phases make a pulse, a pulse on electrodes at a time makes a stimulus."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from animat.errors import InvalidArgument
from animat.recordings.plain import number, seconds, whole_number

Kind = Literal["voltage", "current"]


@dataclass(frozen=True)
class Phase:
    """A stretch of constant voltage or current: exactly one of the two amplitudes is given.

    Numbers of any type are copied as floats.

    Attributes:
        duration_us: how long, above 0.
        amplitude_mv: of a voltage phase; negative is cathodic.
        amplitude_ua: of a current phase; negative is cathodic.

    Raises:
        InvalidArgument: for both amplitudes or none, a number that is not finite, or no duration.
    """

    duration_us: float
    amplitude_mv: float | None = None
    amplitude_ua: float | None = None

    def __post_init__(self) -> None:
        for name in ("duration_us", "amplitude_mv", "amplitude_ua"):
            if (value := getattr(self, name)) is not None or name == "duration_us":
                object.__setattr__(self, name, number(name, value))
        if (self.amplitude_mv is None) == (self.amplitude_ua is None):
            raise InvalidArgument(
                f"phase: expected either amplitude_mv or amplitude_ua, got {self.amplitude_mv} and {self.amplitude_ua}"
            )
        if not (math.isfinite(self.duration_us) and self.duration_us > 0):
            raise InvalidArgument(f"duration_us: expected a finite time above 0 us, got {self.duration_us}")
        if not math.isfinite(self.amplitude):
            raise InvalidArgument(f"amplitude: expected a finite number, got {self.amplitude}")

    @property
    def kind(self) -> Kind:
        """Whether voltage or current is held."""
        return "voltage" if self.amplitude_mv is not None else "current"

    @property
    def amplitude(self) -> float:
        """The amplitude in mV or uA, by `kind`."""
        return self.amplitude_mv if self.amplitude_mv is not None else self.amplitude_ua  # type: ignore[return-value]

    @property
    def charge(self) -> float:
        """Amplitude times duration: nC of a current phase.

        For a voltage phase it is in mV ms, which stands for the charge: how much flows depends on the electrode's
        impedance, which is not known.
        """
        return self.amplitude * self.duration_us / 1000

    def to_dict(self) -> dict[str, float]:
        """As data for JSON."""
        unit = "mv" if self.kind == "voltage" else "ua"
        return {"duration_us": self.duration_us, f"amplitude_{unit}": self.amplitude}


def _plain_phase(phase: Any) -> Phase:
    if type(phase) is Phase:
        return phase
    if not isinstance(phase, Phase):
        raise InvalidArgument(f"phases: expected Phase, got {type(phase).__name__}")
    return Phase(phase.duration_us, phase.amplitude_mv, phase.amplitude_ua)


@dataclass(frozen=True)
class Pulse:
    """Phases that follow each other without a gap, all of one kind.

    Raises:
        InvalidArgument: for no phase, phases of both kinds, or what is no phase.
    """

    phases: tuple[Phase, ...]

    def __post_init__(self) -> None:
        try:
            phases = tuple(self.phases)
        except TypeError as error:
            raise InvalidArgument(f"phases: expected several Phase, got {type(self.phases).__name__}") from error
        object.__setattr__(self, "phases", tuple(_plain_phase(phase) for phase in phases))
        if not self.phases:
            raise InvalidArgument("phases: expected at least one, got none")
        if len({phase.kind for phase in self.phases}) > 1:
            raise InvalidArgument("phases: expected all voltage or all current, got both in one pulse")

    @property
    def kind(self) -> Kind:
        """Whether voltage or current is held."""
        return self.phases[0].kind

    @property
    def duration_us(self) -> float:
        """From the start of the first phase to the end of the last."""
        return math.fsum(phase.duration_us for phase in self.phases)

    @property
    def net_charge(self) -> float:
        """The sum of the phases' charges, in nC or mV ms (see `Phase.charge`); 0 for a balanced pulse."""
        return math.fsum(phase.amplitude * phase.duration_us for phase in self.phases) / 1000

    def to_list(self) -> list[dict[str, float]]:
        """As data for JSON."""
        return [phase.to_dict() for phase in self.phases]

    @staticmethod
    def from_list(phases: Sequence[Mapping[str, Any]]) -> Pulse:
        """From what `to_list` gave.

        Raises:
            InvalidArgument: for anything else.
        """
        try:
            return Pulse(tuple(Phase(**phase) for phase in phases))
        except TypeError as error:
            raise InvalidArgument(
                f"pulse: expected phases with duration_us and an amplitude, got {phases!r} ({error})"
            ) from error

    def __str__(self) -> str:
        unit = "mV" if self.kind == "voltage" else "uA"
        return ", then ".join(f"{phase.amplitude:+g} {unit} {phase.duration_us:g} us" for phase in self.phases)


PUBLISHED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(400.0, amplitude_mv=200.0)))
"""The paper's pulse as printed: 100 mV ms against 80, so it is not balanced; only the virtual culture's limits allow
that (method, section 1)."""

BALANCED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(500.0, amplitude_mv=200.0)))
"""The published pulse with its second phase as long as its first."""


@dataclass(frozen=True)
class Stimulus:
    """One pulse on one or several electrodes at once.

    What is given is copied as Python's own numbers: electrodes may be a list or an array of whole numbers.

    Attributes:
        time_s: its start, counted from the start of the delivery that it is part of; float64 or a whole number.
        electrodes: numbers on the array.
        pulse: what each electrode delivers.
        frequency_hz: the frequency it is presented at, NaN where it has none.
        pattern: index of the pattern that the electrodes make, -1 where they make none.
        presentation: number of the presentation it belongs to.

    Raises:
        InvalidArgument: for numbers of another type, a time in float32 among them, or what is no pulse.
    """

    time_s: float
    electrodes: tuple[int, ...]
    pulse: Pulse
    frequency_hz: float = math.nan
    pattern: int = -1
    presentation: int = 0

    def __post_init__(self) -> None:
        # A closed loop makes five an action: what is plain already is left as it is.
        if type(self.time_s) is not float:
            object.__setattr__(self, "time_s", seconds("time_s", self.time_s))
        if type(self.electrodes) is not tuple or not _ONLY_INT.issuperset(map(type, self.electrodes)):
            object.__setattr__(self, "electrodes", _plain_electrodes(self.electrodes))
        if type(self.pulse) is not Pulse:
            if not isinstance(self.pulse, Pulse):
                raise InvalidArgument(f"pulse: expected a Pulse, got {type(self.pulse).__name__}")
            object.__setattr__(self, "pulse", Pulse(self.pulse.phases))
        if type(self.frequency_hz) is not float:
            object.__setattr__(self, "frequency_hz", number("frequency_hz", self.frequency_hz))
        for name in ("pattern", "presentation"):
            if type(value := getattr(self, name)) is not int:
                object.__setattr__(self, name, whole_number(name, value))


def plain_stimuli(stimuli: Iterable[Stimulus]) -> tuple[Stimulus, ...]:
    """Stimuli that cannot change, in a tuple of their own; one of a subclass as the `Stimulus` its attributes make.

    Raises:
        InvalidArgument: for what is no stimulus.
    """
    if not isinstance(stimuli, Iterable):
        raise InvalidArgument(f"stimuli: expected several Stimulus, got {type(stimuli).__name__}")
    return tuple([stimulus if type(stimulus) is Stimulus else _plain_stimulus(stimulus) for stimulus in stimuli])


_ONLY_INT = frozenset({int})


def _plain_electrodes(electrodes: Any) -> tuple[int, ...]:
    try:
        given = tuple(electrodes)
    except TypeError as error:
        raise InvalidArgument(f"electrodes: expected several, got {type(electrodes).__name__}") from error
    return tuple(whole_number("electrodes", electrode) for electrode in given)


def _plain_stimulus(stimulus: Any) -> Stimulus:
    if not isinstance(stimulus, Stimulus):
        raise InvalidArgument(f"stimuli: expected Stimulus, got {type(stimulus).__name__}")
    return Stimulus(**{each.name: getattr(stimulus, each.name) for each in fields(Stimulus)})
