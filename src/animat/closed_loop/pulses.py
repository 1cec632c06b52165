"""The pulses of a session, column by column as they are given: half a million take 50 MB, and not a gigabyte."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

import numpy as np

from animat.stimulation.stimulus import Stimuli
from animat.tables import UNKNOWN


class Pulses:
    """Grows by what was seen in each stretch of time."""

    def __init__(self) -> None:
        self._time_s, self._frequency_hz = array("d"), array("d")
        self._pattern, self._presentation = array("q"), array("q")
        self._electrodes, self._widths = array("q"), array("q")

    def add(self, seen: Mapping[str, Any]) -> None:
        """The pulses of a stretch, from the words of its record."""
        for frequency_hz, pattern, presentation, electrodes in seen["stimuli"]:
            self._frequency_hz.append(frequency_hz)
            self._pattern.append(pattern)
            self._presentation.append(presentation)
            self._electrodes.extend(electrodes)
            self._widths.append(len(electrodes))
        if seen["tick"]:
            self._time_s.extend(seen["tick"]["pulse_time_s"])

    @property
    def last_s(self) -> float:
        """When the last one came; 0 before any."""
        return self._time_s[-1] if self._time_s else 0.0

    def stimuli(self) -> Stimuli:
        """As the table of a recording.

        Raises:
            UnusableData: for columns that do not fit together.
        """
        widths = np.array(self._widths, np.int64)
        electrodes = np.full((len(widths), int(np.max(widths, initial=0)) if len(widths) else 1), UNKNOWN)
        electrodes[np.arange(electrodes.shape[1])[None, :] < widths[:, None]] = self._electrodes
        return Stimuli(
            time_s=np.array(self._time_s, np.float64),
            frequency_hz=np.array(self._frequency_hz, np.float64),
            pattern=np.array(self._pattern, np.int64),
            electrodes=electrodes,
            presentation=np.array(self._presentation, np.int64),
        )
