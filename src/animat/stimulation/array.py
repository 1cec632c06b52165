"""A rectangular electrode array: electrode numbers, positions, and the blocks in which it is scanned."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float64, Int64
from pydantic import Field

from animat.errors import InvalidArgument
from animat.records import Number, Whole, record

_MOST = 1_000_000

Electrodes = Int64[np.ndarray, " electrodes"]
OfElectrodes = Float64[np.ndarray, " electrodes"]
"""Numbers of electrodes, and what is known of each of them."""
Count = Annotated[Whole, Field(ge=1, le=_MOST)]


@record
class ElectrodeArray:
    """A grid of electrodes numbered row by row: electrode = row x columns + column, from 0.

    Attributes:
        pitch_um: distance between neighbours, in both directions.
        channels: electrodes that can be recorded at once.
        stimulation_units: electrodes that can be stimulated at once.
    """

    name: str
    columns: Count
    rows: Count
    pitch_um: Annotated[Number, Field(gt=0, le=_MOST)]
    channels: Count
    stimulation_units: Count

    def __len__(self) -> int:
        return self.columns * self.rows

    def position_um(self, electrode: Electrodes | int) -> tuple[OfElectrodes, OfElectrodes]:
        """x and y of electrodes, in micrometres from electrode 0; InvalidArgument for a number not on the array."""
        electrode = np.atleast_1d(np.asarray(electrode, dtype=np.int64))
        outside = (electrode < 0) | (electrode >= len(self))
        if np.any(outside):
            expected = f"numbers from 0 to {len(self) - 1} on the {self.name}"
            raise InvalidArgument(f"electrode: expected {expected}, got {electrode[outside][0]}")
        return (electrode % self.columns) * self.pitch_um, (electrode // self.columns) * self.pitch_um

    def distance_um(
        self, electrodes: Electrodes | int, others: Int64[np.ndarray, " others"] | int
    ) -> Float64[np.ndarray, "electrodes others"]:
        x_um, y_um = self.position_um(electrodes)
        other_x_um, other_y_um = self.position_um(others)
        return np.asarray(np.hypot(x_um[:, None] - other_x_um, y_um[:, None] - other_y_um))

    def scan_blocks(self) -> list[Electrodes]:
        """All electrodes, in order, in as few blocks as possible, each of which can be recorded at once."""
        return np.array_split(np.arange(len(self), dtype=np.int64), -(-len(self) // self.channels))


MAXONE = ElectrodeArray("MaxOne", columns=220, rows=120, pitch_um=17.5, channels=1024, stimulation_units=32)
"""26,400 electrodes in 3.85 x 2.10 mm (method, section 1)."""
