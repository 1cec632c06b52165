"""Settings of spike detection in raw traces."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import Number, Positive, record

Milliseconds = Annotated[Number, Field(ge=0, le=1000)]


@record
class Detection:
    """Settings of spike detection in raw traces.

    Attributes:
        band_hz: pass band of the zero-phase filter; None if the traces are already filtered.
        threshold: depth of a negative peak that is a spike, in standard deviations of the channel's noise.
        dead_time_ms: of two negative peaks within it, the deeper one is the spike.
        blank_ms: time before and after each stimulus in which no spikes are looked for; 1.5 ms after by default, so
            that the response window from 2 ms on stays intact.
        saturation_uv: voltage at which an amplifier saturates; None: detected where the trace is flat and far from
            where it was.
        recovery_ms: how long an artefact is followed after its stimulus.
        chunk_s: length of traces read at a time; with 1,024 channels at 20 kHz, 0.5 s takes some 200 MB per core.

    Raises:
        InvalidArgument: naming the setting, what was expected and what came.
    """

    band_hz: tuple[Positive, Positive] | None = (100.0, 3000.0)
    threshold: Annotated[Positive, Field(lt=1000)] = 5.0
    dead_time_ms: Annotated[Number, Field(ge=0, le=100)] = 1.0
    blank_ms: tuple[Milliseconds, Milliseconds] = (0.5, 1.5)
    saturation_uv: Positive | None = None
    recovery_ms: Milliseconds = 20.0
    chunk_s: Annotated[Number, Field(ge=0.1, le=60)] = 0.5

    def __post_init__(self) -> None:
        if self.band_hz is not None and not self.band_hz[0] < self.band_hz[1]:
            low, high = self.band_hz
            raise InvalidArgument(f"band_hz: expected 0 < low < high in Hz, got {low:g} to {high:g}")
        if not self.blank_ms[1] <= self.recovery_ms:
            raise InvalidArgument(f"recovery_ms: expected from blank_ms to 1 s, got {self.recovery_ms:g}")
