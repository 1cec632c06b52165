"""A response table: a count or a rate for each stimulus and channel, without spike times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float64

from animat.errors import UnusableData
from animat.recordings.findings import Finding
from animat.recordings.recording import Channels
from animat.stimulation.protocol import Presentation
from animat.stimulation.stimulus import Stimuli
from animat.tables import read_only

Kind = Literal["count", "rate_hz"]


@dataclass(frozen=True, eq=False)
class ResponseTable:
    """A count or a rate for each stimulus and channel, which many laboratories publish instead of spikes.

    Attributes:
        values: spikes in the window, or their rate in Hz, one row per stimulus in order of presentation, shape
            (stimuli, channels).
        kind: which of the two.
        channels: the channel table, one row per column of `values`.
        stimuli: the stimulus table, one row per row of `values`.
        has_times: whether `stimuli.time_s` are times; otherwise they number the rows.
        window_ms: the window after the stimulus in which spikes were counted, None if not known.
        start_min, presentation, provenance, findings: as in `Recording`.
        protocol, culture: None, as files do not state them.

    Raises:
        UnusableData: for values that are negative or not finite, counts that are not whole, or tables of the wrong
            length.
    """

    values: Float64[np.ndarray, "stimuli channels"]
    kind: Kind
    channels: Channels
    stimuli: Stimuli
    has_times: bool = True
    window_ms: tuple[float, float] | None = None
    start_min: float = 0.0
    presentation: Presentation | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    protocol: ClassVar[None] = None
    culture: ClassVar[None] = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        values = read_only(self, "values", np.float64)
        shape = (len(self.stimuli), len(self.channels))
        if values.shape != shape:
            raise UnusableData(f"responses: expected rows of stimuli, columns of channels, {shape}, got {values.shape}")
        wrong, advice = ~np.isfinite(values) | (values < 0), ""
        expected = "counts of 0 or more" if self.kind == "count" else "rates in Hz of 0 or more"
        if self.kind == "count" and not np.any(wrong):
            wrong, expected = values != np.round(values), "whole spike counts"
            advice = "; if these are rates in Hz, name them rate_hz"
        if np.any(wrong):
            row, column = np.argwhere(wrong)[0]
            where = f"for stimulus {row + 1} on channel {self.channels.label[column]}"
            raise UnusableData(f"responses: expected {expected}, got {values[row, column]:g} {where}{advice}")
        if self.window_ms is not None and not 0 <= self.window_ms[0] < self.window_ms[1] < np.inf:
            raise UnusableData(f"window: expected 0 <= start < end in ms, got {self.window_ms}")
