"""Frequencies of pulses, which files round and rigs compute from intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64


def is_same(frequency_hz: Any, other_hz: Any) -> Any:
    """Whether two frequencies are the same within a millionth, also for arrays; an unknown one (NaN) never is."""
    return np.abs(frequency_hz - other_hz) <= 1e-6 * other_hz


def distinct(frequency_hz: Float64[np.ndarray, " pulses"]) -> list[float]:
    """The known frequencies, rising, each once."""
    found: list[float] = []
    for known_hz in np.unique(frequency_hz[~np.isnan(frequency_hz)]).tolist():
        if found and is_same(known_hz, found[-1]):
            # Rounded, so that it is the same number in every recording of a series.
            found[-1] = float(f"{found[-1]:.9g}")
        else:
            found.append(known_hz)
    return found
