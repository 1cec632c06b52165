"""The response to a trial, as it is read in what was seen of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from animat.closed_loop.loop import Loop
from animat.closed_loop.stretch import Stretch
from animat.responses.windows import read_windows


class Read(NamedTuple):
    """A response.

    Attributes:
        x_hz: what the decoder is given, one number a readout.
        told: the same as a tick tells it (`animat.closed_loop.tick.Tick`).
        is_burst: whether it was one.
    """

    x_hz: Float64[np.ndarray, "*readouts"]
    told: dict[str, Any]
    is_burst: bool


def read_response(
    loop: Loop,
    drawn_from: Float64[np.ndarray, "responses *readouts"] | None,
    stretch: Stretch,
    members: Bool[np.ndarray, "readouts channels"],
    after_s: Float64[np.ndarray, "1"],
    rng: np.random.Generator,
) -> Read:
    """The response after a pulse, or one drawn in its place."""
    rate_hz, active_ratio = read_windows(stretch, after_s, loop.window_ms)
    reads_all = loop.readouts.are_all
    x_hz = rate_hz[0] if reads_all else loop.readouts.read(stretch, members, after_s, loop.window_ms)[0]
    # Of what was seen, also where another response is drawn.
    window_s = (loop.window_ms[1] - loop.window_ms[0]) * 1e-3
    spikes = round(float(rate_hz[0]) * window_s * len(stretch.channels))
    if drawn_from is not None:
        x_hz = drawn_from[rng.integers(len(drawn_from))]
        rate_hz = np.atleast_1d(x_hz) if reads_all else rate_hz
    is_burst = bool(active_ratio[0] > loop.burst_threshold) and drawn_from is None
    told = {
        "spikes": spikes,
        "rate_hz": float(rate_hz[0]),
        "active_ratio": float(active_ratio[0]),
        "is_burst": is_burst,
        "readout_hz": () if reads_all else tuple(np.atleast_1d(x_hz).tolist()),
    }
    return Read(x_hz, told, is_burst)
