"""What filters and finds: the same two steps by scipy and numpy, or by SpikeInterface where it is installed.

Reading, artefacts, noise, pieces and threads are ours with both, so that an engine changes how a number is computed and
nothing else.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from animat.errors import InvalidArgument
from animat.recordings.detection.band import band_pass
from animat.recordings.detection.settings import Engine
from animat.recordings.detection.troughs import find_troughs

Rows = Float32[np.ndarray, "channels samples"]
Places = tuple[Int64[np.ndarray, " troughs"], Int64[np.ndarray, " troughs"]]


@dataclass(frozen=True)
class Steps:
    """The two steps of an engine.

    Attributes:
        name: of what takes them, for the recording's provenance.
        band_pass: filters each row, `animat.recordings.detection.band.band_pass` or one like it.
        find_troughs: rows and samples of the spikes, `animat.recordings.detection.troughs.find_troughs` or one like it.
    """

    name: str
    band_pass: Callable[[Rows, tuple[float, float], float], Rows]
    find_troughs: Callable[[Rows, Float32[np.ndarray, " channels"], int, int, int], Places]


SCIPY = Steps("scipy", band_pass, find_troughs)


def steps_of(engine: Engine) -> Steps:
    """The steps of an engine; `"auto"` is SpikeInterface where it is installed, scipy otherwise.

    Raises:
        InvalidArgument: for SpikeInterface where it is not installed.
    """
    installed = importlib.util.find_spec("spikeinterface") is not None
    if engine == "spikeinterface" and not installed:
        raise InvalidArgument(
            "engine: expected an installed package, got spikeinterface: pip install 'spikeinterface>=0.104'"
        )
    if engine == "scipy" or not installed:
        return SCIPY
    from animat.recordings.detection import with_spikeinterface

    return Steps("SpikeInterface", with_spikeinterface.band_pass, with_spikeinterface.find_troughs)
