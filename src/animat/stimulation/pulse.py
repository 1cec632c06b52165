"""What one electrode delivers: phases of constant voltage or current make a pulse."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import Number, Positive, record

Kind = Literal["voltage", "current"]


@record
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

    duration_us: Positive
    amplitude_mv: Number | None = None
    amplitude_ua: Number | None = None

    def __post_init__(self) -> None:
        if (self.amplitude_mv is None) == (self.amplitude_ua is None):
            raise InvalidArgument(
                f"amplitude: expected either amplitude_mv or amplitude_ua, got {self.amplitude_mv} and "
                f"{self.amplitude_ua}"
            )

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


@record
class Pulse:
    """Phases that follow each other without a gap, all of one kind.

    Raises:
        InvalidArgument: for no phase, phases of both kinds, or what is no phase.
    """

    phases: Annotated[tuple[Phase, ...], Field(min_length=1)]

    def __post_init__(self) -> None:
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
    def from_list(phases: Pulse | Sequence[Mapping[str, Any]]) -> Pulse:
        """From what `to_list` gave; a pulse is one already.

        Raises:
            InvalidArgument: for anything else.
        """
        return phases if isinstance(phases, Pulse) else Pulse(phases)  # type: ignore[arg-type]

    def __str__(self) -> str:
        unit = "mV" if self.kind == "voltage" else "uA"
        return ", then ".join(f"{phase.amplitude:+g} {unit} {phase.duration_us:g} us" for phase in self.phases)


PUBLISHED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(400.0, amplitude_mv=200.0)))
"""The paper's pulse as printed: 100 mV ms against 80, so it is not balanced; only the virtual culture's limits allow
that (method, section 1)."""

BALANCED_PULSE = Pulse((Phase(500.0, amplitude_mv=-200.0), Phase(500.0, amplitude_mv=200.0)))
"""The published pulse with its second phase as long as its first."""
