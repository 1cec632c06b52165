"""A table of responses: what each channel did after each stimulus, as a count or a rate, without times of spikes."""

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
    """What many laboratories publish in place of spikes: a count or a rate a stimulus and channel.

    Attributes:
        values: spikes in the window, or their rate in Hz, a row a stimulus in the order of presentation, shape
            (stimuli, channels).
        kind: which of the two.
        channels: the channel table, a row a column of `values`.
        stimuli: the stimulus table, a row a row of `values`.
        has_times: whether `stimuli.time_s` are times; False: they number the rows.
        window_ms: the window after the stimulus that the spikes were counted in, None where it is not known.
        start_min: start on the culture's clock, in minutes.
        presentation: how stimuli were presented, None where it is not known.
        provenance: where the table came from, words by words, for people.
        findings: what was noticed when it was read.
        protocol: None, as none is told.

    Raises:
        UnusableData: for values that are negative or not finite, counts that are not whole, or tables of other lengths.
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        values = read_only(self, "values", np.float64)
        shape = (len(self.stimuli), len(self.channels))
        if values.shape != shape:
            raise UnusableData(
                f"responses: expected a row a stimulus and a column a channel, {shape}, got {values.shape}"
            )
        wrong = ~np.isfinite(values) | (values < 0)
        if np.any(wrong):
            row, column = np.argwhere(wrong)[0]
            raise UnusableData(
                f"responses: expected {self._words} of 0 or more, got {values[row, column]:g} for stimulus {row + 1} "
                f"on channel {self.channels.label[column]} ({np.count_nonzero(wrong):,} such)"
            )
        if self.kind == "count" and np.any(values != np.round(values)):
            row, column = np.argwhere(values != np.round(values))[0]
            raise UnusableData(
                f"responses: expected counts of spikes, which are whole, got {values[row, column]:g} for stimulus "
                f"{row + 1} on channel {self.channels.label[column]}; rates in Hz are called rate_hz"
            )
        if self.window_ms is not None and not 0 <= self.window_ms[0] < self.window_ms[1] < np.inf:
            raise UnusableData(
                f"window: expected 0 <= start < end in ms, got {self.window_ms[0]:g}, {self.window_ms[1]:g}"
            )

    @property
    def _words(self) -> str:
        return "counts" if self.kind == "count" else "rates in Hz"
