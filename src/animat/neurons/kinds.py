"""The kinds of neuron simulators, by name."""

from __future__ import annotations

from typing import Literal, get_args

from animat.errors import InvalidArgument
from animat.neurons.history import Memory
from animat.neurons.joint_histogram import fit_joint_histogram
from animat.neurons.memory import fit_memory
from animat.neurons.simulator import NeuronSimulator, fit_empirical, fit_histogram
from animat.responses.responses import Responses

Kind = Literal["histogram", "empirical", "memory"]
"""Draw from a distribution in bins (the paper); a measured response; or one measured after a similar history."""


def fit_simulator(
    responses: Responses,
    *,
    kind: str = "histogram",
    bins: int = 20,
    range_hz: float | None = None,
    room: int | None = None,
    memory: Memory | None = None,
) -> NeuronSimulator:
    """Fit a simulator of a `Kind`; arguments and errors are those of `fit_histogram`, `fit_empirical` and `fit_memory`.

    Histograms of several readouts need `room`, too.
    """
    if kind == "histogram" and len(responses.readouts) > 1:
        return fit_joint_histogram(responses, bins=bins, range_hz=range_hz, room=room)
    if kind == "histogram":
        return fit_histogram(responses, bins=bins, range_hz=range_hz)
    if kind == "empirical":
        return fit_empirical(responses, room=room)
    if kind == "memory":
        return fit_memory(responses, room=room, memory=memory)
    raise InvalidArgument(f"kind: expected one of {', '.join(get_args(Kind))}, got {kind!r}")
