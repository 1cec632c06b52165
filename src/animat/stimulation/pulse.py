"""What one electrode delivers: a pulse made of phases of constant voltage or current."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import Number, Positive, record

PulseKind = Literal["voltage", "current"]


@record
class Phase:
    """A phase of constant voltage or current. Negative is cathodic; InvalidArgument unless one amplitude is given."""

    duration_us: Positive
    amplitude_mv: Number | None = None
    amplitude_ua: Number | None = None

    def __post_init__(self) -> None:
        if (self.amplitude_mv is None) == (self.amplitude_ua is None):
            raise InvalidArgument("amplitude: expected either amplitude_mv or amplitude_ua, got both or neither")

    @property
    def kind(self) -> PulseKind:
        """Whether voltage or current is held."""
        return "voltage" if self.amplitude_mv is not None else "current"

    @property
    def amplitude(self) -> float:
        """The amplitude in mV or uA, by `kind`."""
        return self.amplitude_mv if self.amplitude_mv is not None else self.amplitude_ua  # type: ignore[return-value]

    @property
    def charge(self) -> float:
        """Amplitude times duration, in nC for a current phase.

        For a voltage phase it is in mV ms, as a proxy for the charge, which depends on the electrode's unknown
        impedance.
        """
        return self.amplitude * self.duration_us / 1000


@record
class Pulse:
    """Phases that follow each other without a gap; InvalidArgument for none, or for phases of both kinds."""

    phases: Annotated[tuple[Phase, ...], Field(min_length=1)]

    def __post_init__(self) -> None:
        if len({phase.kind for phase in self.phases}) > 1:
            raise InvalidArgument("phases: expected all voltage or all current, got both in one pulse")

    @property
    def kind(self) -> PulseKind:
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
        unit = "mv" if self.kind == "voltage" else "ua"
        return [{"duration_us": phase.duration_us, f"amplitude_{unit}": phase.amplitude} for phase in self.phases]

    @staticmethod
    def from_list(phases: Pulse | Sequence[Mapping[str, Any]]) -> Pulse:
        """From the output of `to_list`, or a pulse as it is; raises InvalidArgument for anything else."""
        return phases if isinstance(phases, Pulse) else Pulse(phases)  # type: ignore[arg-type]

    def __str__(self) -> str:
        unit = "mV" if self.kind == "voltage" else "uA"
        return ", then ".join(f"{phase.amplitude:+g} {unit} {phase.duration_us:g} us" for phase in self.phases)


PUBLISHED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(400.0, amplitude_mv=200.0)))
"""The paper's pulse as printed. It is not balanced (100 mV ms against 80), which only the limits of simulated cultures
allow (method, section 1)."""

BALANCED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(500.0, amplitude_mv=200.0)))
"""The published pulse with a second phase as long as the first."""
