"""How spikes are found in raw traces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from animat.errors import InvalidArgument

Engine = Literal["auto", "scipy", "spikeinterface"]


@dataclass(frozen=True)
class Detection:
    """How spikes are found in raw traces.

    Attributes:
        band_hz: pass band of the zero-phase filter; None where the traces are filtered already.
        threshold: depth of a trough that is a spike, in standard deviations of the channel's noise.
        dead_time_ms: of two troughs within it, the deeper one is the spike.
        blank_ms: from before to after each stimulus in which nothing is looked for; 1.5 ms after by default, so that
            the response window from 2 ms on stays whole.
        saturation_uv: at which an amplifier saturates; None: where the trace is flat, far from where it was.
        recovery_ms: how long after a stimulus its artefact is followed.
        chunk_s: traces read at a time; with 1,024 channels at 20 kHz 0.5 s take some 200 MB a core.
        engine: what filters and finds: `"spikeinterface"`, `"scipy"`, or `"auto"`, SpikeInterface where it is
            installed. Everything else is the same for both; scipy takes a third to a half of the time.

    Raises:
        InvalidArgument: naming the setting, what was expected and what came.
    """

    band_hz: tuple[float, float] | None = (100.0, 3000.0)
    threshold: float = 5.0
    dead_time_ms: float = 1.0
    blank_ms: tuple[float, float] = (0.5, 1.5)
    saturation_uv: float | None = None
    recovery_ms: float = 20.0
    chunk_s: float = 0.5
    engine: Engine = "auto"

    def __post_init__(self) -> None:
        if self.band_hz is not None:
            low, high = self.band_hz
            _expect(0 < low < high < math.inf, "band_hz", "0 < low < high in Hz", self.band_hz)
        _expect(0 < self.threshold < 1000, "threshold", "0 to 1,000 standard deviations", self.threshold)
        _expect(0 <= self.dead_time_ms <= 100, "dead_time_ms", "0 to 100 ms", self.dead_time_ms)
        _expect(all(0 <= ms <= 1000 for ms in self.blank_ms), "blank_ms", "0 to 1,000 ms, twice", self.blank_ms)
        _expect(self.saturation_uv is None or self.saturation_uv > 0, "saturation_uv", "above 0", self.saturation_uv)
        _expect(self.blank_ms[1] <= self.recovery_ms <= 1000, "recovery_ms", "from blank_ms to 1 s", self.recovery_ms)
        _expect(0.1 <= self.chunk_s <= 60, "chunk_s", "0.1 to 60 s", self.chunk_s)
        _expect(
            self.engine in ("auto", "scipy", "spikeinterface"), "engine", "auto, scipy, spikeinterface", self.engine
        )


def _expect(is_right: bool, name: str, expected: str, got: object) -> None:
    if not is_right:
        raise InvalidArgument(f"{name}: expected {expected}, got {got}")
